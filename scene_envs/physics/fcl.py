"""Contacts and gaps of convex parts by FCL (Pan, Chitta and Manocha 2012): only what never ends the process.

These are contact as yes or no, with the default solver, the distance of parts that are apart, and the broadphase.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import chain
from threading import Lock

import fcl
import numpy as np

from scene_envs.arrays import Array, Mask
from scene_envs.assets.base import Asset, ConvexPart
from scene_envs.physics.placement import Objects, PlacedObjects, object_boxes


def convex(part: ConvexPart) -> fcl.CollisionObject:
    """A convex part at the origin."""
    faces = np.insert(part.faces, 0, 3, axis=1)  # each face begins with its number of corners
    return fcl.CollisionObject(fcl.Convex(part.vertices, len(part.faces), faces.ravel()))


class Shapes:
    """Fine convex parts of the assets of a library, as many of each asset as a scene has. They are made once, and each
    scene moves them, because FCL never frees all of a part. Whoever places a scene holds ``lock`` while it is in use.
    """

    def __init__(self, assets: Iterable[Asset]) -> None:
        self._assets = list(assets)
        self._copies: list[list[list[fcl.CollisionObject]]] = [[] for _ in self._assets]
        self.lock = Lock()

    def place(
        self, categories: Sequence[int], rotations: Array, translations: Array
    ) -> list[list[fcl.CollisionObject]]:
        """Parts of the n objects of a scene at finite rotations (n, 3, 3) and translations (n, 3) m. They stay there
        until the next scene is placed.
        """
        used: Counter[int] = Counter()
        placed = []
        for category, rotation, translation in zip(categories, rotations, translations, strict=True):
            copies, number = self._copies[category], used[category]
            if number == len(copies):
                copies.append([convex(part) for part in self._assets[category].fine])
            used[category] += 1
            pose = fcl.Transform(rotation, translation)
            for part in copies[number]:
                part.setTransform(pose)
            placed.append(copies[number])
        return placed


@cache
def shapes_of(assets: tuple[Asset, ...]) -> Shapes:
    """The parts of ``assets``, made on first use and shared by all threads of this process."""
    return Shapes(assets)


class Broadphase:
    """Placed parts in a tree of boxes."""

    def __init__(self, parts: Iterable[fcl.CollisionObject]) -> None:
        self._tree = fcl.DynamicAABBTreeCollisionManager()
        self._tree.registerObjects(parts)
        self._tree.setup()
        self._last: list[fcl.CollisionObject] = []

    def meets(self, part: fcl.CollisionObject) -> bool:
        """Whether a placed part touches or overlaps any of these; the one met last is tried first."""
        if self._last and fcl.collide(self._last[0], part):
            return True
        found: list[fcl.CollisionObject] = []
        self._tree.collide(part, found, _until_contact)
        self._last = found or self._last
        return bool(found)


def _until_contact(one: fcl.CollisionObject, part: fcl.CollisionObject, found: list[fcl.CollisionObject]) -> bool:
    """Called with each part ``one`` of a tree whose box meets that of ``part``, until it answers True."""
    if fcl.collide(one, part):
        found.append(one)
    return bool(found)


def gap(one: fcl.CollisionObject, other: fcl.CollisionObject) -> float:
    """Distance of two placed parts, m; 0 where they touch or overlap."""
    return max(0.0, fcl.distance(one, other))  # FCL answers -1 where they overlap


def smallest_gaps(shapes: Shapes, objects: Objects, placed: PlacedObjects, ignored: Mask, limit: float) -> Array:
    """(n,) m: distance of each object of one scene to its nearest neighbour, at most ``limit``; 0 where they touch or
    overlap. ``placed`` are the fine parts of the ``objects``; pairs in ``ignored`` (n, n) and of two fixed objects do
    not count.
    """
    nearest = np.full(len(objects), limit)
    apart = _box_gaps(*object_boxes(placed))
    first, second = np.nonzero(np.triu(~(ignored | ignored.T | (objects.fixed[:, None] & objects.fixed)), 1))
    near = apart[first, second] < limit
    first, second = first[near], second[near]
    with shapes.lock:
        parts = list(chain(*shapes.place(objects.category.tolist(), objects.rotation, objects.translation)))
        for pair in np.argsort(apart[first, second], kind="stable"):
            a, b = first[pair], second[pair]
            least = max(nearest[a], nearest[b])  # only a smaller gap matters
            if apart[a, b] >= least:
                continue
            rows, columns = (slice(placed.start[i], placed.start[i] + placed.count[i]) for i in (a, b))
            boxes = _box_gaps(placed.low[rows], placed.high[rows], placed.low[columns], placed.high[columns])
            for index in np.argsort(boxes, axis=None, kind="stable"):
                i, j = divmod(int(index), boxes.shape[1])
                if boxes[i, j] >= least:
                    break
                least = min(least, gap(parts[rows.start + i], parts[columns.start + j]))
            nearest[[a, b]] = np.minimum(nearest[[a, b]], least)
    return nearest


def _box_gaps(low: Array, high: Array, other_low: Array | None = None, other_high: Array | None = None) -> Array:
    """(n, m) m: distances of boxes (n, 3) to other boxes (m, 3), or to each other."""
    other_low, other_high = low if other_low is None else other_low, high if other_high is None else other_high
    between = np.maximum(low[:, None] - other_high, other_low - high[:, None])
    return np.linalg.norm(np.maximum(between, 0.0), axis=-1)  # type: ignore[no-any-return]
