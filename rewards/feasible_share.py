"""Reward: share of the free objects that are physically feasible as sampled."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from rewards.base import RewardContext, RewardOutput
from rewards.feasible_objects import FeasibleObjects
from rewards.registry import register_reward
from scene_envs.scene import SceneBatch


@register_reward("feasible_share")
@dataclass(frozen=True)
class FeasibleShare(FeasibleObjects):
    """Share of the free objects that are in the workspace, overlap nothing and do not move; from 0 to 1.

    Definition and settings are those of ``feasible_objects``. A scene without free objects scores 0, so that emptying a
    scene gains nothing. Generated welded objects, such as the tables of rooms, do not change the value. They get credit
    for not overlapping each other.

    Attributes:
        max_penetration: deepest allowed overlap with any other object, m.
        max_displacement: largest allowed movement, m.
        max_rotation: largest allowed rotation, rad.
        duration: simulated time, s.
    """

    name: ClassVar[str] = "feasible_share"
    averages_objects: ClassVar[bool] = True

    def maximum(self, slots: int, free_slots: int) -> float:
        """The largest value, of scenes with only feasible objects."""
        return 1.0

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Divide the feasible objects by the free ones; rows that physics could not judge are invalid.

        Terms: ``free_objects``, ``feasible_objects``, ``deepest_mm``. ``per_object`` (B, N) and
        ``object_flags["feasible"]`` are the verdict. ``per_object`` is also 1 for generated welded objects that
        overlap no other welded one by more than ``max_penetration``; ``object_flags["judged"]`` marks these and the
        free objects.
        """
        from scene_envs.physics import furniture_overlap

        output = FeasibleObjects.__call__(self, batch, context)
        furniture = batch.is_furniture
        apart = furniture_overlap(batch, pool=context.pool).to(furniture.device) <= self.max_penetration
        flags = {**output.object_flags, "judged": batch.is_free | furniture}
        free = output.terms["free_objects"]
        terms = {"free_objects": free, "feasible_objects": output.value, "deepest_mm": output.terms["deepest_mm"]}
        return replace(
            output,
            value=output.value / free.clamp(min=1),
            per_object=output.object_flags["feasible"].float() + (furniture & apart),
            terms=terms,
            object_flags=flags,
        )
