"""Search MDP with a choice of masks: an action chooses one of K masks and one of B inpaintings of its slots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import torch
from torch import Tensor

from scene_envs.envs.masks import MaskGenerator
from scene_envs.envs.scoring import Score
from scene_envs.envs.search import SearchProblem, SearchState
from scene_envs.envs.settings import SearchMaskSettings, takes
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


@dataclass(frozen=True, eq=False)
class MaskChoiceState(SearchState):
    """A partial scene with K masks to choose from; ``mask`` is the union of them.

    Attributes:
        masks: (K, N) bool, slots that each mask regenerates.
    """

    masks: Tensor = field(kw_only=True)

    def __eq__(self, other: object) -> bool:
        same = super().__eq__(other)
        return same and torch.equal(self.masks, cast(MaskChoiceState, other).masks)

    __hash__ = SearchState.__hash__


class MaskChoiceProblem(SearchProblem):
    """The tree of partial scenes in which an action also chooses the mask of slots to regenerate.

    Action ``k * branching + j`` is inpainting j of mask k. It is legal where mask k has a slot. With a single mask
    the tree equals that of a :class:`~scene_envs.envs.search.SearchProblem` with this mask, bit for bit.

    Args:
        **settings: Fields of :class:`~scene_envs.envs.settings.SearchMaskSettings`.

    Attributes:
        mask_names: Names of the K masks, in the order of the actions.

    >>> problem = MaskChoiceProblem(objective="object_count", num_steps=2, masks=["empty", "random"], branching=2)
    >>> root = problem.root(seed=0)
    >>> list(problem.legal_actions(root)), tuple(root.masks.shape)
    ([0, 2, 1, 3], (2, 34))
    """

    state_type = MaskChoiceState

    @takes(SearchMaskSettings)
    def __init__(self, **settings: Any) -> None:
        chosen = SearchMaskSettings(**settings)
        self._begin(chosen)
        self.mask_generators: list[MaskGenerator] = [self._resolve_mask(mask) for mask in chosen.masks]
        self.mask_names = tuple(_name(mask) for mask in chosen.masks)
        self.num_actions = len(self.mask_generators) * self.branching

    def mask_of(self, state: SearchState, action: int) -> Tensor:
        """(N,) bool, the slots that ``action`` regenerates in ``state``."""
        return self.masks_of(state)[action // self.branching]

    def masks_of(self, state: SearchState) -> Tensor:
        """(K, N) bool, the slots that each mask regenerates in ``state``."""
        return cast(MaskChoiceState, state).masks

    def _open_actions(self, state: SearchState) -> Sequence[int]:
        """One inpainting of every mask before the second of any, so that the first few actions try all masks."""
        masks = torch.nonzero(self.masks_of(state).any(dim=1)).flatten().tolist()
        return [mask * self.branching + child for child in range(self.branching) for mask in masks]

    def _check_legal(self, state: SearchState, action: int) -> None:
        super()._check_legal(state, action)
        if not bool(self.mask_of(state, action).any()):
            name = self.mask_names[action // self.branching]
            raise InvalidInputError(
                f"action={action}: mask {name!r} has no slot in the state at path {state.path}; legal actions are "
                f"{sorted(self.legal_actions(state))}"
            )

    def _masks(self, scene: SceneBatch, score: Score, seed: int, path: tuple[int, ...]) -> dict[str, Any]:
        masks = torch.stack([self._mask(generator, scene, score, seed, path) for generator in self.mask_generators])
        return {"mask": masks.any(dim=0), "masks": masks}


def _name(mask: Any) -> str:
    """A mask's name as a user gives it; for a function, the function's own name."""
    if isinstance(mask, str):
        return mask
    return str(mask["name"]) if hasattr(mask, "keys") else getattr(mask, "__name__", type(mask).__name__)
