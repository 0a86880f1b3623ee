"""Projection: the nearest translations at which no two objects overlap, rotations kept.

With rotations fixed, the condition that a part lies on one side of a plane with a given normal is exactly linear in the
translations. Each object pair that overlaps gets a minimum translation. The planes that separate its parts after this
translation are consistent with each other, so an object that straddles a thin wall cannot get opposite moves. The
nearest translations that satisfy all planes solve a least-distance problem. Its slack costs far more than distance, so
a crowded scene still has a best-effort solution. Exact depths check the result of every round. Once nothing overlaps,
planes are chosen anew at the solution as long as this shortens the distance moved.

The rounds end when their work budget is spent. Objects that still overlap then are spread to free places, and the
rounds continue from there. Heaps of objects are spread before the first round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.budget import Budget
from scene_envs.physics.collision import Collider, corner_tests
from scene_envs.physics.minimum_translation import Tried, minimum_translations
from scene_envs.physics.placement import Objects
from scene_envs.physics.planes import Planes, near_pairs, nearest, separating_planes
from scene_envs.physics.spreading import heaps, spread

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]

TOLERANCE = 1e-4
"""Depth (m) up to which a projected scene counts as free of overlap."""
WORK = 10_000.0
"""Units of work (pairs of convex parts, or rows solved) until a search ends."""
SEARCHES = 5
"""Limit of searches per scene: the first from the given poses, the others after overlapping objects were spread."""
_OVERLAPPING = 2_000_000
"""Limit of corner tests in overlapping object pairs; more are too much work for minimum translations."""
_ROUNDS = 30
"""Largest number of rounds of a search; objects that still overlap after them are not moved further."""
_PATIENCE = 10
"""A search also ends after more rounds than this without any improvement."""
_REFINEMENTS = 8
"""Largest number of rounds spent on shortening the distances moved in a scene that is free of overlap."""
_GAIN = 0.005
"""Relative decrease of the squared distances moved from which another refinement is made."""
_NEGLIGIBLE = 1e-8
"""Sum of squared distances moved (m^2) below which no refinement is made."""
_INSIDE = 1e-5
"""Objects stay this far (m) inside the workspace, so that rounding does not take them out."""
_OUTSIDE = 0.05
"""Objects further than this (m) outside the workspace are no part of the arrangement and are not moved back inside."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Translations of one scene's objects after projection."""

    translation: Array  # (n, 3) m
    residual_depth: float  # deepest overlap that is left, m
    total_depth: float  # sum of the overlaps of object pairs that are left, m
    overlapping: Mask  # (n,) bool, objects that still overlap another one
    heap: bool = False  # whether the objects were a heap, which was spread before the first round


def project_objects(collider: Collider, objects: Objects, workspace: Corners) -> Projection:
    """Project the objects of one scene.

    Args:
        collider: Geometry of the assets, and the measure of overlap.
        objects: Objects of one scene; fixed ones do not move.
        workspace: Lowest and highest corner (m) for the translations of objects in it or close to it.
    """
    home = objects.translation
    bounds = _bounds(home, objects, workspace)
    chosen, start, best = heaps(collider, objects), objects, None
    wanted, heap = home, bool(chosen.any())
    for _ in range(SEARCHES):
        if chosen.any():
            wanted = np.where(chosen[:, None], spread(collider.library, start, chosen, home, bounds), wanted)
        found = replace(_search(collider, replace(objects, translation=wanted), bounds), heap=heap)
        if best is None or found.total_depth < best.total_depth:
            best = found
        if found.residual_depth <= TOLERANCE:
            return found
        chosen, start = found.overlapping & ~objects.fixed, replace(objects, translation=found.translation)
    assert best is not None
    return best


def separated(
    collider: Collider, objects: Objects, first: Index, second: Index, workspace: Corners, cost: Array
) -> Array:
    """Translations (n, 3) after one round of projection of overlapping objects and their neighbours.

    A heap of objects, which would take too much work, is not changed.

    Args:
        collider: Geometry of the assets.
        objects: Objects of one scene; fixed ones do not move.
        first, second: (P,) object rows of the pairs that overlap.
        workspace: Lowest and highest corner (m) for the translations.
        cost: (3,) cost of a metre along each axis of the world; the cheapest way out of an overlap is taken.
    """
    if not len(first) or corner_tests(collider.library, objects, first, second).sum() > _OVERLAPPING:
        return objects.translation
    near_first, near_second = near_pairs(collider, objects)
    overlapping = np.concatenate([first, second])
    kept = np.isin(near_first, overlapping) | np.isin(near_second, overlapping)
    # Fixed objects are always among them: boards above limit how far an object can be lifted.
    rows = np.unique(np.concatenate([near_first[kept], near_second[kept], np.flatnonzero(objects.fixed)]))
    some = objects[rows]
    one, other = np.searchsorted(rows, first), np.searchsorted(rows, second)
    near = np.searchsorted(rows, near_first[kept]), np.searchsorted(rows, near_second[kept])
    bounds = _bounds(some.translation, some, workspace)
    home, walls, budget = some.translation, _walls(bounds), Budget(WORK)
    result = objects.translation.copy()
    result[rows] = _round(collider, some, home, one, other, near, bounds, walls, {}, budget, cost)
    return result


