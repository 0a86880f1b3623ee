"""Reward: share of the free objects that a parallel gripper can reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.errors import Checked, InvalidInputError, Positive, unknown_name
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.physics.grasping import Gripper

SIDES = ("above", "front")
"""Directions of the gripper: straight from above, or level from the viewer's side of the scene."""


@register_reward("reachability")
@dataclass(frozen=True)
class Reachability(Checked):
    """Share of the free objects that an open parallel gripper can reach without a collision, from 0 to 1.

    The gripper moves in a straight line from above or from the front, until some of the object is between its fingers
    (:func:`scene_envs.physics.grasping.reachable`). Whether the grasp would hold is not tested. Objects outside the
    workspace are not reachable; a scene without free objects scores 0.

    Attributes:
        sides: ``"above"``, ``"front"`` (the side of the scene type's camera, level) or both; one side is enough.
        opening: distance between the open fingers, m.
        finger_length: length of the fingers, m.

    >>> Reachability()(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([0.])
    """

    name: ClassVar[str] = "reachability"
    maximum: ClassVar[float] = 1.0
    averages_objects: ClassVar[bool] = True
    place = "reachability: "
    sides: str | Sequence[str] = SIDES
    opening: Positive = 0.08
    finger_length: Positive = 0.045

    def __post_init__(self) -> None:
        super().__post_init__()
        sides = (self.sides,) if isinstance(self.sides, str) else tuple(self.sides)
        for side in sides:
            if side not in SIDES:
                raise unknown_name("side of reachability", str(side), SIDES)
        if not sides:
            raise InvalidInputError(f"reachability: sides is empty; choose from {list(SIDES)}")
        object.__setattr__(self, "sides", sides)
        self._gripper()

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Try the gripper at each object. ``per_object`` (B, N) and the flag ``reachable`` mark the reached objects.

        Terms: ``free_objects``, ``reachable_objects``, and ``from_<side>``, the number reached from each side.
        """
        from scene_envs.datasets.prompts import viewer_axes
        from scene_envs.physics.grasping import reachable

        approach = {"above": (0.0, 0.0, 1.0), "front": tuple(viewer_axes(batch.scene_type)[1].tolist())}
        found = reachable(batch, [approach[side] for side in self.sides], self._gripper())
        found &= batch.is_free & batch.in_workspace
        reached = found.any(dim=0)
        free, number = batch.is_free.sum(dim=-1).float(), reached.sum(dim=-1).float()
        terms = {f"from_{side}": found[index].sum(dim=-1).float() for index, side in enumerate(self.sides)}
        return RewardOutput(
            value=number / free.clamp(min=1),
            per_object=reached.float(),
            terms={"free_objects": free, "reachable_objects": number, **terms},
            object_flags={"reachable": reached},
        )

    def _gripper(self) -> Gripper:
        from scene_envs.physics.grasping import Gripper

        reaches = (min(0.03, self.finger_length), min(0.01, self.finger_length))
        palm = (max(0.2, self.opening + 0.04), 0.06)
        return Gripper(self.opening, self.finger_length, palm=palm, reaches=reaches)
