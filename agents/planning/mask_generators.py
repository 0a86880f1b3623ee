"""Mask generators for search that look at overlaps: keep as many good objects as possible."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.env_reward import Score
from scene_envs.errors import unknown_name
from scene_envs.scene import SceneBatch
from scene_envs.search_masks import (
    MASK_GENERATORS,
    MaskGenerator,
    bad_objects,
    infeasible_mask,
    resolve_mask_generator,
)

MAX_PENETRATION = 1e-3
"""Object pairs that overlap deeper than this (m) count, as in feasibility."""


def culprits_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """The fewest objects whose removal leaves the others without overlap, and all empty slots.

    An objective that counts feasible objects blames both objects of an overlapping pair; regenerating one of them is
    enough. Objects that overlap most others are taken out first, until no pair of kept ones overlaps. Objects that
    are blamed and overlap nothing (they fall or slide) are regenerated too. Falls back to
    :func:`~scene_envs.search_masks.infeasible_mask` when nothing is blamed.

    Args:
        scene: a batch of one.
        score: the objective's verdict on it.
        rng: breaks ties.

    Returns:
        (N,) bool, True where a slot is regenerated.
    """
    from scene_envs.physics import penetration

    bad = bad_objects(scene, score)
    if bad is None or not bool(bad.any()):
        return infeasible_mask(scene, score, rng)
    pairs = [pair.slots for pair in penetration(scene).pairs[0] if pair.depth > MAX_PENETRATION]
    overlapping = {slot for pair in pairs for slot in pair}
    welded = set(torch.nonzero(scene.is_welded[0]).flatten().tolist())
    alone = [slot for slot in torch.nonzero(bad).flatten().tolist() if slot not in overlapping]
    mask = scene.is_empty[0].clone()
    mask[cover(pairs, welded, rng) + alone] = True
    return mask


def cover(pairs: Sequence[tuple[int, int]], fixed: Collection[int], rng: np.random.Generator) -> list[int]:
    """Few slots, none of them ``fixed``, that touch every pair: greedy vertex cover, ties broken by ``rng``.

    >>> cover([(1, 2), (2, 3), (2, 4)], (), np.random.default_rng(0))
    [2]
    >>> cover([(0, 1), (0, 2)], {0}, np.random.default_rng(0))
    [1, 2]
    """
    chosen = {slot for pair in pairs for slot in pair if slot not in fixed and not set(pair).isdisjoint(fixed)}
    left = [pair for pair in pairs if chosen.isdisjoint(pair)]
    while left:
        slots, counts = np.unique(left, return_counts=True)
        slot = int(rng.choice(slots[counts == counts.max()]))
        chosen.add(slot)
        left = [pair for pair in left if slot not in pair]
    return sorted(chosen)


SEARCH_MASKS: dict[str, MaskGenerator] = {**MASK_GENERATORS, "culprits": culprits_mask}
"""Mask generators that a search run knows by name: the environment's own and those of this module."""


def search_mask(mask: Any) -> MaskGenerator:
    """A mask generator from its name or a function; raises UnknownNameError with the nearest known name."""
    if isinstance(mask, str):
        if mask not in SEARCH_MASKS:
            raise unknown_name("mask generator", mask, SEARCH_MASKS)
        return SEARCH_MASKS[mask]
    return resolve_mask_generator(mask)
