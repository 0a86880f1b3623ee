"""Reward: free space around objects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.errors import Checked, Positive
from scene_envs.scene import SceneBatch


@register_reward("clearance")
@dataclass(frozen=True)
class Clearance(Checked):
    """Mean gap of the free objects to their nearest neighbours, over the gap that is wanted: from 0 to 1.

    The gap is the distance of the convex parts; it is 0 where objects touch or overlap. An object and what carries it,
    directly or through others (``SceneBatch.supports``), are no neighbours. Objects outside the workspace score 0; so
    does a scene without free objects.

    Attributes:
        wanted: gap from which an object has all the space it needs, m.

    >>> Clearance()(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([0.])
    """

    name: ClassVar[str] = "clearance"
    place = "clearance: "
    maximum: ClassVar[float] = 1.0
    averages_objects: ClassVar[bool] = True
    wanted: Positive = 0.03

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """``per_object`` (B, N) is the gap over ``wanted``, at most 1. Terms: ``smallest_gap``, m, at most
        ``wanted``, and ``crowded_objects``, whose gap is smaller; they have the flag ``crowded``.
        """
        from scene_envs.physics.api import chosen_pool, run_kernel, stack, valid_rows

        rows = run_kernel("gaps", batch, {"limit": self.wanted}, chosen_pool(context.pool, None))
        counted = (batch.is_free & batch.in_workspace).cpu()
        gap, free = stack(rows, batch, "gap"), batch.is_free.cpu().sum(dim=-1).clamp(min=1)
        share = (gap / self.wanted).clamp(max=1.0) * counted
        crowded = counted & (share < 1)
        terms = {
            "smallest_gap": gap.masked_fill(~counted, self.wanted).amin(dim=-1),
            "crowded_objects": crowded.sum(dim=-1).float(),
        }
        device = batch.tensor.device
        return RewardOutput(
            value=(share.sum(dim=-1) / free).to(device),
            per_object=share.to(device),
            terms={name: term.to(device) for name, term in terms.items()},
            valid=valid_rows(rows).to(device),
            object_flags={"crowded": crowded.to(device)},
        )
