"""Collision of objects: overlapping pairs of a scene and their depths, by boxes, face planes and exact depths."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.narrowphase import PenetrationDepth
from scene_envs.physics.pairs import Contacts, ObjectPairs
from scene_envs.physics.placement import Objects, PlacedObjects, object_boxes, part_pairs, place
from scene_envs.physics.separation import separations

TOUCHING = 2e-5
"""Overlap (m) below which the face-plane bound is taken as the depth, and no exact depth is computed."""
NEAR = 3e-3
"""Object pairs are listed when their boxes are at most this far apart (m)."""
NEAR_FIXED = 0.06
"""The same limit in height (m) where one of the two is fixed: the fall of an object onto it has a closed form."""
_TOO_MANY = 20_000_000
"""Limit of corner tests in the overlapping object pairs of one scene; above it, depths are upper bounds."""


class Collider:
    """Search for near and overlapping objects; geometry is built once, poses are arguments."""

    def __init__(self, library: LibraryGeometry) -> None:
        self.library = library
        self.depth = PenetrationDepth([part.vertices for part in library.parts])

    def pairs(self, objects: Objects, *, totals: bool = False) -> ObjectPairs:
        """Near pairs of objects within each of one or more scenes; two fixed objects are never a pair.

        With ``totals`` the depths of all part pairs are summed as well, the literature's per-geometry measure.
        """
        coarse = place(self.library, objects, "coarse")
        low, high = object_boxes(coarse)
        first, second = _near_pairs(objects, low, high)
        contacts, gap, direction, keep = self._coarse_gaps(objects, coarse, first, second)
        first, second, gap, direction = first[keep], second[keep], gap[keep], direction[keep]
        depth, total = np.zeros(len(first)), np.zeros(len(first))
        part_count = np.zeros(len(first), dtype=np.int64)
        overlapping = np.flatnonzero(gap < 0)
        rough = np.zeros(len(first), dtype=bool)
        if len(overlapping):
            a, b = first[overlapping], second[overlapping]
            tests = np.bincount(objects.scene[a], weights=corner_tests(self.library, objects, a, b))
            rough[overlapping] = tests[objects.scene[a]] > _TOO_MANY
            depth[rough] = -gap[rough]
            exact = overlapping[~rough[overlapping]]
            self._fine_depths(objects, first, second, exact, gap, depth, total, part_count, totals)
        return ObjectPairs(first, second, gap, direction, depth, total, part_count, low, high, contacts, rough)

    def contacts(self, objects: Objects, pairs: ObjectPairs, fine: Mask) -> Contacts:
        """Near parts of the ``pairs`` of objects: fine parts for the pairs in ``fine`` (P,), coarse ones for others."""
        if not fine.any():
            return pairs.contacts
        count = len(objects)
        first, second = pairs.first[fine], pairs.second[fine]
        coarse = ~np.isin(pairs.contacts.first * count + pairs.contacts.second, first * count + second)
        used, local = np.unique(np.concatenate([first, second]), return_inverse=True)
        placed = place(self.library, objects[used], "fine")
        pair, a, b = part_pairs(placed, local[: len(first)], local[len(first) :])
        return pairs.contacts[coarse] + self._near_parts(objects, placed, first, second, pair, a, b)[0]

    def _near_parts(
        self, objects: Objects, placed: PlacedObjects, first: Index, second: Index, pair: Index, a: Index, b: Index
    ) -> tuple[Contacts, Index]:
        """Contacts among the part pairs (``a``, ``b``) of object pairs, and the object pair of each."""
        fixed = (objects.fixed[first] | objects.fixed[second])[pair]
        near = np.flatnonzero(_boxes_near(placed.low, placed.high, a, b, NEAR, fixed))
        pair, a, b = pair[near], a[near], b[near]
        gap, direction = separations(self.library, placed.parts, a, b)
        part = placed.parts.part
        return Contacts(first[pair], second[pair], part[a], part[b], gap, direction), pair

    def _coarse_gaps(
        self, objects: Objects, coarse: PlacedObjects, first: Index, second: Index
    ) -> tuple[Contacts, Array, Array, Index]:
        pair, a, b = part_pairs(coarse, first, second)
        contacts, pair = self._near_parts(objects, coarse, first, second, pair, a, b)
        gap = np.full(len(first), np.inf)
        direction = np.zeros((len(first), 3))
        order = np.lexsort((contacts.gap, pair))
        keep, leading = np.unique(pair[order], return_index=True)
        best = order[leading]
        gap[keep], direction[keep] = contacts.gap[best], contacts.direction[best]
        return contacts, gap, direction, keep

    def _fine_depths(
        self,
        objects: Objects,
        first: Index,
        second: Index,
        overlapping: Index,
        gap: Array,
        depth: Array,
        total: Array,
        part_count: Index,
        totals: bool,
    ) -> None:
        # The depth of objects that barely touch is the bound from the face planes of the enclosing coarse parts.
        # Sums over part pairs need the fine parts, unless each of the two objects has only one.
        single = np.array([len(asset.fine.parts) == 1 for asset in self.library.assets])
        simple = gap > -TOUCHING
        if totals:
            simple &= single[objects.category[first]] & single[objects.category[second]]
        settled = overlapping[simple[overlapping]]
        depth[settled] = total[settled] = -gap[settled]
        part_count[settled] = 1
        hard = overlapping[~simple[overlapping]]
        if not len(hard):
            return
        used, local = np.unique(np.concatenate([first[hard], second[hard]]), return_inverse=True)
        fine = place(self.library, objects[used], "fine")
        pair, a, b = part_pairs(fine, local[: len(hard)], local[len(hard) :])
        near = _boxes_near(fine.low, fine.high, a, b, 0.0)
        pair, a, b = pair[near], a[near], b[near]
        bound, _ = separations(self.library, fine.parts, a, b)
        bound = -bound
        deep = bound > 0
        pair, a, b, bound = pair[deep], a[deep], b[deep], bound[deep]
        order = np.lexsort((-bound, pair))
        a, b, bound, target = a[order], b[order], bound[order], hard[pair[order]]
        for rows in _rounds(target, bound, depth, totals):
            value = bound[rows]
            ask = np.flatnonzero(value > TOUCHING)
            exact, _ = self.depth(fine.parts, a[rows[ask]], b[rows[ask]])
            value[ask] = np.minimum(value[ask], exact)
            meet = value > 0
            np.maximum.at(depth, target[rows[meet]], value[meet])
            np.add.at(total, target[rows[meet]], value[meet])
            np.add.at(part_count, target[rows[meet]], 1)


def corner_tests(library: LibraryGeometry, objects: Objects, first: Index, second: Index) -> Array:
    """(P,) work to test each pair: corners of one object's parts times face directions of the other's, both ways."""
    corners, directions = library.corners[objects.category], library.directions[objects.category]
    return (corners[first] * directions[second] + directions[first] * corners[second]).astype(np.float64)


def _rounds(target: Index, bound: Array, depth: Array, every: bool) -> Iterator[Index]:
    """Rows of candidates that can still deepen their object pair; twice as many per pair in each round.

    Args:
        target: (Q,) object pair of each candidate, those of one pair together.
        bound: (Q,) m, upper bound of each candidate's depth; descending within a pair.
        depth: (P,) m, depths found so far; the caller updates them between rounds.
        every: Whether to give all candidates at once.
    """
    rows = np.arange(len(target))
    if every:
        yield rows
        return
    leading = np.diff(target, prepend=-1) != 0
    rank = rows - rows[leading][np.cumsum(leading) - 1]
    size = 1
    while len(rows):
        now = rank[rows] < 2 * size - 1
        yield rows[now]
        rows, size = rows[~now], 2 * size
        rows = rows[bound[rows] > depth[target[rows]]]


def _boxes_near(low: Array, high: Array, a: Index, b: Index, margin: float, fixed: Mask | None = None) -> Mask:
    height = margin if fixed is None else np.where(fixed, NEAR_FIXED, margin)
    near = (low[a, 0] <= high[b, 0] + margin) & (low[b, 0] <= high[a, 0] + margin)
    near &= (low[a, 1] <= high[b, 1] + margin) & (low[b, 1] <= high[a, 1] + margin)
    near &= (low[a, 2] <= high[b, 2] + height) & (low[b, 2] <= high[a, 2] + height)
    return near


@lru_cache(maxsize=512)
def _upper_triangle(count: int) -> tuple[Index, Index]:
    first, second = np.triu_indices(count, k=1)
    return first.astype(np.int64), second.astype(np.int64)


def scene_pairs(objects: Objects) -> tuple[Index, Index]:
    """All pairs of objects of the same scene, except two fixed ones: (P,), (P,) rows."""
    scenes, starts, counts = np.unique(objects.scene, return_index=True, return_counts=True)
    if not len(scenes):
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    triangles = [_upper_triangle(int(count)) for count in counts]
    first = np.concatenate([t[0] + start for t, start in zip(triangles, starts, strict=True)])
    second = np.concatenate([t[1] + start for t, start in zip(triangles, starts, strict=True)])
    free = ~(objects.fixed[first] & objects.fixed[second])
    return first[free], second[free]


def _near_pairs(objects: Objects, low: Array, high: Array) -> tuple[Index, Index]:
    first, second = scene_pairs(objects)
    near = _boxes_near(low, high, first, second, NEAR, objects.fixed[first] | objects.fixed[second])
    return first[near], second[near]
