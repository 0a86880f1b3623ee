"""A reward that depends on the other scenes of its batch."""

from __future__ import annotations

from typing import ClassVar

from rewards.base import RewardContext, RewardOutput
from scene_envs.scene import SceneBatch


class AboveTheMean:
    """Objects of a scene minus the mean of the batch."""

    name: ClassVar[str] = "above_the_mean"
    depends_on_batch: ClassVar[bool] = True

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        counts = batch.counts.float()
        return RewardOutput(counts - counts.mean())
