"""What holds an object: when coarse shapes give the same verdict, and when no simulation is needed at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scene_envs.physics.collision import ObjectPairs, scene_pairs
from scene_envs.physics.contact_faces import ContactFace
from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.placement import Objects

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

GRAVITY = 9.81
"""m/s^2."""

_REACH = 2e-3
"""Pairs further apart than this (m) do not carry each other."""
_SAME_DEPTH = 1e-4
"""Coarse and fine overlap may differ by this much (m) and still act alike."""
_UPRIGHT = 0.999
"""Cosine of the tilt up to which faces count as facing each other."""
_FLAT = 3e-4
"""Tilt (rad) up to which an object on its own needs no simulation."""
_CLEAR = 0.01
"""An object is on its own when nothing is within this distance (m) of it sideways or below,"""
_CLEAR_ABOVE = 0.01
"""or within this distance (m) above, beyond what falls in the time."""
_BALANCE = 5e-3
"""The centre of mass must lie at least this far (m) inside the foot."""


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
    """Judges contacts from precomputed faces.

    Args:
        library: geometry of the assets.
    """

    def __init__(self, library: LibraryGeometry) -> None:
        self.hollow = np.array([asset.is_hollow for asset in library.assets])
        self.center_of_mass = library.center_of_mass
        self.bottom = _Faces.of([asset.bottom for asset in library.assets])
        self.top = _Faces.of([asset.top for asset in library.assets])

    def needs_fine(self, objects: Objects, pairs: ObjectPairs) -> Mask:
        """(n,) objects that must collide with their fine parts.

        Coarse shapes act like fine ones in a contact when the solid outlines of two facing flat faces
        meet all the way round, on a flat surface that is larger than the object, or side by side.

        Args:
            objects: the objects.
            pairs: their near pairs.
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
        beside = (np.abs(pairs.direction[:, 2]) < 0.1) & upright[a] & upright[b]
        different = relevant & ~(same_depth & (alike | beside))
        fine = np.zeros(len(objects), dtype=bool)
        fine[a[different]] = True
        fine[b[different]] = True
        return fine & self.hollow[objects.category]

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

    def at_rest(self, objects: Objects, low: Array, high: Array, duration: float) -> tuple[Mask, Array, Array]:
        """Objects that stand alone and upright on a fixed flat surface: their motion has a closed form.

        Such an object rises by its overlap, or falls by its gap as far as free fall takes it in ``duration``.

        Returns:
            mask (n,), displacement (n,) m and rotation (n,) rad; the last two only where the mask is True.
        """
        first, second = neighbors_of(objects, low, high, _CLEAR, duration)
        n = len(objects)
        neighbors = np.bincount(first, minlength=n) + np.bincount(second, minlength=n)
        support = np.full(n, -1, dtype=np.int64)
        support[first[objects.fixed[second]]] = second[objects.fixed[second]]
        support[second[objects.fixed[first]]] = first[objects.fixed[first]]
        rows = np.flatnonzero((neighbors == 1) & (support >= 0) & ~objects.fixed)
        mask, displacement, rotation = np.zeros(n, dtype=bool), np.zeros(n), np.zeros(n)
        if not len(rows):
            return mask, displacement, rotation
        under = support[rows]
        tilt = np.hypot(objects.rotation[rows, 0, 2], objects.rotation[rows, 1, 2])
        level = np.hypot(objects.rotation[under, 0, 2], objects.rotation[under, 1, 2]) < 1e-6
        up = objects.category[rows]
        foot = _face_center(objects, rows, self.bottom)
        gap = foot[:, 2] - _face_center(objects, under, self.top)[:, 2]
        lever = np.hypot(*(self.center_of_mass[up, :2] - self.bottom.center[up]).T)
        with np.errstate(invalid="ignore"):
            good = (tilt < _FLAT) & (objects.rotation[rows, 2, 2] > 0) & level & (objects.rotation[under, 2, 2] > 0)
            good &= (gap > -2e-3) & (lever < self.bottom.inner[up] - _BALANCE)
        good &= self._on_plane(objects, rows, under, low, high)
        rows = rows[good]
        mask[rows] = True
        displacement[rows] = np.where(gap[good] < 0, -gap[good], np.minimum(gap[good], 0.5 * GRAVITY * duration**2))
        rotation[rows] = tilt[good]
        return mask, displacement, rotation

    def tallest(self, objects: Objects, pairs: ObjectPairs) -> Index:
        """(n,) how many objects carry each object, one above the other (0 on a fixed surface)."""
        vertical = (np.abs(pairs.direction[:, 2]) > 0.5) & (pairs.gap < _REACH)
        a, b = pairs.first[vertical], pairs.second[vertical]
        first_above = pairs.direction[vertical, 2] < 0
        upper, lower = np.where(first_above, a, b), np.where(first_above, b, a)
        depth = np.zeros(len(objects), dtype=np.int64)
        for index in np.argsort(objects.translation[upper, 2], kind="stable"):
            if not objects.fixed[lower[index]]:
                depth[upper[index]] = max(depth[upper[index]], depth[lower[index]] + 1)
        return depth


def neighbors_of(objects: Objects, low: Array, high: Array, sideways: float, duration: float) -> tuple[Index, Index]:
    """Pairs (P,), (P,) of objects of one scene that could meet within ``duration`` seconds.

    Their boxes are within ``sideways`` m of each other, and no further apart in height than what falls in the time.
    """
    first, second = scene_pairs(objects)
    near = (low[first, 0] <= high[second, 0] + sideways) & (low[second, 0] <= high[first, 0] + sideways)
    near &= (low[first, 1] <= high[second, 1] + sideways) & (low[second, 1] <= high[first, 1] + sideways)
    above = 0.5 * GRAVITY * duration**2 + _CLEAR_ABOVE
    near &= (low[first, 2] <= high[second, 2] + above) & (low[second, 2] <= high[first, 2] + above)
    return first[near], second[near]


def clusters(objects: Objects, low: Array, high: Array, duration: float, sideways: float = _CLEAR) -> Index:
    """(n,) a number per free object, shared by those that could meet in ``duration`` seconds; -1 for fixed ones."""
    first, second = neighbors_of(objects, low, high, sideways, duration)
    free = ~(objects.fixed[first] | objects.fixed[second])
    first, second = first[free], second[free]
    n = len(objects)
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(n, n))
    labels = connected_components(graph, directed=False)[1].astype(np.int64)
    return np.where(objects.fixed, -1, labels)


def _face_center(objects: Objects, rows: Index, faces: _Faces) -> Array:
    """(P, 3) world position of each object's face centre; NaN where it has none."""
    category = objects.category[rows]
    local = np.column_stack([faces.center[category], faces.height[category]])
    r = objects.rotation[rows]
    moved = r[:, :, 0] * local[:, 0:1] + r[:, :, 1] * local[:, 1:2] + r[:, :, 2] * local[:, 2:3]
    return moved + objects.translation[rows]  # type: ignore[no-any-return]
