"""A reward class that uses nothing but the public interface."""

from rewards import RewardContext, RewardOutput
from scene_envs import SceneBatch


class OpenSpace:
    """Mean horizontal distance of free objects from the middle of the table, m."""

    def __init__(self, scale: float = 1.0) -> None:
        self.scale = scale

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        free = batch.is_free
        distance = batch.translations[..., :2].norm(dim=-1) * free
        mean = distance.sum(dim=-1) / free.sum(dim=-1).clamp(min=1)
        return RewardOutput(self.scale * mean, per_object=self.scale * distance)
