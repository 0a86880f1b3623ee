"""Reward: minus the depth of overlaps between objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.errors import Checked, OneOf
from scene_envs.scene import SceneBatch

MEASURES = ("total", "deepest")
"""Ways to count: the sum over object pairs, or the deepest pair."""
_TOUCHING = 1e-4
"""Objects in each other up to this depth (m) touch, and are not counted as overlapping."""


@register_reward("penetration")
@dataclass(frozen=True)
class Penetration(Checked):
    """Minus the depth in mm to which objects overlap, summed over the pairs of a scene; 0 without overlap.

    Needs no simulator. Two welded objects are no pair.

    Attributes:
        measure: ``"total"`` for the sum over object pairs of their depth, ``"deepest"`` for the deepest pair.

    >>> Penetration()(SceneBatch.empty("dimsum_table", 1), RewardContext()).terms["overlapping_pairs"]
    tensor([0.])
    """

    name: ClassVar[str] = "penetration"
    measure: Annotated[str, OneOf(MEASURES, "measure of penetration")] = "total"

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Terms: ``total_mm``, ``deepest_mm``, and ``overlapping_pairs`` deeper than 0.1 mm.

        ``object_flags["overlapping"]`` (B, N) marks objects deeper than 0.1 mm in others.

        ``per_object`` (B, N): with ``"total"``, a pair's depth is shared between its two objects; in a pair of a free
        and a welded object, all of it falls to the free one. Credits then add up to the value. With ``"deepest"``, the
        credit is minus the deepest overlap of each free object.
        """
        from scene_envs.physics import penetration

        result = penetration(batch, pool=context.pool)
        free = batch.is_free.cpu()
        shared, count = torch.zeros(free.shape), torch.zeros(len(batch))
        for row, pairs in enumerate(result.pairs):
            count[row] = sum(pair.depth > _TOUCHING for pair in pairs)
            for pair in pairs:
                blamed = [slot for slot in pair.slots if free[row, slot]] or list(pair.slots)
                for slot in blamed:
                    shared[row, slot] -= 1e3 * pair.depth / len(blamed)
        total, deepest = 1e3 * result.total_per_pair, 1e3 * result.depth.amax(dim=-1)
        value, credit = (total, shared) if self.measure == "total" else (deepest, -1e3 * result.depth * free)
        device = batch.tensor.device
        return RewardOutput(
            value=-value.to(device),
            per_object=credit.to(device),
            terms={
                "total_mm": total.to(device),
                "deepest_mm": deepest.to(device),
                "overlapping_pairs": count.to(device),
            },
            valid=result.valid.to(device),
            object_flags={"overlapping": (result.depth > _TOUCHING).to(device)},
        )
