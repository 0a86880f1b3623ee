"""Reward: graded stillness of the free objects in simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from rewards.base import RewardContext, RewardOutput
from rewards.feasible import verdicts
from rewards.registry import register_reward
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


@register_reward("stability")
@dataclass(frozen=True)
class Stability:
    """Stillness of the free objects under gravity: their mean score, from 0 to 1 (at rest).

    An object that moves by d and turns by a scores ``exp(-(d / scale + a / scale_rotation))``. Objects deeper than
    ``max_penetration`` in others are removed before the simulation, as for ``feasible_objects``, and score 0. Objects
    outside the workspace also score 0. A scene without free objects scores 0.

    Attributes:
        scale: movement that costs a factor of e, m.
        scale_rotation: rotation that costs a factor of e, rad.
        max_penetration: deepest overlap with which an object is simulated, m.
        duration: simulated time, s.
    """

    name: ClassVar[str] = "stability"
    averages_objects: ClassVar[bool] = True
    scale: float = 0.01
    scale_rotation: float = 0.1
    max_penetration: float = 1e-3
    duration: float = 0.1

    def __post_init__(self) -> None:
        for setting in ("scale", "scale_rotation", "max_penetration", "duration"):
            if not getattr(self, setting) > 0:
                raise InvalidInputError(f"stability: {setting}={getattr(self, setting)} must be positive")

    def maximum(self, slots: int, free_slots: int) -> float:
        """The largest value, if all objects are at rest."""
        return 1.0

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Simulate; rows that physics could not judge are invalid.

        ``per_object`` (B, N) is the score of each object. Terms: ``free_objects``; ``simulated_objects``, those that
        overlap nothing; ``moved_mm`` and ``turned_rad``, the means over these.
        """
        device = batch.tensor.device
        limits = {
            "max_penetration": self.max_penetration,
            "max_displacement": 1e-3,
            "max_rotation": 1e-2,
            "duration": self.duration,
        }  # as in feasible_objects: scenes that both rewards score are simulated once
        result = verdicts(batch, limits, context.pool)
        moved, turned = result.displacement.to(device), result.rotation.to(device)
        simulated = batch.is_free & (result.depth.to(device) <= self.max_penetration)
        score = torch.exp(-(moved / self.scale + turned / self.scale_rotation)) * (simulated & batch.in_workspace)
        free, some = batch.is_free.sum(dim=-1).float(), simulated.sum(dim=-1).float()
        return RewardOutput(
            value=score.sum(dim=-1) / free.clamp(min=1),
            per_object=score,
            terms={
                "free_objects": free,
                "simulated_objects": some,
                "moved_mm": 1e3 * (moved * simulated).sum(dim=-1) / some.clamp(min=1),
                "turned_rad": (turned * simulated).sum(dim=-1) / some.clamp(min=1),
            },
            valid=result.valid.to(device),
        )
