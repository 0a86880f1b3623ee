"""Support and rest: objects whose rest is found without simulation, and those that must be simulated together.

An upright object rests on the one object under it when the centre of mass of the object and everything it carries lies
inside both the object's foot and the flat face below. From the lowest object up, gaps are closed and small overlaps
opened. Objects that meet no other object on this way are at rest; all others are simulated.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import NEAR, Collider, scene_pairs
from scene_envs.physics.parts import GRAVITY, ContactFace, Rows, apply, area, outline_of, padded
from scene_envs.physics.placement import Contacts, ObjectPairs, Objects, components

_FLAT = 3e-4
"""Tilt (rad) up to which an object counts as upright."""
_FOOT = 1e-4
"""Corners this close (m) to the lowest one belong to the foot."""
_MEETS = 2e-4
"""A contact belongs to the foot when its height agrees with the foot's height to this (m)."""
_BALANCE = 5e-3
"""The centre of mass must lie at least this far (m) inside the foot and the face below."""
_TOUCHING = 1e-4
"""Overlap (m) with a neighbouring object that is too small to move an object."""
_DEEPEST = 2e-3
"""An object that is sunk deeper than this (m) into its support does not simply rise."""
_REACH = 2e-3
"""Pairs further apart than this (m) do not carry each other."""
_SAME_DEPTH = 1e-4
"""Coarse and fine overlap may differ by this much (m) and still act alike."""
_UPRIGHT = 0.999
"""Cosine of the tilt up to which faces count as facing each other."""
_CLEAR = np.array([0.01, 0.01, 0.06])
"""Objects are simulated in one cluster when they are within this (m) of each other along each axis."""


@dataclass(frozen=True, eq=False)
class Rest(Rows):
    """Objects whose motion has a closed form."""

    still: Mask  # (n,) bool; free objects that need no simulation
    rise: Array  # (n,) m, upward motion of each of them, negative for downward; 0 elsewhere
    tilt: Array  # (n,) rad, angle that each of them turns to stand upright


@dataclass(frozen=True, eq=False)
class _Polygons:
    """Convex polygons in the asset's xy plane, padded with copies of their first corner and edge."""

    height: Array  # (P,) z in the asset frame, m; NaN where there is no polygon
    count: Index  # (P,) number of corners without the copies
    corners: Array  # (P, V, 2) m
    normals: Array  # (P, V, 2) outward
    offsets: Array  # (P, V) m; inside is ``normals @ x <= offsets``

    @classmethod
    def of(cls, polygons: list[tuple[float, Array] | None]) -> _Polygons:
        rows = []
        for polygon in polygons:
            if polygon is None:
                rows.append((np.nan, np.zeros((1, 2)), np.zeros((1, 2)), np.array([-1.0])))
                continue
            height, points = polygon
            edge = np.roll(points, -1, axis=0) - points
            normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
            rows.append((height, points, normal, (normal * points).sum(axis=1)))
        heights, *columns = zip(*rows, strict=True)
        return cls(np.array(heights), np.array(list(map(len, columns[0]))), *map(padded, columns))

    def inside(self, rows: Index, points: Array, count: Index) -> Mask:
        """(Q, K) whether each of the first ``count`` (Q,) points (Q, K, 2) is inside polygons ``rows`` (Q,)."""
        low, high = self.corners[rows].min(axis=1) - 1e-9, self.corners[rows].max(axis=1) + 1e-9
        inside = np.arange(points.shape[1]) < count[:, None]
        for axis in range(2):  # most points are outside the boxes
            inside &= (points[..., axis] >= low[:, None, axis]) & (points[..., axis] <= high[:, None, axis])
        row, column = np.nonzero(inside)
        inside[row, column] = self.outside(rows[row], points[row, column][:, None])[:, 0] < 0.0
        return inside

    def outside(self, rows: Index, points: Array) -> Array:
        """(Q, K) m, distance of points (Q, K, 2) in the asset frame outside polygons ``rows`` (Q,)."""
        normals, offsets = self.normals[rows][:, None], self.offsets[rows][:, None]
        along = normals[..., 0] * points[:, :, None, 0] + normals[..., 1] * points[:, :, None, 1]
        return (along - offsets).max(axis=2)  # type: ignore[no-any-return]