def _search(collider: Collider, objects: Objects, bounds: tuple[Array, Array]) -> Projection:
    """The nearest translations without overlap that a bounded number of rounds finds."""
    home, walls, budget = objects.translation, _walls(bounds), Budget(WORK)
    best, best_way = None, np.inf
    waited = refinements = 0
    tried: Tried = {}
    current = replace(objects, translation=nearest(objects, home, walls, budget))
    for _ in range(_ROUNDS):
        first, second, measured = _measure(collider, current, budget)
        way = float(((current.translation - home) ** 2).sum())
        is_free = measured.residual_depth <= 0.5 * TOLERANCE
        gain = best_way - way
        waited += 1
        if best is None or (measured.total_depth < best.total_depth and not is_free and best_way == np.inf):
            best, waited = measured, 0
        if is_free and way < best_way:
            best, best_way = measured, way
        if is_free:
            refinements += 1
            if refinements > _REFINEMENTS or way < _NEGLIGIBLE or gain < _GAIN * way:
                break
        elif waited > _PATIENCE:
            break
        elif best_way < np.inf:
            break  # a refinement led to another overlap: the last result without overlap is kept
        if budget.is_spent or corner_tests(collider.library, current, first, second).sum() > _OVERLAPPING:
            break
        near = near_pairs(collider, current)
        translation = _round(collider, current, home, first, second, near, bounds, walls, tried, budget)
        current = replace(current, translation=translation)
    assert best is not None
    inside = _inside(best.translation, bounds)
    return best if inside is best.translation else _measure(collider, replace(objects, translation=inside), budget)[2]


def _round(
    collider: Collider,
    current: Objects,
    home: Array,
    first: Index,
    second: Index,
    near: tuple[Index, Index],
    bounds: tuple[Array, Array],
    walls: Planes,
    tried: Tried,
    budget: Budget,
    cost: Array | None = None,
) -> Array:
    """The next translations: they free overlapping pairs (``first``, ``second``) and keep other ``near`` ones apart."""
    near_first, near_second = near
    extra = np.zeros((len(near_first), 3))
    if len(first):
        count = len(current)
        moves = minimum_translations(collider, current, first, second, bounds, tried, budget, cost)
        place_of = np.searchsorted(near_first * count + near_second, first * count + second)
        extra[place_of] = moves
    planes = separating_planes(collider, current, near_first, near_second, extra, home, budget)
    return nearest(current, home, planes + walls, budget, cost)


def _measure(collider: Collider, objects: Objects, budget: Budget) -> tuple[Index, Index, Projection]:
    """Object pairs whose fine parts overlap deeper than half the tolerance, and the overlap of the whole scene."""
    pairs = collider.pairs(objects)
    budget.spend(len(pairs.contacts.gap))
    deep = pairs.depth > 0.5 * TOLERANCE
    first, second = pairs.first[deep], pairs.second[deep]
    overlapping = np.isin(np.arange(len(objects)), np.concatenate([first, second]))
    residual, total = float(pairs.depth.max(initial=0.0)), float(pairs.depth.sum())
    return first, second, Projection(objects.translation, residual, total, overlapping)


def _bounds(home: Array, objects: Objects, workspace: Corners) -> tuple[Array, Array]:
    """Lowest and highest translations (n, 3); infinite for fixed objects and for objects far outside."""
    low, high = np.array(workspace[0]), np.array(workspace[1])
    loose = objects.fixed | ((home < low - _OUTSIDE) | (home > high + _OUTSIDE)).any(axis=1)
    return np.where(loose[:, None], -np.inf, low + _INSIDE), np.where(loose[:, None], np.inf, high - _INSIDE)


def _inside(translation: Array, bounds: tuple[Array, Array]) -> Array:
    """The translations; if slack let some leave the workspace, they are put back."""
    clipped = np.clip(translation, *bounds)
    return clipped if (np.abs(clipped - translation) > 0.9 * _INSIDE).any() else translation


def _walls(bounds: tuple[Array, Array]) -> Planes:
    """The bounds as half-spaces."""
    low, high = (np.nonzero(np.isfinite(limit)) for limit in bounds)
    row, axis = np.concatenate([low[0], high[0]]), np.concatenate([low[1], high[1]])
    sign = np.repeat([1.0, -1.0], [len(low[0]), len(high[0])])
    limits = np.concatenate([bounds[0][low], -bounds[1][high]])
    direction = np.zeros((len(row), 3))
    direction[np.arange(len(row)), axis] = sign
    return Planes(np.full(len(row), -1, dtype=np.int64), row, direction, limits)
