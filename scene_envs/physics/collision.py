"""Collision of objects: overlapping pairs of a scene and their depths, by boxes, face planes and exact depths."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.mujoco import Overlaps
from scene_envs.physics.parts import LibraryGeometry
from scene_envs.physics.placement import (
    Contacts,
    ObjectPairs,
    Objects,
    PlacedObjects,
    boxes_meet,
    object_boxes,
    part_pairs,
    place,
    separations,
)

TOUCHING = 2e-5
"""Overlap (m) up to which the face-plane bound of coarse parts is taken as the depth; it needs no exact depth."""
NEAR = 3e-3
"""Object pairs are listed when their boxes are at most this far apart (m)."""
NEAR_FIXED = 0.06
"""The same limit in height (m) where one of the two is fixed: the fall of an object onto it has a closed form."""
TOO_MANY = 20_000_000
"""Limit of corner tests in the overlapping object pairs of one scene; above it, depths are upper bounds."""


@dataclass(frozen=True, eq=False)
class ObjectOverlaps:
    """Pairs of objects that overlap, in ascending order."""

    first: Index  # (P,) object rows
    second: Index  # (P,) object rows, larger than ``first``
    depth: Array  # (P,) m, deepest overlap of any two of their fine parts
    total: Array  # (P,) m, sum of the depths of all pairs of their fine parts
    part_count: Index  # (P,) overlapping pairs of fine parts
    unmeasured: Index  # scenes with too many overlaps to be measured; none of their pairs are listed


class Collider:
    """Search for near and overlapping objects; geometry is built once, poses are arguments."""

    def __init__(self, library: LibraryGeometry) -> None:
        self.library = library

    @cached_property
    def _overlaps(self) -> Overlaps:
        bodies = [asset.fine.ids.tolist() for asset in self.library.assets]
        return Overlaps([part.vertices for part in self.library.parts], bodies)

    def pairs(self, objects: Objects) -> ObjectPairs:
        """Near pairs of objects within each of one or more scenes; two fixed objects are never a pair."""
        coarse = place(self.library, objects, "coarse")
        low, high = object_boxes(coarse)
        first, second = scene_pairs(objects)
        near = boxes_near(low, high, first, second, NEAR, objects.fixed[first] | objects.fixed[second])
        first, second = first[near], second[near]
        contacts, pair = self._near_parts(objects, coarse, first, second, *part_pairs(coarse, first, second))
        order = np.lexsort((contacts.gap, pair))
        keep, leading = np.unique(pair[order], return_index=True)
        best = order[leading]  # the contact with the smallest gap of each pair
        first, second, gap, direction = first[keep], second[keep], contacts.gap[best], contacts.direction[best]
        depth, rough = np.zeros(len(first)), np.zeros(len(first), dtype=bool)
        overlapping = np.flatnonzero(gap < 0)
        if len(overlapping):
            a, b = first[overlapping], second[overlapping]
            tests = np.bincount(objects.scene[a], weights=corner_tests(self.library, objects, a, b))
            rough[overlapping] = tests[objects.scene[a]] > TOO_MANY
            touching = overlapping[gap[overlapping] > -TOUCHING]
            depth[touching] = -gap[touching]
            exact = overlapping[~rough[overlapping] & (gap[overlapping] <= -TOUCHING)]
            found = self.overlaps(objects, first[exact], second[exact])
            rough[exact] |= np.isin(objects.scene[first[exact]], found.unmeasured)
            count = len(objects)
            key = first[exact] * count + second[exact]
            depth[exact[np.isin(key, found.first * count + found.second)]] = found.depth
            depth[rough] = -gap[rough]
        return ObjectPairs(first, second, gap, direction, depth, low, high, contacts, rough)

    def overlaps(self, objects: Objects, first: Index, second: Index) -> ObjectOverlaps:
        """Which of the pairs ``first`` (P,), ``second`` (P,) of objects of some scenes overlap, by their fine parts."""
        poses = objects.category, objects.rotation, objects.translation
        one, two, value, unmeasured = self._overlaps(*poses, first, second, objects.scene)
        keys, inverse = np.unique(one * len(objects) + two, return_inverse=True)
        order = np.lexsort((value, inverse))  # sums do not depend on the order of the contacts
        count = np.bincount(inverse, minlength=len(keys))
        total = np.bincount(inverse[order], weights=value[order], minlength=len(keys))
        deepest = value[order][np.cumsum(count) - 1]
        one, two = np.divmod(keys, max(len(objects), 1))
        return ObjectOverlaps(one, two, deepest, np.asarray(total), count, unmeasured)

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

    def may_meet(
        self, objects: Objects, pairs: ObjectPairs, first: Index, second: Index, way: Array, margin: float
    ) -> tuple[Index, Index]:
        """Those of some pairs of objects (P,), (P,) that may come nearer than ``margin`` (m) on the straight ``way``
        (n, 3) m of each object: no face plane of their coarse parts keeps them apart from its start to its end.
        """
        ends = pairs.low + np.minimum(way, 0.0), pairs.high + np.maximum(way, 0.0)
        near = boxes_near(*ends, first, second, NEAR)
        first, second = first[near], second[near]
        used, local = np.unique(np.concatenate([first, second]), return_inverse=True)
        placed = place(self.library, objects[used], "coarse")
        along = np.repeat(way[used], placed.count, axis=0)
        low, high = placed.low + np.minimum(along, 0.0), placed.high + np.maximum(along, 0.0)
        pair, a, b = part_pairs(placed, local[: len(first)], local[len(first) :])
        contacts, pair = self._near_parts(objects, replace(placed, low=low, high=high), first, second, pair, a, b)
        change = (contacts.direction * (way[contacts.second] - way[contacts.first])).sum(axis=1)
        met = np.unique(pair[contacts.gap + np.minimum(change, 0.0) < margin])
        return first[met], second[met]

    def _near_parts(
        self, objects: Objects, placed: PlacedObjects, first: Index, second: Index, pair: Index, a: Index, b: Index
    ) -> tuple[Contacts, Index]:
        """Contacts among the part pairs (``a``, ``b``) of object pairs, and the object pair of each."""
        fixed = (objects.fixed[first] | objects.fixed[second])[pair]
        near = np.flatnonzero(boxes_near(placed.low, placed.high, a, b, NEAR, fixed))
        pair, a, b = pair[near], a[near], b[near]
        gap, direction = separations(self.library, placed.parts, a, b)
        part = placed.parts.part
        return Contacts(first[pair], second[pair], part[a], part[b], gap, direction), pair


def corner_tests(library: LibraryGeometry, objects: Objects, first: Index, second: Index) -> Array:
    """(P,) work to test each pair: corners of one object's parts times face directions of the other's, both ways."""
    corners, directions = library.corners[objects.category], library.directions[objects.category]
    return (corners[first] * directions[second] + directions[first] * corners[second]).astype(np.float64)


def boxes_near(low: Array, high: Array, a: Index, b: Index, margin: float, fixed: Mask | None = None) -> Mask:
    """(P,) whether boxes are at most ``margin`` m apart, and pairs of something ``fixed`` at most 6 cm in height."""
    wide = high + margin
    near = boxes_meet(low, wide, low, wide, a, b)
    if fixed is not None:
        some = np.flatnonzero(fixed & ~near)
        tall = high + np.array([margin, margin, NEAR_FIXED])
        near[some] = boxes_meet(low, tall, low, tall, a[some], b[some])
    return near


_upper_triangle = lru_cache(maxsize=512)(partial(np.triu_indices, k=1))


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
