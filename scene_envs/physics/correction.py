"""Corrections of scenes during denoising: overlapping objects move apart, floating objects move down.

All scenes of a batch are corrected together, in torch, on their device. Arrays end with the axis of what they list
(objects, pairs, planes), so that every operation runs over all scenes; only the lengths of these lists are read back.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from scene_envs.assets.base import AssetLibrary
from scene_envs.physics import projection
from scene_envs.physics.parts import library_geometry, padded
from scene_envs.scene import SceneBatch, hull_corners

_WALL_OVERLAP = 5e-4
"""Overlap (m) with a wall next to an object at which the wall does not support the object."""
_WALL = 1e-2
"""Vertical component of a face normal up to which the face counts as a wall."""
_DEEP = 5e-4
"""Overlap (m) up to which two objects are not moved; feasible objects may overlap by 1e-3 m."""
_FLOATING = 3e-4
"""Height (m) up to which an object counts as standing."""
_TOUCHING = 1e-3
"""Difference in height (m) of parts that may touch."""
FALL = 0.03
"""An object higher than this (m) above all others is not moved down, unless a caller says so."""
_MIN_SPREAD = 0.05
"""Smallest standard deviation along an axis, as a share of the largest one."""
_LEVEL = (1.0, 1.0, 50.0)
"""Cost of moving furniture by a metre along each axis: vertical moves are avoided."""
_HEAP = 2e7
"""Limit of products of corners and face directions in the near object pairs of a scene; a scene of more is a heap."""
_SCENES = 512
"""Scenes corrected together."""
_BLOCKS = {"cpu": 1 << 18}
_BLOCK = 1 << 24
"""Products of corners and face directions computed together: on a CPU their arrays stay in the cache."""
_SWEEPS = 4
"""Parts that an object may pass one after the other on its way out of another object."""
_MET = 1e-6
"""A plane broken by less than this (m) is met."""
_ROUNDS, _STEPS = 3, 100
"""Rounds of the least-distance problem, after each of which broken planes join it, and steps of each."""
_AXES = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]])
_STACKED = 32
"""Objects on top of each other that come down together."""


def corrections(batch: SceneBatch, spread: Tensor, movable: Tensor | None = None, fall: float = FALL) -> Tensor:
    """Moves (B, N, 3), m, that reduce overlap and floating: one round for each scene of a batch, on its device.

    First, overlapping pieces of generated furniture move apart along the floor, together with the objects on them. Then
    overlapping objects move apart by a least-distance problem, as in :func:`~scene_envs.physics.project`, at distances
    in units of ``spread`` (3,), the standard deviations of positions along the world's axes (only their ratios matter).
    Last, each object moves straight down onto the object less than ``fall`` m below it. Rotations, fixed objects and
    those that are not ``movable`` (B, N) stay, and so do all objects of a scene that is a heap; poses must be finite.

    >>> corrections(SceneBatch.empty("dimsum_table", 1), torch.ones(3)).abs().max()
    tensor(0.)
    """
    single = SceneBatch(batch.tensor.float(), batch.scene_type)  # as the geometry is
    free = torch.ones_like(batch.is_empty) if movable is None else movable.to(batch.tensor.device)
    parts = [
        _corrections(single[row : row + _SCENES], spread.to(single.tensor), free[row : row + _SCENES], fall)
        for row in range(0, len(batch), _SCENES)
    ]
    return torch.cat(parts).to(batch.tensor) if parts else torch.zeros_like(batch.translations)


def _corrections(batch: SceneBatch, spread: Tensor, free: Tensor, limit: float) -> Tensor:
    cost = 1.0 / (spread / spread.max().clamp(min=1e-12)).clamp(min=_MIN_SPREAD)
    bounds = torch.tensor(batch.scene_type.workspace).to(spread)  # (2, 3)
    welded = batch.is_welded
    things = _Things.of(batch, welded | ~free)
    start = things.translation
    if batch.scene_type.furniture_categories:
        pieces = torch.nonzero(welded.flatten()[things.at])[:, 0]
        held = ~(batch.is_furniture & free).flatten()[things.at]
        things = _furniture_apart(things, pieces, held[pieces], bounds)
    things = things._replace(translation=_apart(things, bounds, cost))
    fall = _falls(things, limit)
    moves = things.translation - start
    moves[2] -= torch.where(fall > _FLOATING, fall, 0.0)
    found = torch.zeros_like(batch.translations)
    found.flatten(0, 1)[things.at] = moves.T
    return found


# -- geometry ---------------------------------------------------------------------------------------


class _Table(NamedTuple):
    """Convex parts of one size class; padded with copies of their first corner and direction."""

    vertices: Tensor  # (V, 3, P) m
    normals: Tensor  # (K, 3, P)
    offsets: Tensor  # (K, P) m


class _Geometry(NamedTuple):
    """Fine convex parts of a library of C assets, with at most F parts each, on a device."""

    static: Tensor  # (C,) bool
    work: Tensor  # (2, C) corners and face directions of each asset
    hull: Tensor  # (V, 3, C) m, corners of each asset's convex hull
    part: Tensor  # (F, C) part of the library; -1 for none
    corners: Tensor  # (8, F, 3, C) m, points around each part: its corners, or those of its box if it has more
    size_class: Tensor  # (P,) table of each part
    row: Tensor  # (P,) row of each part in its table
    tables: tuple[_Table, ...]


@lru_cache(maxsize=32)
def _geometry(library: AssetLibrary, device: torch.device) -> _Geometry:
    geometry = library_geometry(library.assets)
    levels = [asset.fine for asset in geometry.assets]
    part = torch.full((max(len(level.parts) for level in levels), len(levels)), -1)
    corners = torch.zeros(8, *part.shape, 3, dtype=torch.float32)
    cube = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    for asset, level in enumerate(levels):
        part[: len(level.ids), asset] = torch.from_numpy(level.ids)
        for index, shape in enumerate(level.parts):
            points = torch.from_numpy(shape.vertices).float()
            if len(points) > 8:
                points = points.amin(dim=0) + cube * (points.amax(dim=0) - points.amin(dim=0))
            corners[:, index, asset] = points[torch.arange(8).clamp(max=len(points) - 1)]
    hull = torch.from_numpy(padded([points.float().numpy() for points in hull_corners(library)]))
    work = torch.from_numpy(np.stack([geometry.corners, geometry.directions])).float()
    size_class = torch.from_numpy(np.unique(geometry.size_class, return_inverse=True)[1])
    columns = (torch.from_numpy(geometry.static), work, hull.permute(1, 2, 0), part, corners.transpose(2, 3))
    tables = tuple(
        _Table(*(torch.from_numpy(column).float().movedim(0, -1).contiguous().to(device) for column in columns))
        for _, table in sorted(geometry.tables.items())
        for columns in [(table.vertices, table.normals, table.offsets)]
    )
    row = torch.from_numpy(geometry.row)
    return _Geometry._make((*(column.contiguous().to(device) for column in (*columns, size_class, row)), tables))


class _Things(NamedTuple):
    """The objects (n) of some scenes. Boxes start at the translation of the object."""

    geometry: _Geometry
    slots: tuple[int, int]  # scenes, and slots of each
    at: Tensor  # (n,) slot, counted over all scenes
    category: Tensor  # (n,)
    fixed: Tensor  # (n,) bool
    rotation: Tensor  # (3, 3, n)
    translation: Tensor  # (3, n) m
    box: Tensor  # (2, 3, n) m, lowest and highest corner
    boxes: Tensor  # (2, 3, F, n) m, those of its parts; infinite where there is none

    @classmethod
    def of(cls, batch: SceneBatch, fixed: Tensor) -> _Things:
        """All objects of a batch; those of static assets are ``fixed`` (B, N) as well."""
        geometry = _geometry(batch.scene_type.library, batch.tensor.device)
        at = torch.nonzero(~batch.is_empty.flatten())[:, 0]
        category = batch.categories.flatten()[at]
        rotation = batch.rotations.flatten(0, 1)[at].permute(1, 2, 0).contiguous()
        box, boxes = (_box(rotation, _at(points, category)) for points in (geometry.hull, geometry.corners))
        boxes = torch.stack([torch.maximum(boxes[0], box[0, :, None]), torch.minimum(boxes[1], box[1, :, None])])
        none = boxes.new_tensor([torch.inf, -torch.inf]).view(2, 1, 1, 1)
        boxes = torch.where(_at(geometry.part, category) < 0, none, boxes)
        fixed = fixed.flatten()[at] | geometry.static[category]
        translation = batch.translations.flatten(0, 1)[at].T.contiguous()
        slots = len(batch), batch.tensor.shape[1]
        return cls(geometry, slots, at, category, fixed, rotation, translation, box, boxes)

    def take(self, rows: Tensor) -> _Things:
        """The objects ``rows``."""
        return _Things(*self[:2], *(column[..., rows] for column in self[2:]))

    def near(self, margin: float, height: float) -> tuple[Tensor, Tensor]:
        """Pairs (P,), (P,) of objects of a scene whose boxes are within ``margin`` m of each other, and within
        ``height`` m along z. Two fixed objects are no pair, and in a scene that is a heap nothing is.
        """
        scenes, slots = self.slots
        low, high = (self.box.new_full((3, scenes * slots), value) for value in (torch.inf, -torch.inf))
        low[:, self.at], high[:, self.at] = self.translation + self.box
        row, free = self.at.new_zeros(scenes * slots), self.fixed.new_zeros(scenes * slots)
        row[self.at], free[self.at] = torch.arange(len(self.at), device=row.device), ~self.fixed
        low, high, free = low.view(3, scenes, slots), high.view(3, scenes, slots), free.view(scenes, slots)
        near = (free[:, :, None] | free[:, None]).triu(diagonal=1)
        for axis, reach in enumerate((margin, margin, height)):
            upper = high[axis] + reach
            near &= (low[axis][:, :, None] <= upper[:, None]) & (low[axis][:, None] <= upper[:, :, None])
        scene, first, second = torch.nonzero(near).unbind(dim=1)
        first, second = row[scene * slots + first], row[scene * slots + second]
        corners, directions = _at(self.geometry.work, self.category)
        tests = corners[first] * directions[second] + directions[first] * corners[second]
        kept = torch.nonzero(tests.new_zeros(scenes).index_add_(0, scene, tests)[scene] <= _HEAP)[:, 0]
        return first[kept], second[kept]

    def spans(self, first: Tensor, second: Tensor, axis: int) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """(F, P) m, lowest and highest coordinate along an axis of the parts of two objects, from the first object."""
        away = self.translation[axis, second] - self.translation[axis, first]
        low, high = self.boxes[:, axis]
        return (_at(low, first), _at(high, first)), (_at(low, second) + away, _at(high, second) + away)


def _box(rotation: Tensor, points: Tensor) -> Tensor:
    """(2, 3, ..., n) lowest and highest corner of rotated points (V, ..., 3, n)."""
    axes = [_dot(points.unbind(dim=-2), rotation[axis]) for axis in range(3)]
    return torch.stack([torch.stack([axis.amin(dim=0), axis.amax(dim=0)]) for axis in axes], dim=1)


class _Parts(NamedTuple):
    """Pairs of convex parts (Q,) of the object pairs (P,) of some scenes."""

    pair: Tensor  # object pair
    first: Tensor  # objects
    second: Tensor
    one: Tensor  # places of the parts in these objects
    two: Tensor

    @classmethod
    def near(cls, things: _Things, first: Tensor, second: Tensor, margin: float, height: float) -> _Parts:
        """Those whose boxes are within ``margin`` m, and within ``height`` m along z."""
        near = None
        for axis, reach in enumerate((margin, margin, height)):
            (low_a, high_a), (low_b, high_b) = things.spans(first, second, axis)
            here = (low_b <= high_a[:, None] + reach) & (low_a[:, None] - reach <= high_b)
            near = here if near is None else near & here
        assert near is not None
        one, two, pair = torch.nonzero(near).unbind(dim=1)
        return cls(pair, first[pair], second[pair], one, two)

    @staticmethod
    def touching(things: _Things, lower: Tensor, upper: Tensor) -> Tensor:
        """(P,) bool, whether a point of each object pair shows that the upper one stands on the lower one: the middle
        of the largest common area of the boxes of two parts at the same height lies in both parts.
        """
        area = torch.ones_like(things.box[0, 0, :1])
        for axis in range(2):
            (low_a, high_a), (low_b, high_b) = things.spans(lower, upper, axis)
            common = torch.minimum(high_a[:, None], high_b).sub_(torch.maximum(low_a[:, None], low_b))
            area = area * common.clamp_(min=0.0)
        (_, high), (low, _) = things.spans(lower, upper, 2)
        largest, place = torch.where((low - high[:, None]).abs_() < _TOUCHING, area, 0.0).flatten(0, 1).max(dim=0)
        pair, most = torch.nonzero(largest > 0)[:, 0], len(things.geometry.part)
        parts = _Parts(pair, lower[pair], upper[pair], place[pair] // most, place[pair] % most)
        one, two = parts.boxes(things)
        middle = (torch.maximum(one[0], two[0]) + torch.minimum(one[1], two[1])) / 2
        outside = torch.zeros_like(middle[0])
        for rows, sides in parts.groups(things):
            for table, row, turn, origin in sides:
                point = _dot(turn, _at(middle, rows) - origin)  # in the frame of the object
                heights = _dot(_at(table.normals, row).unbind(dim=1), point) - _at(table.offsets, row)
                outside[rows] = torch.maximum(outside[rows], heights.amax(dim=0))
        stands = torch.zeros_like(lower, dtype=torch.bool)
        stands[pair] = outside < 0.5 * _FLOATING
        return stands

    def groups(self, things: _Things) -> Iterator[tuple[Tensor, tuple[_Side, _Side]]]:
        """Rows (q,) of pairs of parts of the same sizes, and both parts."""
        geometry, count = things.geometry, len(things.geometry.tables)
        owners, parts = torch.stack([self.first, self.second]), torch.stack([self.one, self.two])
        parts = geometry.part[parts, things.category[owners]]
        one, two = geometry.size_class[parts]
        numbers = torch.bincount(one * count + two, minlength=count * count).tolist()
        order = (one * count + two).argsort(stable=True)
        owners, parts = owners[:, order], geometry.row[parts][:, order]
        block = _BLOCKS.get(order.device.type, _BLOCK)
        start = 0
        for number, total in enumerate(numbers):
            tables = geometry.tables[number // count], geometry.tables[number % count]
            size = sum(len(a.vertices) * len(b.normals) for a, b in (tables, tables[::-1]))
            for first in range(start, start + total, max(1, block // size)):
                rows = slice(first, min(start + total, first + max(1, block // size)))
                origin = _at(things.translation, owners[0, rows])
                a, b = (
                    _Side(table, row, _at(things.rotation, owner), _at(things.translation, owner) - origin)
                    for table, row, owner in zip(tables, parts[:, rows], owners[:, rows], strict=True)
                )
                yield order[rows], (a, b)
            start += total

    def gaps(self, things: _Things) -> Iterator[_Group]:
        """Signed gaps over the face directions of both parts."""
        for rows, (a, b) in self.groups(things):
            gap_a, normal_a = a.gaps(b)
            gap_b, normal_b = b.gaps(a)
            yield rows, torch.cat([gap_a, gap_b]), torch.cat([normal_a, -normal_b])

    def planes(self, things: _Things, way: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Object pairs (R,), gaps (R,) m and directions (3, R) of planes between their parts that are met once the
        second objects have gone ``way`` (3, P) m: sides of the boxes of parts where these are then apart, of which the
        nearest one of each object pair is enough, and face planes elsewhere.
        """
        axes, (one, two) = _AXES.to(way), self.boxes(things)
        sides = torch.stack([two[0] - one[1], one[0] - two[1]], dim=1).flatten(0, 1)
        gap, side, after = _met(sides, axes[..., None], _at(way, self.pair))
        crossing = (after < -_FLOATING) | (side < 4)
        count = 6 * way.shape[1]
        nearest = gap.new_full((count + 1,), torch.inf)
        nearest.scatter_reduce_(0, torch.where(crossing, count, 6 * self.pair + side), gap, "amin")
        rows = torch.nonzero(nearest[:-1] < torch.inf)[:, 0]
        others = _Parts(*(column[torch.nonzero(crossing)[:, 0]] for column in self))
        gap, normal = way.new_empty(len(others.pair)), way.new_empty(3, len(others.pair))
        for some, gaps, normals in others.gaps(things):
            gap[some], best, _ = _met(gaps, normals, _at(way, others.pair[some]))
            normal[:, some] = _chosen(normals, best)
        normal = torch.cat([axes[rows % 6].T, normal], dim=1)
        return torch.cat([rows // 6, others.pair]), torch.cat([nearest[rows], gap]), normal

    def boxes(self, things: _Things) -> tuple[Tensor, Tensor]:
        """(2, 3, Q) m each, lowest and highest corners of the boxes of both parts, from the first object on."""
        away = _at(things.translation, self.second) - _at(things.translation, self.first)
        boxes, count = things.boxes.flatten(2), len(things.at)
        return _at(boxes, self.one * count + self.first), _at(boxes, self.two * count + self.second) + away


def _met(gaps: Tensor, normals: Tensor, way: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of planes with ``gaps`` (K, q) m and ``normals`` (K, 3, q), the one broken least now of all that are met after a
    ``way`` (3, q) m: its gap (q,), which it is (q,), and the largest gap (q,) after the way.
    """
    after = gaps + _dot(normals.unbind(dim=1), way)
    largest = after.amax(dim=0)
    gap, best = torch.where(after >= largest.clamp(max=0.0) - _MET, gaps, -torch.inf).max(dim=0)
    return gap, best, largest


_Group = tuple[Tensor, Tensor, Tensor]
"""Rows (q,) of pairs of parts, their gaps (K, q) m and the directions (K, 3, q) of these, from first to second."""


class _Side(NamedTuple):
    """Parts (q,) of one table."""

    table: _Table
    row: Tensor  # (q,) row in the table
    turn: Tensor  # (3, 3, q) rotation
    origin: Tensor  # (3, q) m, translation

    def gaps(self, other: _Side) -> tuple[Tensor, Tensor]:
        """(K, q) gaps from the faces of these parts to the other ones, and (K, 3, q) normals of the faces, world."""
        normals, vertices = _at(self.table.normals, self.row), _at(other.table.vertices, other.row)
        world = _dot(normals[:, None].unbind(dim=2), self.turn.unbind(dim=1))
        seen = _dot(world[:, None].unbind(dim=2), other.turn)  # in the frame of the others
        heights = _dot(seen[:, None].unbind(dim=2), vertices.unbind(dim=1)).amin(dim=1)
        heights += _dot(world.unbind(dim=1), other.origin - self.origin)
        return heights.sub_(_at(self.table.offsets, self.row)), world


def _dot(a: Sequence[Tensor] | Tensor, b: Sequence[Tensor] | Tensor) -> Tensor:
    """Sum of the products of three tensors with three others."""
    return (a[0] * b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])


def _at(columns: Tensor, index: Tensor) -> Tensor:
    """Columns (..., q) of the last axis."""
    return columns.index_select(-1, index)


def _chosen(directions: Tensor, best: Tensor) -> Tensor:
    """(3, q) directions ``best`` (q,) of (K, 3, q)."""
    return directions.gather(0, best.expand(1, 3, -1)).squeeze(0)


# -- falls ------------------------------------------------------------------------------------------


def _falls(things: _Things, limit: float) -> Tensor:
    """(n,) m, distance that each free object falls until it meets another one; 0 where it exceeds ``limit``.

    Objects fall straight down, without turning, the lowest first, so that each follows its support. The distance
    follows from the face planes of the parts, and is at most the true one.
    """
    first, second = things.near(0.0, limit)
    bottom = things.translation[2] + things.box[0, 2]
    swap = bottom[first] > bottom[second]
    lower, upper = torch.where(swap, second, first), torch.where(swap, first, second)
    kept = torch.nonzero(~things.fixed[upper])[:, 0]
    lower, upper = lower[kept], upper[kept]
    # Most objects stand: what one pair of parts shows needs no look at the others.
    none, zero = torch.full_like(bottom, torch.inf), torch.zeros_like(bottom)
    ground = torch.where(things.fixed, zero, none)
    room = torch.where(_Parts.touching(things, lower, upper), 0.0, none[:1])
    standing = _reach(lower, upper, room, ground, ground, torch.inf) == 0
    kept = torch.nonzero(~standing[upper])[:, 0]
    lower, upper = lower[kept], upper[kept]
    room = _rooms(things, _Parts.near(things, lower, upper, 0.0, limit), len(lower))
    return _reach(lower, upper, room, zero, none, limit)


def _rooms(things: _Things, parts: _Parts, pairs: int) -> Tensor:
    """(P,) m, vertical distance of the second object of ``pairs`` to the first; infinite where it passes it."""
    room = things.box.new_full((pairs,), torch.inf)
    for rows, gaps, normals in parts.gaps(things):
        speed = -normals[:, 2]  # change of a gap per metre of fall
        when = -gaps / speed
        at_wall = ((speed.abs() < _WALL) & (gaps >= -_WALL_OVERLAP)).any(dim=0)
        enter = torch.where(speed < -_WALL, when, -torch.inf).amax(dim=0)
        leave = torch.where(speed > _WALL, when, torch.inf).amin(dim=0)
        meets = ~at_wall & (enter < leave) & (leave > 0)
        room = room.scatter_reduce(0, parts.pair[rows], torch.where(meets, enter.clamp(min=0.0), torch.inf), "amin")
    return room


def _reach(lower: Tensor, upper: Tensor, room: Tensor, start: Tensor, ground: Tensor, limit: float) -> Tensor:
    """(n,) m, fall of each object onto the ``lower`` ones below it, which fall themselves; ``ground`` (n,) is the
    distance to the ground, and a fall of more than ``limit`` is none.
    """
    fall = start
    for _ in range(_STACKED):
        fall = ground.scatter_reduce(0, upper, room + fall[lower], "amin")
        fall = fall.masked_fill(fall > limit, 0.0)
    return fall


# -- apart ------------------------------------------------------------------------------------------


def _furniture_apart(things: _Things, pieces: Tensor, fixed: Tensor, bounds: Tensor) -> _Things:
    """The objects after ``pieces`` of furniture that are not ``fixed`` moved apart, with what is on them."""
    furniture = things.take(pieces)._replace(fixed=fixed)
    moves = _apart(furniture, bounds, torch.tensor(_LEVEL).to(bounds)) - furniture.translation
    scenes, slots = things.slots
    place = furniture.translation
    columns = torch.cat([moves, place, *(place + furniture.box)])
    dense = bounds.new_full((12, scenes * slots), torch.inf)
    dense[:, furniture.at] = torch.where(fixed, torch.inf, columns)
    own = dense.view(12, scenes, slots)[:, things.at // slots]  # (12, n, N)
    _, middle, low, high = own.split(3)
    here = things.translation[..., None]
    over = ((here[:2] >= low[:2]) & (here[:2] <= high[:2])).all(dim=0) & (here[2] >= low[2]) & ~things.fixed[:, None]
    distance = torch.where(over, (here[:2] - middle[:2]).abs().amax(dim=0), torch.inf)
    nearest, holder = distance.min(dim=1)
    carried = own[:3].gather(2, holder.expand(3, -1)[..., None]).squeeze(2)
    shift = torch.where(nearest < torch.inf, carried, 0.0)
    shift[:, pieces] = moves
    return things._replace(translation=things.translation + shift)


def _apart(things: _Things, bounds: Tensor, cost: Tensor) -> Tensor:
    """(3, n) m, translations after one round of projection of the objects that overlap and their neighbours.

    Each overlapping pair gets a way out of the overlap. The planes that separate its parts after this way, and those
    that separate near parts of other pairs, are the rows of a least-distance problem. ``cost`` (3,) is that of a metre
    along each axis of the world.
    """
    first, second = things.near(projection.REACH, projection.REACH)
    way = _ways_out(things, first, second, bounds, cost)
    touched = torch.zeros_like(things.fixed)
    rows = torch.nonzero(way.any(dim=0))[:, 0]
    touched[first[rows]] = touched[second[rows]] = True
    chosen = touched[first] | touched[second]
    beside = first.new_zeros(len(touched))  # neighbours must not be pushed into what is fixed
    for ends in (first, second):
        beside.index_add_(0, ends, chosen.long())
    free_end = torch.where(things.fixed[first], second, first)
    chosen |= (things.fixed[first] | things.fixed[second]) & (beside[free_end] > 0)
    rows = torch.nonzero(chosen)[:, 0]
    parts = _Parts.near(things, first[rows], second[rows], projection.REACH, projection.REACH)
    pair, gap, direction = parts.planes(things, _at(way, rows))
    return _nearest(things, first[rows[pair]], second[rows[pair]], direction, projection.CLEARANCE - gap, bounds, cost)


def _ways_out(things: _Things, first: Tensor, second: Tensor, bounds: Tensor, cost: Tensor) -> Tensor:
    """(3, P) m, ways of the second objects on which pairs of objects come out of each other at the least cost; zeros
    for pairs that overlap by less than ``_DEEP``. The axes are tried, the level directions away from and toward the
    other object, and the face normals of the deepest and of the shallowest overlap of parts.
    """
    offset = _at(things.translation, second) - _at(things.translation, first)
    overlap = torch.minimum(
        _at(things.box[1], first) - _at(things.box[0], second) - offset,
        _at(things.box[1], second) - _at(things.box[0], first) + offset,
    )
    rows = torch.nonzero((overlap > _DEEP).all(dim=0))[:, 0]
    parts = _Parts.near(things, first[rows], second[rows], -_DEEP, -_DEEP)
    parts = parts._replace(pair=rows[parts.pair])
    groups = []
    for some, gaps, normals in parts.gaps(things):
        gap, best = gaps.max(dim=0)
        groups.append((parts.pair[some], gap, _chosen(normals, best), gaps, normals))
    if not groups:
        return torch.zeros_like(offset)
    pair, gap, normal = (torch.cat(columns, dim=-1) for columns in list(zip(*groups, strict=True))[:3])
    deepest = torch.zeros_like(offset[0]).scatter_reduce(0, pair, gap, "amin")
    shallow = torch.full_like(deepest, -torch.inf)
    shallow = shallow.scatter_reduce(0, pair, torch.where(gap < 0, gap, -torch.inf), "amax")
    deep = torch.nonzero(deepest < -_DEEP)[:, 0]
    place = torch.full_like(first, len(deep)).index_put_((deep,), torch.arange(len(deep), device=deep.device))
    level = _at(offset, deep) * offset.new_tensor([1.0, 1.0, 0.0])[:, None]
    level = torch.where(level.norm(dim=0) > 1e-6, level, offset.new_tensor([1.0, 0.0, 0.0])[:, None])
    level = F.pad(level / level.norm(dim=0), (0, 1))  # the last column is of all other pairs
    axes = _AXES.to(offset)[..., None].expand(-1, -1, level.shape[1])
    directions = torch.cat([axes, torch.stack([level, -level, level, level])])
    for found, extreme in zip(directions[-2:], (deepest, shallow), strict=True):
        found[:, torch.where(gap == extreme[pair], place[pair], len(deep))] = normal
    directions = directions[..., :-1]
    passes = []
    for owner, _, _, gaps, normals in groups:
        kept = torch.nonzero(place[owner] < len(deep))[:, 0]
        owner, gaps, normals = place[owner[kept]], _at(gaps, kept), _at(normals, kept)
        speed = _dot(_at(directions, owner)[:, None].unbind(dim=2), normals.unbind(dim=1)).sub_(projection.STILL)
        when, nearer = -gaps / speed, speed < 0  # (D, K, q)
        enter = torch.where(nearer, when, -torch.inf).amax(dim=1)
        passes.append((owner.expand_as(enter), enter, when.masked_fill_(nearer, torch.inf).amin(dim=1)))
    owner, enter, leave = (torch.cat(columns, dim=1) for columns in zip(*passes, strict=True))
    length = torch.zeros_like(directions[:, 0])
    for _ in range(_SWEEPS):
        here = length.gather(1, owner) + _MET
        length = length.scatter_reduce(1, owner, torch.where((enter < here) & (leave > here), leave, 0.0), "amax")
    length = length.clamp(max=projection.FAR)
    price = _weights(things, (first[deep], second[deep]), directions, length, bounds)
    best = (length * price * (directions * cost[:, None]).norm(dim=1)).argmin(dim=0)
    way = _chosen(directions, best) * (length.gather(0, best[None]) + projection.CLEARANCE)
    return torch.zeros_like(offset).index_copy_(1, deep, way)


def _weights(
    things: _Things, ends: tuple[Tensor, Tensor], directions: Tensor, length: Tensor, bounds: Tensor
) -> Tensor:
    """(D, P) cost factors of a metre in each direction (D, 3, P)."""
    first, second = ends
    place, fixed = things.translation, things.fixed
    held = fixed[first] | fixed[second]
    # The motion of the free object, or of the upper one of two.
    is_first = ~fixed[first] & (fixed[second] | (place[2, first] > place[2, second]))
    motion = torch.where(is_first, -directions, directions)
    rise = motion[:, 2]
    weight = torch.where(held & (rise < -0.7), projection.DOWN, 1.0)
    weight = torch.where(~held & (rise.abs() > 0.7), projection.UP, weight)
    target = place[:, torch.where(is_first, first, second)] + motion * length[:, None]
    low, high = bounds[..., None]
    leaves = ((target < low) | (target > high)).any(dim=1)
    return torch.where(leaves & (held | (rise > 0.7)), weight * projection.BLOCKED, weight)


def _nearest(
    things: _Things, first: Tensor, second: Tensor, direction: Tensor, needed: Tensor, bounds: Tensor, cost: Tensor
) -> Tensor:
    """(3, n) m, the translations nearest to those of ``things`` at which planes (R,) are met as well as possible.

    A plane is met when the offset from the ``first`` to the ``second`` object grows by ``needed`` m along
    ``direction`` (3, R). Distances count ``cost`` (3,); slack of planes is not forbidden, but costs far more. The dual
    is solved by an accelerated projected gradient method (FISTA, Beck and Teboulle, 2009) whose steps fit the number
    of planes of each object (Pock and Chambolle, 2011). A plane joins the problem when a solution without it breaks it.
    """
    home = things.translation
    scale = cost[:, None]
    size = (direction / scale).norm(dim=0)
    direction, needed = direction / scale / size, needed / size
    low, high = bounds[..., None]
    loose = torch.ones_like(things.fixed)
    loose[first] = loose[second] = False
    loose = loose | ((home < low - projection.OUTSIDE) | (home > high + projection.OUTSIDE)).any(dim=0)
    low, high = (torch.where(loose, sign * torch.inf, (limit - home) * scale) for sign, limit in ((-1, low), (1, high)))
    # A plane along an axis between a fixed object and a free one limits the free one exactly.
    is_limit = (direction.abs().amax(dim=0) > 1.0 - _MET) & (things.fixed[first] | things.fixed[second])
    away = torch.where(things.fixed[first], direction, -direction)
    owner = torch.where(things.fixed[first], second, first).expand(3, -1)
    least = torch.where(is_limit & (away > 0.5), needed, -torch.inf)
    most = torch.where(is_limit & (away < -0.5), -needed, torch.inf)
    low, high = low.scatter_reduce(1, owner, least, "amax"), high.scatter_reduce(1, owner, most, "amin")
    limits = torch.stack([low, high]).masked_fill(things.fixed, 0.0)
    found = torch.zeros_like(needed)
    used, x = ~is_limit & (needed > 0), torch.zeros_like(home)
    for _ in range(_ROUNDS):
        rows = torch.nonzero(used)[:, 0]
        ends = torch.cat([second[rows], first[rows]])
        normal = _at(direction, rows)
        x, found[rows] = _solved(ends, torch.cat([normal, -normal], dim=1), needed[rows], found[rows], limits)
        used = used | ~is_limit & (needed - (direction * (_at(x, second) - _at(x, first))).sum(dim=0) > _MET)
    return home + x / scale


def _solved(ends: Tensor, direction: Tensor, needed: Tensor, found: Tensor, limits: Tensor) -> tuple[Tensor, Tensor]:
    """Moves (3, n) between ``limits`` (2, 3, n) and multipliers (R,) after some steps from the multipliers ``found``.

    Each plane has two ``ends`` (2R,), which it pulls along ``direction`` (3, 2R).
    """
    places, size = ends.expand(3, -1), direction.abs()
    planes = torch.zeros_like(limits[0]).scatter_add_(1, places, size) * (limits[0] < limits[1])
    step = 1.0 / ((size * _at(planes, ends)).sum(dim=0).view(2, -1).sum(dim=0) + projection.SLACK**-2)
    kept, target, count = 1.0 - step * projection.SLACK**-2, step * needed, len(needed)

    def moved(multipliers: Tensor) -> Tensor:
        pull = (direction.view(3, 2, count) * multipliers).view(3, -1)
        return torch.zeros_like(limits[0]).scatter_add_(1, places, pull).clamp_(limits[0], limits[1])

    ahead, momentum = found, 1.0
    for _ in range(_STEPS):
        offset = (direction * _at(moved(ahead), ends)).sum(dim=0).view(2, -1).sum(dim=0)
        new = torch.addcmul(target, ahead, kept).addcmul_(step, offset, value=-1.0).clamp_(min=0.0)
        following = 0.5 * (1.0 + (1.0 + 4.0 * momentum**2) ** 0.5)
        ahead = torch.lerp(found, new, 1.0 + (momentum - 1.0) / following)
        found, momentum = new, following
    return moved(found), found
