"""Reward: number of objects of a scene, the paper's objective for clutter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.errors import InvalidInputError
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
        return slots

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Count the slots that are not empty; ``per_object`` (B, N) is 1 for each of them."""
        present = (~batch.is_empty).float()
        return RewardOutput(present.sum(dim=-1), per_object=present)


@register_reward("category_count")
@dataclass(frozen=True)
class CategoryCount:
    """Number of objects in the workspace that belong to the named assets or groups.

    Attributes:
        assets: one or several asset names ("teacup"), display names ("steamer lid") and groups ("edible").

    >>> reward = CategoryCount("furniture")
    >>> reward(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([1.])
    """

    name: ClassVar[str] = "category_count"
    counts_objects: ClassVar[bool] = True
    assets: str | Sequence[str] = "edible"

    def __post_init__(self) -> None:
        names = (self.assets,) if isinstance(self.assets, str) else tuple(str(name) for name in self.assets)
        if not names:
            raise InvalidInputError("category_count: assets is empty; name an asset or a group such as 'edible'")
        object.__setattr__(self, "assets", names)

    def maximum(self, slots: int, free_slots: int) -> float:
        return slots

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Count; ``per_object`` (B, N) is 1 for each object that counts. Term: ``share`` of all objects.

        Raises:
            UnknownNameError: a name is neither an asset of the scene type, nor a display name, nor a group.
        """
        counted = (batch.is_any_of(*self.assets) & batch.in_workspace).float()
        number = counted.sum(dim=-1)
        return RewardOutput(number, per_object=counted, terms={"share": number / batch.counts.clamp(min=1)})
