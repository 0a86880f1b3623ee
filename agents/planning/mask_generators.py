"""Mask generators for search that look at overlaps: keep as many good objects as possible."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.masks import (
    MASK_GENERATORS,
    MaskGenerator,
    bad_objects,
    resolve_mask_generator,
)
from scene_envs.envs.scoring import Score
from scene_envs.errors import unknown_name
from scene_envs.scene import SceneBatch

MAX_PENETRATION = 1e-3
"""Object pairs that overlap deeper than this (m) count, as in feasibility."""


@dataclass(frozen=True)
class CulpritsMask:
    """The fewest objects whose replacement ends all overlaps, and a few empty slots.

    An objective that counts feasible objects blames both objects of an overlapping pair; replacing one of them is
    enough. Objects that overlap most others go first, until no kept pair overlaps. Blamed objects that overlap nothing
    (they fall or slide) go too. Where that is fewer than ``at_least`` slots, random empty ones join, so that good
    scenes can grow. An objective that says nothing about single objects gets ``at_least`` random slots.

    Few slots at a time matter. While the noise is high the kept objects are hidden in it too, so the masked slots take
    their usual share of objects whatever is already there: with all empty slots masked, inpainting by clamping crowds
    the scene and spoils what was kept.

    Args:
        at_least: slots regenerated, when the scene has as many.

    A scene without free objects is regenerated whole.
    """

    at_least: int = 4

    def __call__(self, scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
        """(N,) bool, True where a slot is regenerated.

        Args:
            scene: a batch of one.
            score: the objective's verdict on it.
            rng: breaks ties and draws slots.
        """
        free, empty = scene.is_free[0], scene.is_empty[0]
        if not bool(free.any()):
            return empty.clone()
        bad = bad_objects(scene, score)
        mask = torch.zeros_like(empty)
        if bad is None:
            mask[self._draw(free | empty, self.at_least, rng)] = True
            return mask
        mask[_culprits(scene, bad, rng)] = True
        for more in (empty, free):
            mask[self._draw(more & ~mask, self.at_least - int(mask.sum()), rng)] = True
        return mask

    @staticmethod
    def _draw(candidates: Tensor, count: int, rng: np.random.Generator) -> list[int]:
        slots = torch.nonzero(candidates).flatten().tolist()
        chosen: list[int] = rng.permutation(slots)[: max(0, count)].astype(int).tolist()
        return chosen


def _culprits(scene: SceneBatch, bad: Tensor, rng: np.random.Generator) -> list[int]:
    """Slots of blamed objects (``bad``, (N,) bool), less those that are fine once others are gone."""
    from scene_envs.physics import penetration

    blamed = torch.nonzero(bad).flatten().tolist()
    if not blamed:
        return []
    pairs = [pair.slots for pair in penetration(scene).pairs[0] if pair.depth > MAX_PENETRATION]
    overlapping = {slot for pair in pairs for slot in pair}
    welded = set(torch.nonzero(scene.is_welded[0]).flatten().tolist())
    return cover(pairs, welded, rng) + [slot for slot in blamed if slot not in overlapping]


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


SEARCH_MASKS: dict[str, MaskGenerator] = {**MASK_GENERATORS, "culprits": CulpritsMask()}
"""Mask generators that a search run knows by name: the environment's own and those of this module."""


def search_mask(mask: Any) -> MaskGenerator:
    """A mask generator from its name or a function; raises UnknownNameError with the nearest known name."""
    if isinstance(mask, str):
        if mask not in SEARCH_MASKS:
            raise unknown_name("mask generator", mask, SEARCH_MASKS)
        return SEARCH_MASKS[mask]
    return resolve_mask_generator(mask)
