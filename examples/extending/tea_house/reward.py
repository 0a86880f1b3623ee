"""A reward: the height of the highest tower."""

from rewards import register_reward


@register_reward("tower")
def tower(batch, *, scale: float = 1.0):
    """Height of the highest free object's origin above the lowest one's, times ``scale``, m."""
    heights = batch.translations[..., 2]
    highest = heights.masked_fill(~batch.is_free, -1e3).amax(dim=-1)
    lowest = heights.masked_fill(~batch.is_free, 1e3).amin(dim=-1)
    return scale * (highest - lowest).clamp(min=0)
