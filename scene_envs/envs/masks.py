"""Mask generators of the search MDP: which slots the next action regenerates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.scoring import Score
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.scene import SceneBatch

MaskGenerator = Callable[[SceneBatch, Score, np.random.Generator], Tensor]
"""``(one scene, its score, rng) -> (N,) bool``; slots of fixed welded objects are taken out afterwards."""


def bad_objects(scene: SceneBatch, score: Score) -> Tensor | None:
    """(N,) bool: free objects that the objective blames, or None when it says nothing about single objects.

    An object is blamed when the objective's flag ``feasible`` is False for it or, lacking that flag, when its
    credit per object is not positive.
    """
    if "feasible" in score.object_flags:
        return scene.is_free[0] & ~score.object_flags["feasible"][0]
    if score.per_object is not None:
        return scene.is_free[0] & (score.per_object[0] <= 0)
    return None


def infeasible_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """The blamed objects and all empty slots; a random half when that is nothing, or when no one is blamed by name."""
    bad = bad_objects(scene, score)
    if bad is None:
        return random_mask(scene, score, rng)
    mask = bad | scene.is_empty[0]
    return mask if bool(mask.any()) else random_mask(scene, score, rng)


def random_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """A random half of the free objects (rounded up), and all empty slots."""
    free = torch.nonzero(scene.is_free[0]).flatten().numpy()
    chosen = rng.choice(free, size=(len(free) + 1) // 2, replace=False)
    mask = scene.is_empty[0].clone()
    mask[torch.from_numpy(chosen)] = True
    return mask


MASK_GENERATORS: dict[str, MaskGenerator] = {"infeasible": infeasible_mask, "random": random_mask}


def resolve_mask_generator(mask: Any) -> MaskGenerator:
    """A mask generator from its name, or a function of that form."""
    if isinstance(mask, str):
        if mask not in MASK_GENERATORS:
            raise unknown_name("mask generator", mask, MASK_GENERATORS)
        return MASK_GENERATORS[mask]
    if callable(mask):
        return mask  # type: ignore[no-any-return]
    raise InvalidInputError(f"mask={mask!r}: give a name ({', '.join(MASK_GENERATORS)}) or a function")
