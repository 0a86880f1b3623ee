"""A reward with a setting."""

from rewards import register_reward


@register_reward("spread_out")
def spread_out(batch, scale: float = 1.0):
    """Mean horizontal distance from the middle, m."""
    return scale * batch.translations[..., :2].norm(dim=-1).mean(dim=-1)
