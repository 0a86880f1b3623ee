"""Spreading of heaps: free places for objects that overlap too much for separating planes, by bounding boxes.

Objects are placed one after the other, the largest first, each at the free place nearest to its wanted place. The
candidates are the places where the object's box touches the boxes around it. They include the nearest free place as
long as the boxes are few. Where boxes are many, only an even selection of places is tested, so that the work is
bounded.
"""

from __future__ import annotations

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import Collider, corner_tests, scene_pairs
from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.placement import Objects, object_boxes, place
from scene_envs.physics.planes import CLEARANCE
from scene_envs.physics.support import components

_HEAP = 3_000_000
"""A group of objects whose boxes meet may be a heap when it takes more corner tests than this."""
_DEEP = 5e-3
"""Such a group is a heap when objects whose boxes have most in common overlap deeper than this (m)."""
_LOOKED_AT = 3
"""Number of object pairs measured for this: those whose common box is the largest share of the smaller box."""
_WINDOWS = (0.3, 1.0, 4.0, 20.0)
"""Half widths (m) of the cubes around a wanted place that are searched, one after the other."""
_BINS = 16
"""Coordinates tested along each axis come from this many equal intervals, at most two from each."""
_FIXED = 1000
"""Overlapping a box of a fixed object counts as much as overlapping this many free objects."""


def heaps(collider: Collider, objects: Objects) -> Mask:
    """(n,) free objects of one scene in groups that overlap so much that exact tests would take too long.

    Objects nested as intended meet as many others but hardly overlap, so they are no heap.
    """
    low, high = object_boxes(place(collider.library, objects, "coarse"))
    first, second = scene_pairs(objects)
    meet = ((low[first] < high[second]) & (low[second] < high[first])).all(axis=1)
    first, second = first[meet], second[meet]
    free = ~objects.fixed
    both = free[first] & free[second]
    group = components(len(objects), first[both], second[both])
    owner = group[np.where(free[first], first, second)]
    tests = np.bincount(owner, weights=corner_tests(collider.library, objects, first, second), minlength=len(objects))
    chosen = np.zeros(len(objects), dtype=bool)
    for number in np.flatnonzero(tests > _HEAP):
        a, b = first[owner == number], second[owner == number]
        common = np.prod(np.minimum(high[a], high[b]) - np.maximum(low[a], low[b]), axis=1)
        smaller = np.minimum(np.prod(high[a] - low[a], axis=1), np.prod(high[b] - low[b], axis=1))
        most = np.argsort(-common / np.maximum(smaller, 1e-12), kind="stable")[:_LOOKED_AT]
        looked_at = objects[np.unique(np.concatenate([a[most], b[most]]))]
        if collider.pairs(looked_at).depth.max(initial=0.0) > _DEEP:
            chosen |= free & (group == number)
    return chosen


def spread(
    library: LibraryGeometry, objects: Objects, chosen: Mask, wanted: Array, bounds: tuple[Array, Array]
) -> Array:
    """Translations (n, 3) m at which the boxes of the chosen objects meet no other box, as far as there is room.

    Args:
        library: Geometry of the assets.
        objects: Objects of one scene; those not chosen stay.
        chosen: (n,) free objects to place anew.
        wanted: (n, 3) wanted translations of the chosen objects, m.
        bounds: Lowest and highest translations (n, 3), (n, 3) m.
    """
    coarse = place(library, objects, "coarse")
    low, high = object_boxes(coarse)
    rows = np.flatnonzero(chosen)
    order = rows[np.argsort(-np.prod(high[rows] - low[rows], axis=1), kind="stable")]
    low_of, high_of = low[order] - objects.translation[order], high[order] - objects.translation[order]
    owner = np.repeat(np.arange(len(objects)), coarse.count)
    boards, others = objects.fixed[owner], ~objects.fixed & ~chosen
    lows = np.concatenate([coarse.low[boards], low[others], np.empty((len(order), 3))])
    highs = np.concatenate([coarse.high[boards], high[others], np.empty((len(order), 3))])
    weight = np.ones(len(lows), dtype=np.int64)
    weight[: int(boards.sum())] = _FIXED
    count = len(lows) - len(order)
    result = objects.translation.copy()
    for row, box_low, box_high in zip(order, low_of, high_of, strict=True):
        limits = (bounds[0][row], bounds[1][row])
        blocked = (lows[:count] - box_high - CLEARANCE, highs[:count] - box_low + CLEARANCE)
        result[row] = _free_place(np.clip(wanted[row], *limits), *blocked, weight[:count], limits)
        lows[count], highs[count] = result[row] + box_low, result[row] + box_high
        count += 1
    return result


def _free_place(wanted: Array, low: Array, high: Array, weight: Index, limits: tuple[Array, Array]) -> Array:
    """The place (3,) near ``wanted`` that lies in the fewest of the blocked open boxes ``low``, ``high`` (M, 3).

    It lies in none of them if there is such a place. A box counts as ``weight`` (M,) boxes.
    """
    found = wanted
    for reach in _WINDOWS:
        start, end = np.maximum(wanted - reach, limits[0]), np.minimum(wanted + reach, limits[1])
        near = ((low < end) & (high > start)).all(axis=1)
        lines = [
            _lines(np.concatenate([low[near, axis], high[near, axis]]), wanted[axis], start[axis], end[axis])
            for axis in range(3)
        ]
        spans = [
            np.column_stack([np.searchsorted(line, low[near, axis], "right"), np.searchsorted(line, high[near, axis])])
            for axis, line in enumerate(lines)
        ]
        crowd = np.zeros([len(line) for line in lines], dtype=np.int32)
        for (x, x_end), (y, y_end), (z, z_end), load in zip(
            *(span.tolist() for span in spans), weight[near].tolist(), strict=True
        ):
            crowd[x:x_end, y:y_end, z:z_end] += load
        x, y, z = ((line - middle) ** 2 for line, middle in zip(lines, wanted, strict=True))
        least = crowd.min()
        way = np.where(crowd == least, x[:, None, None] + y[:, None] + z, np.inf)
        best = np.unravel_index(int(way.argmin()), way.shape)
        found = np.array([line[index] for line, index in zip(lines, best, strict=True)])
        if least == 0:
            break
    return found


def _lines(faces: Array, wanted: float, start: float, end: float) -> Array:
    """Ascending coordinates to test: the wanted one, both ends, and faces between them, thinned evenly."""
    inside = np.sort(faces[(faces > start) & (faces < end)])
    bins = np.minimum((inside - start) / max(end - start, 1e-12) * _BINS, _BINS - 1).astype(np.int64)
    lowest = np.searchsorted(bins, np.arange(_BINS))
    highest = np.searchsorted(bins, np.arange(_BINS), "right") - 1
    used = highest >= lowest
    return np.unique(np.concatenate([[wanted, start, end], inside[lowest[used]], inside[highest[used]]]))
