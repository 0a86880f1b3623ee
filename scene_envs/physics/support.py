"""Contact graph of a scene: level of detail of each object, height of stacks, clusters to simulate together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.contact_faces import ContactFace
from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.pairs import ObjectPairs
from scene_envs.physics.placement import Objects

_REACH = 2e-3
"""Pairs further apart than this (m) do not carry each other."""
_SAME_DEPTH = 1e-4
"""Coarse and fine overlap may differ by this much (m) and still act alike."""
_UPRIGHT = 0.999
"""Cosine of the tilt up to which faces count as facing each other."""
_CLEAR = 0.01
_CLEAR_ABOVE = 0.06
"""Objects are simulated in one cluster when they are within ``_CLEAR`` (m) of each other sideways and within
``_CLEAR_ABOVE`` (m) in height."""


@dataclass(frozen=True, eq=False)
class _Faces:
    """Contact faces per category as arrays; NaN where there is none."""

    height: Array
    center: Array
    inner: Array
    corners: Array
    hole: Array

    @classmethod
    def of(cls, faces: list[ContactFace | None]) -> _Faces:
        def column(name: str) -> Array:
            return np.array([np.nan if face is None else getattr(face, name) for face in faces])

        center = np.array([(np.nan, np.nan) if face is None else face.center for face in faces])
        return cls(column("height"), center, column("inner"), column("corners"), column("hole"))


class Support:
    """Test of contacts, from precomputed faces."""

    def __init__(self, library: LibraryGeometry) -> None:
        self.hollow = np.array([asset.is_hollow for asset in library.assets])
        self.bottom = _Faces.of([asset.bottom for asset in library.assets])
        self.top = _Faces.of([asset.top for asset in library.assets])

    def needs_fine(self, objects: Objects, pairs: ObjectPairs) -> Mask:
        """(n,) objects that must collide with their fine parts."""
        different = self.differs(objects, pairs)
        fine = np.zeros(len(objects), dtype=bool)
        fine[pairs.first[different]] = True
        fine[pairs.second[different]] = True
        return fine & self.hollow[objects.category]

    def differs(self, objects: Objects, pairs: ObjectPairs) -> Mask:
        """(P,) pairs whose coarse parts do not carry each other as the fine ones do.

        Coarse shapes act like fine ones in three kinds of contact. The solid outlines of two facing flat faces meet
        all the way round; or an object lies on a flat surface that is larger than it; or two upright objects are side
        by side.
        """
        a, b = pairs.first, pairs.second
        relevant = (pairs.gap < _REACH) & (self.hollow[objects.category[a]] | self.hollow[objects.category[b]])
        same_depth = (pairs.gap >= -_SAME_DEPTH) | (pairs.depth >= -pairs.gap - _SAME_DEPTH)
        facing = np.abs(pairs.direction[:, 2]) > _UPRIGHT
        first_above = pairs.direction[:, 2] < 0
        upper, lower = np.where(first_above, a, b), np.where(first_above, b, a)
        alike = facing & (
            self._meets_all_round(objects, upper, lower, pairs.gap)
            | self._on_plane(objects, upper, lower, pairs.low, pairs.high)
        )
        upright = objects.rotation[:, 2, 2] > _UPRIGHT
        side_by_side = (np.abs(pairs.direction[:, 2]) < 0.1) & upright[a] & upright[b]
        return relevant & ~(same_depth & (alike | side_by_side))

    def _meets_all_round(self, objects: Objects, upper: Index, lower: Index, gap: Array) -> Mask:
        up, down = objects.category[upper], objects.category[lower]
        upright = (objects.rotation[upper, 2, 2] > _UPRIGHT) & (objects.rotation[lower, 2, 2] > _UPRIGHT)
        center_up = _face_center(objects, upper, self.bottom)
        center_down = _face_center(objects, lower, self.top)
        offset = np.hypot(center_up[:, 0] - center_down[:, 0], center_up[:, 1] - center_down[:, 1])
        hole_up, hole_down = self.bottom.hole[up], self.top.hole[down]
        with np.errstate(invalid="ignore"):
            meets = ((hole_down == 0) | (offset <= self.bottom.corners[up] - hole_down)) & (
                (hole_up == 0) | (offset <= self.top.corners[down] - hole_up)
            )
            at_faces = np.abs(center_up[:, 2] - center_down[:, 2] - gap) < 5e-3
        return upright & meets & at_faces

    def _on_plane(self, objects: Objects, upper: Index, lower: Index, low: Array, high: Array) -> Mask:
        down = objects.category[lower]
        center = _face_center(objects, lower, self.top)
        reach_x = np.maximum(high[upper, 0] - center[:, 0], center[:, 0] - low[upper, 0])
        reach_y = np.maximum(high[upper, 1] - center[:, 1], center[:, 1] - low[upper, 1])
        with np.errstate(invalid="ignore"):
            larger = np.hypot(reach_x, reach_y) <= self.top.inner[down]
            return larger & (self.top.hole[down] == 0) & (objects.rotation[lower, 2, 2] > _UPRIGHT)  # type: ignore[no-any-return]

    def tallest(self, objects: Objects, pairs: ObjectPairs) -> Index:
        """(n,) number of objects that carry each object, one above the other (0 on a fixed surface)."""
        vertical = (np.abs(pairs.direction[:, 2]) > 0.5) & (pairs.gap < _REACH)
        a, b = pairs.first[vertical], pairs.second[vertical]
        first_above = pairs.direction[vertical, 2] < 0
        upper, lower = np.where(first_above, a, b), np.where(first_above, b, a)
        depth = np.zeros(len(objects), dtype=np.int64)
        for index in np.argsort(objects.translation[upper, 2], kind="stable"):
            if not objects.fixed[lower[index]]:
                depth[upper[index]] = max(depth[upper[index]], depth[lower[index]] + 1)
        return depth


def clusters(objects: Objects, low: Array, high: Array, sideways: float = _CLEAR) -> Index:
    """(n,) a number per free object of one scene, shared by those near each other; -1 for fixed ones."""
    rows = np.flatnonzero(~objects.fixed)
    margin = np.array([sideways, sideways, _CLEAR_ABOVE])
    first, second = np.triu_indices(len(rows), k=1)
    first, second = rows[first], rows[second]
    near = ((low[first] <= high[second] + margin) & (low[second] <= high[first] + margin)).all(axis=1)
    return np.where(objects.fixed, -1, components(len(objects), first[near], second[near]))


def components(count: int, first: Index, second: Index) -> Index:
    """(count,) number of the connected component of each node, edges given as (P,), (P,)."""
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    return connected_components(graph, directed=False)[1].astype(np.int64)  # type: ignore[no-any-return]


def company(objects: Objects, pairs: ObjectPairs, chosen: Mask) -> Mask:
    """(n,) free objects that must be simulated with the ``chosen`` ones.

    These are objects that touch or nearly touch a chosen object, and the objects on or under those.
    """
    free = ~(objects.fixed[pairs.first] | objects.fixed[pairs.second]) & (pairs.gap < _REACH)
    first, second = pairs.first[free], pairs.second[free]
    together = chosen.copy()
    touched = chosen[first] | chosen[second]
    together[first[touched]] = together[second[touched]] = True
    vertical = (np.abs(pairs.direction[free, 2]) > 0.5) | (pairs.gap[free] < -_SAME_DEPTH)
    first, second = first[vertical], second[vertical]
    while True:
        touched = together[first] != together[second]
        if not touched.any():
            return together
        together[first[touched]] = together[second[touched]] = True


def _face_center(objects: Objects, rows: Index, faces: _Faces) -> Array:
    """(P, 3) world position of each object's face centre; NaN where it has none."""
    category = objects.category[rows]
    local = np.column_stack([faces.center[category], faces.height[category]])
    r = objects.rotation[rows]
    moved = r[:, :, 0] * local[:, 0:1] + r[:, :, 1] * local[:, 1:2] + r[:, :, 2] * local[:, 2:3]
    return moved + objects.translation[rows]  # type: ignore[no-any-return]
