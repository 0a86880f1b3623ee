"""Projection: the nearest translations at which no two objects overlap, rotations kept.

With rotations fixed, "this part lies on that side of a plane with normal d" is exactly linear in the
translations. Each object pair that overlaps is given a way out, the shortest straight one; the planes that
separate its parts *there* are consistent with each other, so a thin wall that is straddled cannot ask for
opposite moves. The nearest point under all planes is a least-distance problem, solved exactly, with slack that
costs far more than distance, so that a crowded scene has a best effort. Exact depths have the last word after every
round. Once nothing overlaps, planes are chosen anew at the solution, which can only shorten the way, until it does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scene_envs.physics.collision import Collider
from scene_envs.physics.placement import Objects
from scene_envs.physics.planes import Planes, near_pairs, nearest, separating_planes
from scene_envs.physics.ways_out import Tried, ways_out

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]

TOLERANCE = 1e-4
"""Depth (m) up to which a projected scene counts as free of overlap."""
_ROUNDS = 30
"""Rounds until what still overlaps is left as it is,"""
_PATIENCE = 10
"""or rounds without any improvement."""
_REFINEMENTS = 8
"""Rounds spent on shortening the way of a scene that is free of overlap."""
_GAIN = 0.005
"""Relative decrease of the squared way that makes another refinement worth it."""
_NEGLIGIBLE = 1e-8
"""Sum of squared ways (m^2) that is not worth shortening."""
_INSIDE = 1e-5
"""Objects stay this far (m) inside the workspace, so that rounding does not take them out."""
_OUTSIDE = 0.05
"""Objects further than this (m) outside the workspace are no part of the scene's arrangement and stay there."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Translations (n, 3) m after projection, and the deepest overlap that is left, m."""

    translation: Array
    residual_depth: float


def project_objects(collider: Collider, objects: Objects, workspace: Corners) -> Projection:
    """Project the objects of one scene.

    Args:
        collider: geometry, and measures overlap.
        objects: one scene; fixed objects do not move.
        workspace: lowest and highest corner (m) for the translations of objects in it or close to it.
    """
    home = objects.translation
    bounds = _bounds(home, objects, workspace)
    walls = _walls(bounds)
    best, best_way, least = Projection(home, np.inf), np.inf, np.inf
    tried: Tried = {}
    current = replace(objects, translation=nearest(objects, home, walls))
    refinements = waited = 0
    for _ in range(_ROUNDS):
        first, second, residual, total = _overlapping(collider, current)
        way = float(((current.translation - home) ** 2).sum())
        is_free = residual <= 0.5 * TOLERANCE
        gain = best_way - way
        waited += 1
        if total < least and not is_free and best_way == np.inf:
            best, least, waited = Projection(current.translation, residual), total, 0
        elif is_free and way < best_way:
            best, best_way = Projection(current.translation, residual), way
        if is_free:
            refinements += 1
            if refinements > _REFINEMENTS or way < _NEGLIGIBLE or gain < _GAIN * way:
                break
        elif waited > _PATIENCE:
            break
        elif best_way < np.inf:
            break  # a refinement that ran into something else: what was free of overlap stands
        current = replace(current, translation=_round(collider, current, home, first, second, bounds, walls, tried))
    return best


def _round(
    collider: Collider,
    current: Objects,
    home: Array,
    first: Index,
    second: Index,
    bounds: tuple[Array, Array],
    walls: Planes,
    tried: Tried,
) -> Array:
    """The next translations: overlapping pairs (``first``, ``second``) on their way out, all others kept apart."""
    near_first, near_second = near_pairs(collider, current)
    extra = np.zeros((len(near_first), 3))
    if len(first):
        count = len(current)
        out = ways_out(collider, current, first, second, bounds, tried)
        place_of = np.searchsorted(near_first * count + near_second, first * count + second)
        extra[place_of] = out
    planes = separating_planes(collider, current, near_first, near_second, extra, home)
    return nearest(current, home, planes + walls)


def _overlapping(collider: Collider, objects: Objects) -> tuple[Index, Index, float, float]:
    """Object pairs whose fine parts overlap beyond the tolerance, the deepest overlap, and the sum of them all."""
    pairs = collider.pairs(objects)
    deep = pairs.depth > 0.5 * TOLERANCE
    return pairs.first[deep], pairs.second[deep], float(pairs.depth.max(initial=0.0)), float(pairs.depth.sum())


def _bounds(home: Array, objects: Objects, workspace: Corners) -> tuple[Array, Array]:
    """Lowest and highest translations (n, 3); none for fixed objects and for those far outside."""
    low, high = np.array(workspace[0]), np.array(workspace[1])
    loose = objects.fixed | ((home < low - _OUTSIDE) | (home > high + _OUTSIDE)).any(axis=1)
    return np.where(loose[:, None], -np.inf, low + _INSIDE), np.where(loose[:, None], np.inf, high - _INSIDE)


def _walls(bounds: tuple[Array, Array]) -> Planes:
    """The bounds as half-spaces."""
    low, high = (np.nonzero(np.isfinite(limit)) for limit in bounds)
    row, axis = np.concatenate([low[0], high[0]]), np.concatenate([low[1], high[1]])
    sign = np.repeat([1.0, -1.0], [len(low[0]), len(high[0])])
    limits = np.concatenate([bounds[0][low], -bounds[1][high]])
    direction = np.zeros((len(row), 3))
    direction[np.arange(len(row)), axis] = sign
    return Planes(np.full(len(row), -1, dtype=np.int64), row, direction, limits)
