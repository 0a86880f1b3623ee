"""Contacts (yes or no) and gaps of convex parts by FCL (Pan, Chitta and Manocha 2012): what never ends the process."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import cache
from threading import Lock
from typing import Any

import fcl
import numpy as np

from scene_envs.arrays import Array, Mask
from scene_envs.assets.base import Asset, ConvexPart

Parts = list[fcl.CollisionObject]
"""The placed parts of one object."""

YES_OR_NO = fcl.CollisionRequest()
"""FCL's default request: contact as yes or no, by its default solver."""


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
        self._copies: list[list[Parts]] = [[] for _ in self._assets]
        self.lock = Lock()

    def place(self, categories: Sequence[int], rotations: Array, translations: Array) -> list[Parts]:
        """Parts of the n objects of a scene at rotations (n, 3, 3) and translations (n, 3) m, until the next one."""
        used: Counter[int] = Counter()
        placed = []
        for category, *pose in zip(categories, rotations, translations, strict=True):
            copies = self._copies[category]
            if used[category] == len(copies):
                copies.append([convex(part) for part in self._assets[category].fine])
            placed.append(copies[used[category]])
            used[category] += 1
            transform = fcl.Transform(*pose)
            for part in placed[-1]:
                part.setTransform(transform)
        return placed


@cache
def shapes_of(assets: tuple[Asset, ...]) -> Shapes:
    """The parts of ``assets``, made on first use and shared by all threads of this process."""
    return Shapes(assets)


class Boxed:
    """Placed parts and their boxes, from ``low`` (P, 3) to ``high`` (P, 3) m: FCL's own box of a turned part is that of
    the sphere around it, and lets many more pairs through.
    """

    def __init__(self, parts: Parts, low: Array, high: Array) -> None:
        self._parts, self._bounds = parts, np.concatenate([low.T, -high.T])  # (6, P) m
        self._result = fcl.CollisionResult()  # one for all, which saves half the time
        self.last = 0  # row of the part that was met last

    def meet(self, boxes: Array, rows: Any = slice(None)) -> Mask:
        """(..., P) whether boxes (..., 6), their high corners and the negative low ones (m), meet those of ``rows``."""
        first, *others = zip(self._bounds[:, rows], np.moveaxis(boxes, -1, 0)[..., None], strict=True)
        met = np.less_equal(*first)
        for pair in others:
            met &= np.less_equal(*pair)
        return met

    def meets(self, part: fcl.CollisionObject, rows: Iterable[int]) -> bool:
        """Whether a placed part touches or overlaps one of the ``rows`` of these."""
        for row in rows:
            if fcl.collide(self._parts[row], part, YES_OR_NO, self._result):
                self._result, self.last = fcl.CollisionResult(), row
                return True
        return False


class Broadphase:
    """Placed parts in a tree of boxes."""

    def __init__(self, parts: Iterable[fcl.CollisionObject]) -> None:
        self._tree = fcl.DynamicAABBTreeCollisionManager()
        self._tree.registerObjects(parts)
        self._tree.setup()
        self._last: Parts = []

    def meets(self, part: fcl.CollisionObject) -> bool:
        """Whether a placed part touches or overlaps any of these; the one met last is tried first."""
        if self._last and fcl.collide(self._last[0], part):
            return True
        found: Parts = []
        self._tree.collide(part, (found, fcl.CollisionResult()), _until_contact)
        self._last = found or self._last
        return bool(found)


def _until_contact(
    one: fcl.CollisionObject, part: fcl.CollisionObject, asked: tuple[Parts, fcl.CollisionResult]
) -> bool:
    """Called with each part ``one`` of a tree whose box meets that of ``part``, until it answers True. One result
    serves all calls for ``part``, which saves half their time.
    """
    if fcl.collide(one, part, YES_OR_NO, asked[1]):
        asked[0].append(one)
    return bool(asked[0])


def gap(one: fcl.CollisionObject, other: fcl.CollisionObject) -> float:
    """Distance of two placed parts, m; 0 where they touch or overlap."""
    return max(0.0, fcl.distance(one, other))  # FCL answers -1 where they overlap
