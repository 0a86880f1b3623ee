"""Mask generators of the search: which slots of a scene the next inpaintings regenerate."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from scene_envs.envs.scoring import Score
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.plugins import plugin_entry_points
from scene_envs.scene import SceneBatch

MaskGenerator = Callable[[SceneBatch, Score, np.random.Generator], Tensor]
"""``(scene, score, rng) -> (N,) bool``, True where a slot is regenerated.

``scene`` is a batch of one, ``score`` the objective's verdict on it with its credit and flags per object, and ``rng``
the only source of randomness. Slots of welded objects are taken out afterwards.
"""

ENTRY_POINT_GROUP = "scene_envs.masks"
"""Packages offer mask generators under this group: an entry named after the mask, whose value is a MaskGenerator."""

MAX_PENETRATION = 1e-3
"""Object pairs that overlap deeper than this (m) count, as in feasibility."""

Generator = TypeVar("Generator", bound=MaskGenerator)

_MASKS: dict[str, MaskGenerator] = {}


def register_mask(name: str) -> Callable[[Generator], Generator]:
    """Make a mask generator available as ``mask=name``; the same name again replaces it.

    Raises:
        InvalidInputError: the name is not one word, or what is decorated cannot be called.

    >>> @register_mask("doctest_empty")
    ... def empty_slots(scene, score, rng):
    ...     return scene.is_empty[0]
    >>> "doctest_empty" in list_masks()
    True
    """
    if not name.isidentifier():
        raise InvalidInputError(f"mask name {name!r}: use letters, digits and underscores, such as 'top_shelf'")

    def register(generator: Generator) -> Generator:
        if not callable(generator):
            raise InvalidInputError(f"mask {name!r}: {generator!r} cannot be called; give (scene, score, rng) -> mask")
        _MASKS[name] = generator
        return generator

    return register


def list_masks() -> list[str]:
    """Names of all mask generators, those of installed packages included, sorted."""
    return sorted({*_MASKS, *plugin_entry_points(ENTRY_POINT_GROUP)})


def resolve_mask(mask: Any) -> MaskGenerator:
    """A mask generator from its name, or a function of that form.

    Raises:
        UnknownNameError: no mask generator has that name; the nearest known one is offered.
        InvalidInputError: neither a name nor a function.
    """
    if isinstance(mask, str):
        if mask in _MASKS:
            return _MASKS[mask]
        plugins = plugin_entry_points(ENTRY_POINT_GROUP)
        if mask not in plugins:
            raise unknown_name("mask generator", mask, list_masks())
        return register_mask(mask)(plugins[mask].load())
    if callable(mask):
        return mask  # type: ignore[no-any-return]
    raise InvalidInputError(f"mask={mask!r}: give a name ({', '.join(list_masks())}) or a function")


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


@register_mask("infeasible")
def infeasible_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """The blamed objects and all empty slots; a random half when that is nothing, or when no object is blamed."""
    bad = bad_objects(scene, score)
    if bad is None:
        return random_mask(scene, score, rng)
    mask = bad | scene.is_empty[0]
    return mask if bool(mask.any()) else random_mask(scene, score, rng)


@register_mask("random")
def random_mask(scene: SceneBatch, score: Score, rng: np.random.Generator) -> Tensor:
    """A random half of the free objects (rounded up), and all empty slots."""
    free = torch.nonzero(scene.is_free[0]).flatten().numpy()
    chosen = rng.choice(free, size=(len(free) + 1) // 2, replace=False)
    mask = scene.is_empty[0].clone()
    mask[torch.from_numpy(chosen)] = True
    return mask


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
    from scene_envs.physics import penetration  # with the physics libraries, which other masks spare

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


register_mask("culprits")(CulpritsMask())