class Statics:
    """Closed-form tests of rest and of contacts, from precomputed feet, surfaces and faces."""

    def __init__(self, collider: Collider) -> None:
        self._collider, self._library = collider, (library := collider.library)
        down = (1.0, 1.0, -1.0)  # heights of feet and undersides are downward
        self._foot = _Polygons.of([_surface(asset.fine.vertices * down, _FOOT) for asset in library.assets])
        self._surface = _Polygons.of([_surface(part.vertices) for part in library.parts])
        self._under = _Polygons.of([_surface(part.vertices * down) for part in library.parts])
        for asset in library.assets:
            if asset.is_hollow:  # the coarse parts have tops where there is nothing to stand on
                self._surface.offsets[asset.coarse.ids] = -np.inf
        # the top face may be a rim round a hole
        rims = [None if asset.top is None else _surface(asset.fine.vertices) for asset in library.assets]
        self._rim = _Polygons.of(rims)
        self.top = _Faces.of([asset.top for asset in library.assets])
        self.bottom = _Faces.of([asset.bottom for asset in library.assets])
        self.hollow = np.array([asset.is_hollow for asset in library.assets])

    def at_rest(self, objects: Objects, pairs: ObjectPairs, contacts: Contacts, duration: float) -> Rest:
        """Objects of one or more scenes that need no simulation for ``duration`` seconds."""
        count = len(objects)
        tilt = np.hypot(objects.rotation[:, 0, 2], objects.rotation[:, 1, 2])
        upright = (tilt < _FLAT) & (objects.rotation[:, 2, 2] > 0)
        rows, upper, lower = self._standing(objects, contacts, upright)
        support = np.full(count, -1, dtype=np.int64)
        drop = np.zeros(count)
        order = np.lexsort((contacts.gap[rows], upper))
        found, leading = np.unique(upper[order], return_index=True)
        chosen = order[leading]
        support[found], drop[found] = lower[chosen], contacts.gap[rows][chosen]
        support[objects.fixed] = -1
        rise, height = _rises(support, drop, objects.fixed)
        center = self._loaded_center(objects, support, height)
        best, balanced = np.zeros((2, count), dtype=bool)
        middle = _into(objects, found, center[found][:, None])
        balanced[found] = self._foot.outside(objects.category[found], middle)[:, 0] < -_BALANCE
        held = balanced[upper] & (lower == support[upper]) & (contacts.gap[rows] < drop[upper] + _TOUCHING)
        rows, upper, lower = rows[held], upper[held], lower[held]
        good = self._holds(objects, contacts, rows, upper, lower, center)
        best[upper[good]] = True
        still = best & (support >= 0) & ~objects.fixed & upright
        rise = np.maximum(rise, -0.5 * GRAVITY * duration**2)
        self._clear(objects, pairs, contacts, support, rise, still)
        while True:  # an object on a simulated object has to be simulated too
            lost = still & ~(still | objects.fixed)[np.maximum(support, 0)]
            if not lost.any():
                break
            still &= ~lost
        return Rest(still, np.where(still, rise, 0.0), np.where(still, tilt, 0.0))

    def _standing(self, objects: Objects, contacts: Contacts, upright: Mask) -> tuple[Index, Index, Index]:
        """Contacts of a foot with a horizontal face below: rows, upper and lower objects."""
        vertical = np.flatnonzero(np.abs(contacts.direction[:, 2]) > 0.9999)
        up = contacts.direction[vertical, 2] > 0
        first, second = contacts.first[vertical], contacts.second[vertical]
        upper, lower = np.where(up, second, first), np.where(up, first, second)
        part = np.where(up, contacts.part_first[vertical], contacts.part_second[vertical])
        z = objects.translation[:, 2]
        foot = z[upper] - self._foot.height[objects.category[upper]]
        with np.errstate(invalid="ignore"):
            meets = np.abs(foot - z[lower] - self._surface.height[part] - contacts.gap[vertical]) < _MEETS
        good = meets & upright[upper] & upright[lower] & (contacts.gap[vertical] > -_DEEPEST) & ~objects.fixed[upper]
        return vertical[good], upper[good], lower[good]

    def _loaded_center(self, objects: Objects, support: Index, height: Index) -> Array:
        """(n, 2) centre of mass of each object together with everything on it, world frame."""
        mass = self._library.mass[objects.category].copy()
        local = self._library.center_of_mass[objects.category]
        moment = mass[:, None] * (objects.translation + apply(objects.rotation, local))[:, :2]
        for level in range(int(height.max(initial=0)), 0, -1):
            rows = np.flatnonzero((height == level) & (support >= 0))
            np.add.at(mass, support[rows], mass[rows])
            np.add.at(moment, support[rows], moment[rows])
        return moment / np.maximum(mass, 1e-12)[:, None]  # type: ignore[no-any-return]

    def _holds(
        self, objects: Objects, contacts: Contacts, rows: Index, upper: Index, lower: Index, center: Array
    ) -> Mask:
        """Whether each contact keeps its upper object, whose centre of mass is above its foot, from tipping."""
        local = _into(objects, lower, center[upper][:, None])
        parts, is_second = (contacts.part_first[rows], contacts.part_second[rows]), contacts.second[rows] == upper
        part, own = np.where(is_second, *parts), np.where(is_second, *parts[::-1])
        good = self._surface.outside(part, local)[:, 0] < -_BALANCE
        q = np.flatnonzero(good & (self.bottom.hole[objects.category[upper]] != 0))
        up = objects.category[upper[q]]
        corners = _into(objects, lower[q], _out_of(objects, upper[q], self._foot.corners[up]))
        good[q] = self._surface.outside(part[q], corners).max(axis=1) < 0.0
        # The test of the rim gives the same result for all parts of the two objects.
        _, q = np.unique(upper, return_index=True)
        up, down = objects.category[upper[q]], objects.category[lower[q]]
        at_rim = np.abs(self._rim.height[down] - self._surface.height[part[q]]) < _MEETS
        offset = np.linalg.norm(
            _into(objects, lower[q], _out_of(objects, upper[q], self.bottom.center[up][:, None]))[:, 0]
            - self.top.center[down],
            axis=1,
        )
        at_rim &= self._rim.outside(down, local[q])[:, 0] < -_BALANCE
        hole = self.bottom.hole[up]
        at_rim &= offset <= self.bottom.corners[up] - self.top.hole[down]
        at_rim &= (hole == 0) | (offset <= self.top.corners[down] - hole)
        good[q] |= at_rim
        # Or several parts carry it, whose contacts are all round the centre of mass.
        lowest = np.abs(self._under.height[own] - self._foot.height[objects.category[upper]]) < _FOOT
        q = np.flatnonzero(lowest & ~np.isin(upper, upper[good]))
        own, part = own[q], part[q]
        feet = _out_of(objects, upper[q], self._under.corners[own])
        tops = _out_of(objects, lower[q], self._surface.corners[part])
        on_top = self._surface.inside(part, _into(objects, lower[q], feet), self._under.count[own])
        on_foot = self._under.inside(own, _into(objects, upper[q], tops), self._surface.count[part])
        points, met = np.concatenate([feet, tops], axis=1), np.concatenate([on_top, on_foot], axis=1)
        for index in np.unique(upper[q]):
            mine = upper[q] == index
            good[q[mine]] = surrounds(points[mine][met[mine]] - center[index])
        return good

    def _clear(
        self, objects: Objects, pairs: ObjectPairs, contacts: Contacts, support: Index, rise: Array, still: Mask
    ) -> None:
        """Remove from ``still``, in place, the objects that meet another object on their way."""
        while True:
            moved = np.where(still, rise, 0.0)
            relative = contacts.direction[:, 2] * (moved[contacts.second] - moved[contacts.first])
            bad = contacts.gap + relative < -_TOUCHING
            # Both objects of such a contact leave ``still``. Objects that touch a simulated one are simulated anyway.
            struck = np.zeros(len(still), dtype=bool)
            struck[contacts.first[bad]] = True
            struck[contacts.second[bad]] = True
            struck &= still
            if not struck.any():
                break
            still &= ~struck
        falling = still & (rise < -0.5 * NEAR)
        if falling.any():
            first, second = scene_pairs(objects)
            keep = (falling[first] | falling[second]) & ~(objects.fixed[first] | objects.fixed[second])
            keep &= (support[first] != second) & (support[second] != first)
            way = np.outer(moved, (0.0, 0.0, 1.0))
            for met in self._collider.may_meet(objects, pairs, first[keep], second[keep], way, -_TOUCHING):
                still[met[falling[met]]] = False

    def needs_fine(self, objects: Objects, pairs: ObjectPairs) -> Mask:
        """(n,) objects that must collide with their fine parts."""
        different = self.differs(objects, pairs)
        fine = np.zeros(len(objects), dtype=bool)
        fine[pairs.first[different]] = True
        fine[pairs.second[different]] = True
        return fine & self.hollow[objects.category]

    def differs(self, objects: Objects, pairs: ObjectPairs) -> Mask:
        """(P,) pairs whose coarse parts do not carry each other as the fine ones do. They do in three kinds of contact:
        the solid outlines of two facing flat faces meet all the way round; an object lies on a flat surface that is
        larger than it; or two upright objects are side by side.
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


def _rises(support: Index, drop: Array, fixed: Mask) -> tuple[Array, Index]:
    """Upward motion (m) of each object until it meets its support, and the number of objects that carry it."""
    rise, height = np.zeros(len(support)), np.zeros(len(support), dtype=np.int64)
    carried = np.flatnonzero(support >= 0)
    under = support[carried]
    while True:
        new_height = np.where(fixed[under], 1, height[under] + 1)
        rise[carried] = rise[under] - drop[carried]
        if (new_height == height[carried]).all() or new_height.max(initial=0) > len(support):
            return rise, np.minimum(height, len(support))
        height[carried] = new_height


def _into(objects: Objects, rows: Index, points: Array) -> Array:
    """World points (Q, K, 2) in the frames of upright objects ``rows`` (Q,)."""
    relative = points - objects.translation[rows, None, :2]
    r = objects.rotation[rows, :2, :2][:, None]
    return r[..., 0, :] * relative[..., 0:1] + r[..., 1, :] * relative[..., 1:2]


def _out_of(objects: Objects, rows: Index, points: Array) -> Array:
    """Points (Q, K, 2) of upright objects ``rows`` (Q,) in the world."""
    r = objects.rotation[rows, :2, :2][:, None]
    moved = r[..., :, 0] * points[..., 0:1] + r[..., :, 1] * points[..., 1:2]
    return moved + objects.translation[rows, None, :2]  # type: ignore[no-any-return]


def _outline(points: Array) -> Array | None:
    """Counter-clockwise convex outline (K, 2), or None when there is no area."""
    outline = outline_of(points)
    return outline if outline is not None and area(outline) > 1e-7 else None


def surrounds(points: Array) -> bool:
    """Whether the convex hull of points (P, 2) m reaches further than ``_BALANCE`` from the origin in all directions.

    >>> square = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    >>> surrounds(0.0071 * square), surrounds(0.0049 * square), surrounds(square[:3])
    (True, False, False)
    """
    points = points[(far := np.hypot(*points.T)) > _BALANCE]
    if not len(points):
        return False
    # a point reaches so far in the directions within an angle of its own: these arcs must cover the circle
    half = np.arccos(_BALANCE / far[far > _BALANCE])
    start = (np.arctan2(points[:, 1], points[:, 0]) - half) % (2 * np.pi)
    order = np.argsort(start)
    start, end = start[order], (start + 2 * half)[order]
    covered = np.maximum.accumulate(np.concatenate([[end.max() - 2 * np.pi], end]))
    return bool((start < covered[:-1]).all())


def _surface(vertices: Array, depth: float = 1e-5) -> tuple[float, Array] | None:
    """Height and outline of the flat top of the corners (V, 3) of a part or of all parts, ``depth`` (m) thick."""
    height = float(vertices[:, 2].max())
    outline = _outline(vertices[vertices[:, 2] > height - depth][:, :2])
    return None if outline is None else (height, outline)


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
        none = ContactFace(np.nan, (np.nan, np.nan), np.nan, np.nan, np.nan)
        return cls(*(np.array([getattr(face or none, field.name) for face in faces]) for field in fields(cls)))


def clusters(objects: Objects, low: Array, high: Array) -> Index:
    """(n,) a number per free object of one scene, shared by those near each other; -1 for fixed ones."""
    rows = np.flatnonzero(~objects.fixed)
    first, second = np.triu_indices(len(rows), k=1)
    first, second = rows[first], rows[second]
    near = ((low[first] <= high[second] + _CLEAR) & (low[second] <= high[first] + _CLEAR)).all(axis=1)
    return np.where(objects.fixed, -1, components(len(objects), first[near], second[near]))


def company(objects: Objects, pairs: ObjectPairs, chosen: Mask) -> Mask:
    """(n,) free objects that must be simulated with the ``chosen`` ones: those that touch or nearly touch a chosen
    object, and the objects on or under those.
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
    return apply(objects.rotation[rows], local) + objects.translation[rows]
