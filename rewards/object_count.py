"""Reward: number of objects of a scene, the paper's objective for clutter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.scene import SceneBatch


@register_reward("object_count")
@dataclass(frozen=True)
class ObjectCount:
    """Number of objects in a scene, welded ones included.

    The value ignores where objects are; they may overlap. This is the objective of the paper's post-training experiment
    (section 4.3).

    >>> output = ObjectCount()(SceneBatch.empty("dimsum_table", 2), RewardContext())
    >>> output.value, output.per_object.sum(dim=1)
    (tensor([1., 1.]), tensor([1., 1.]))
    """

    name: ClassVar[str] = "object_count"
    counts_objects: ClassVar[bool] = True

    def maximum(self, slots: int, free_slots: int) -> float:
        """The largest value: every slot holds an object."""
        return slots

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Count the slots that are not empty; ``per_object`` (B, N) is 1 for each of them."""
        present = (~batch.is_empty).float()
        return RewardOutput(present.sum(dim=-1), per_object=present)
