"""Reward: number of objects that are physically feasible as sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from rewards.verdicts import verdicts
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch

_LIMITS = ("max_penetration", "max_displacement", "max_rotation", "duration")


@register_reward("feasible_objects")
@dataclass(frozen=True)
class FeasibleObjects:
    """Number of free objects in the workspace that neither penetrate another object nor move when simulated.

    An object is feasible if its frame is in the workspace, it overlaps no other object by more than
    ``max_penetration`` and, with the penetrating objects removed, it moves and turns by at most the limits in
    simulation. Welded objects are not counted.

    Attributes:
        max_penetration: deepest allowed overlap with any other object, m.
        max_displacement: largest allowed movement, m.
        max_rotation: largest allowed rotation, rad.
        duration: simulated time, s.
    """

    name: ClassVar[str] = "feasible_objects"
    max_penetration: float = 1e-3
    max_displacement: float = 1e-3
    max_rotation: float = 1e-2
    duration: float = 0.1

    def __post_init__(self) -> None:
        for setting in _LIMITS:
            if not getattr(self, setting) > 0:
                raise InvalidInputError(f"{self.name}: {setting}={getattr(self, setting)} must be positive")

    def maximum(self, slots: int, free_slots: int) -> float:
        """The largest value: every free slot holds a feasible object."""
        return free_slots

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Count feasible objects; rows that physics could not judge are invalid.

        Terms: ``free_objects``; ``feasible_fraction`` of them (1 in a scene without free objects); ``deepest_mm``,
        the deepest overlap. ``object_flags["feasible"]`` (B, N) marks the objects that count, ``per_object`` likewise.
        """
        device = batch.tensor.device
        result = verdicts(batch, {limit: getattr(self, limit) for limit in _LIMITS}, context.pool)
        feasible = result.feasible.to(device)
        count = feasible.sum(dim=-1).float()
        free = batch.is_free.sum(dim=-1).float()
        return RewardOutput(
            value=count,
            per_object=feasible.float(),
            terms={
                "free_objects": free,
                "feasible_fraction": (count / free.clamp(min=1)).masked_fill(free == 0, 1.0),
                "deepest_mm": 1e3 * result.depth.to(device).float().amax(dim=-1),
            },
            valid=result.valid.to(device),
            object_flags={"feasible": feasible},
        )
