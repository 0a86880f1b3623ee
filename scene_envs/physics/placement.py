"""Objects of some scenes as flat arrays, their convex parts in the world, gaps between these, and budgets of work."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from scene_envs.arrays import Array, Index, Mask, ranges
from scene_envs.physics.parts import SIZE_CLASSES, LibraryGeometry, PartTable, Rows, apply, times

_CLASSES = len(SIZE_CLASSES) + 1
_BLOCK = 1 << 16
"""Face-corner combinations computed together: their arrays stay in the cache."""
Level = Literal["fine", "coarse"]
PER_SCENE, PER_OBJECT, PER_PAIR, MAX_PER_OBJECT = 1_000.0, 1_200.0, 500.0, 10_000.0
"""Units of simulation (see :class:`Budget`) that a scene may take: ``PER_SCENE``, plus ``PER_OBJECT`` for each free
object, plus ``PER_PAIR`` for each pair of free objects, because they may meet. The sum of the last two is at most
``MAX_PER_OBJECT`` for each free object."""
MIN_UNITS = 20_000.0
"""Smallest number of units beyond ``PER_SCENE``, unless ``MAX_PER_OBJECT`` gives fewer. It lets a scene of five
objects go through all rounds of :func:`~scene_envs.physics.make_ready`."""
_CROWDED = 0.75
"""Above this share of free objects that do not stand clear of each other, a scene gets only ``PER_SCENE`` units."""
_COINCIDENT = 0.9
"""Two objects coincide when the common part of their boxes is at least this share of the larger box."""
_DEEP = 1e-2
"""A free object does not stand clear when it is deeper than this (m) in another free one, or coincides with one."""


@dataclass(frozen=True, eq=False)
class PlacedParts:
    """Parts of placed objects."""

    part: Index  # (I,) index of the part in the library
    rotation: Array  # (I, 3, 3), asset frame to world
    translation: Array  # (I, 3) m, world


def separations(library: LibraryGeometry, placed: PlacedParts, first: Index, second: Index) -> tuple[Array, Array]:
    """Largest signed gap of each pair of ``placed`` parts, rows (P,), over all face directions of both: gap (P,) m,
    positive when a face plane separates the pair, and its direction (P, 3) in the world, from first to second. The true
    distance is at least ``gap``, the true depth at most ``-gap``.
    """
    gap, direction = np.empty(len(first)), np.empty((len(first), 3))
    for rows, a, b in _groups(library, placed, first, second):
        combinations = a.normals.shape[1] * b.vertices.shape[1] + b.normals.shape[1] * a.vertices.shape[1]
        step = max(1, _BLOCK // combinations)
        for start in range(0, len(rows), step):
            some = rows[start : start + step]
            one, two = first[some], second[some]
            shift = placed.translation[two] - placed.translation[one]
            gap_a, normal_a = _best(*_face_gaps(library, placed, a, one, b, two, shift), placed.rotation[one])
            gap_b, normal_b = _best(*_face_gaps(library, placed, b, two, a, one, -shift), placed.rotation[two])
            use_a = gap_a >= gap_b
            gap[some] = np.where(use_a, gap_a, gap_b)
            direction[some] = np.where(use_a[:, None], normal_a, -normal_b)
    return gap, direction


def _groups(
    library: LibraryGeometry, placed: PlacedParts, first: Index, second: Index
) -> Iterator[tuple[Index, PartTable, PartTable]]:
    """Rows of the pairs whose parts are in the same two tables, and these tables."""
    classes = library.size_class[placed.part]
    groups = classes[first] * _CLASSES + classes[second]
    for group in np.unique(groups):
        class_a, class_b = divmod(int(group), _CLASSES)
        yield np.flatnonzero(groups == group), library.tables[class_a], library.tables[class_b]


def grouped_gaps(
    library: LibraryGeometry, placed: PlacedParts, first: Index, second: Index, shift: Array
) -> Iterator[tuple[Index, Array, Array]]:
    """Signed gaps of pairs of ``placed`` parts, rows (P,), over *all* face directions of both, in groups of equal size:
    yields rows (Q,), gaps (Q, K) m and directions (Q, K, 3) in the world, from first to second. ``shift`` (P, 3) m
    leads from the origin of the first part's object to that of the second part's object.
    """
    for rows, a, b in _groups(library, placed, first, second):
        one, two = first[rows], second[rows]
        gap_a, normal_a = _face_gaps(library, placed, a, one, b, two, shift[rows])
        gap_b, normal_b = _face_gaps(library, placed, b, two, a, one, -shift[rows])
        normal_a, normal_b = (
            normal @ placed.rotation[side].swapaxes(1, 2) for normal, side in ((normal_a, one), (normal_b, two))
        )
        yield rows, np.concatenate([gap_a, gap_b], axis=1), np.concatenate([normal_a, -normal_b], axis=1)


def _face_gaps(
    library: LibraryGeometry,
    placed: PlacedParts,
    table: PartTable,
    owner: Index,
    other_table: PartTable,
    other: Index,
    shift: Array,
) -> tuple[Array, Array]:
    """Gaps (P, K) of every face of the owners to the other parts, and its normal (P, K, 3) in the frame of its asset;
    ``shift`` (P, 3) leads to the other part.
    """
    row, inverse = library.row[placed.part[owner]], placed.rotation[other].swapaxes(-1, -2)
    normals, vertices = table.normals[row], other_table.vertices[library.row[placed.part[other]]]
    seen = normals @ times(inverse, placed.rotation[owner]).swapaxes(1, 2)  # (P, K, 3) in the other's frame
    x, y, z = apply(inverse, shift).T[..., None]
    away = seen[..., 0] * x + seen[..., 1] * y + seen[..., 2] * z
    return (vertices @ seen.swapaxes(1, 2)).min(axis=1) + away - table.offsets[row], normals


def _best(gaps: Array, normals: Array, rotation: Array) -> tuple[Array, Array]:
    """The largest of gaps (P, K), and the direction (P, 3) of its normal (P, K, 3) after the rotation (P, 3, 3)."""
    line, best = np.arange(len(gaps)), gaps.argmax(axis=1)
    return gaps[line, best], apply(rotation, normals[line, best])


@dataclass(frozen=True, eq=False)
class Objects(Rows):
    """The non-empty slots of some scenes, flattened."""

    scene: Index  # (n,) scene of each object, ascending
    slot: Index  # (n,) slot of each object, ascending within a scene
    category: Index  # (n,) asset index
    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) m
    fixed: Mask  # (n,) bool, welded or static

    def __len__(self) -> int:
        return len(self.scene)


def flatten(
    library: LibraryGeometry, translations: Array, rotations: Array, categories: Index, welded: Mask
) -> Objects:
    """The objects of scenes given as (B, N, 3), (B, N, 3, 3), (B, N) and a mask of welded slots (B, N)."""
    scene, slot = np.nonzero(categories < len(library.assets))
    category = categories[scene, slot].astype(np.int64)
    fixed = welded[scene, slot] | library.static[category]
    return Objects(scene, slot, category, rotations[scene, slot], translations[scene, slot], fixed)


@dataclass(frozen=True, eq=False)
class PlacedObjects:
    """Parts of objects at one level of detail, with their bounding boxes."""

    parts: PlacedParts  # (I,) placed parts, those of one object together
    start: Index  # (n,) first part of each object
    count: Index  # (n,) number of parts of each object
    low: Array  # (I, 3) lowest corner of each part's box, m
    high: Array  # (I, 3) highest corner of each part's box, m


def place(library: LibraryGeometry, objects: Objects, level: Level) -> PlacedObjects:
    """Put the parts of ``objects`` into the world."""
    ids = [getattr(asset, level).ids for asset in library.assets]
    first, counts = (np.array(values)[objects.category] for values in ([i[0] for i in ids], [len(i) for i in ids]))
    owner, part = ranges(first, counts)
    parts = PlacedParts(part, objects.rotation[owner], objects.translation[owner])
    low, high, classes = np.empty((len(part), 3)), np.empty((len(part), 3)), library.size_class[part]
    for size, table in library.tables.items():
        rows = np.flatnonzero(classes == size)
        corners = parts.rotation[rows] @ table.vertices[library.row[part[rows]]].swapaxes(1, 2)
        low[rows], high[rows] = corners.min(axis=2), corners.max(axis=2)
    start = np.cumsum(counts) - counts
    return PlacedObjects(parts, start, counts, low + parts.translation, high + parts.translation)


def object_boxes(placed: PlacedObjects) -> tuple[Array, Array]:
    """Bounding boxes (n, 3), (n, 3) of whole objects, m."""
    if not len(placed.start):
        return np.empty((0, 3)), np.empty((0, 3))
    return np.minimum.reduceat(placed.low, placed.start), np.maximum.reduceat(placed.high, placed.start)


def boxes_meet(low: Array, high: Array, other_low: Array, other_high: Array, one: Index, other: Index) -> Mask:
    """(P,) whether the boxes ``one`` (P,) of some (n, 3) and ``other`` (P,) of others (m, 3) meet."""
    meets = np.ones(len(one), dtype=bool)
    for bottom, top, other_bottom, other_top in zip(low.T, high.T, other_low.T, other_high.T, strict=True):
        meets &= (bottom.take(one) <= other_top.take(other)) & (other_bottom.take(other) <= top.take(one))
    return meets


def part_pairs(placed: PlacedObjects, first: Index, second: Index) -> tuple[Index, Index, Index]:
    """All pairs of parts of the object pairs (``first``, ``second``), both (P,): index (Q,) of the object pair, and the
    two parts (Q,), (Q,) as rows of ``placed.parts``.
    """
    sizes = placed.count[first] * placed.count[second]
    pair, within = ranges(np.zeros_like(sizes), sizes)
    columns = placed.count[second][pair]
    return pair, placed.start[first][pair] + within // columns, placed.start[second][pair] + within % columns


@dataclass(frozen=True, eq=False)
class Contacts(Rows):
    """Near pairs of parts."""

    first: Index  # (Q,) object rows
    second: Index  # (Q,) object rows, larger than ``first``
    part_first: Index  # (Q,) part of the first object in the library
    part_second: Index  # (Q,) part of the second object in the library
    gap: Array  # (Q,) m along ``direction``; the true distance is at least this much
    direction: Array  # (Q, 3) unit vector in the world, from the first part to the second

    def among(self, number: Index) -> Contacts:
        """The contacts of objects whose new ``number`` (n,) is not negative, renumbered."""
        first, second = number[self.first], number[self.second]
        return replace(self, first=first, second=second)[(first >= 0) & (second >= 0)]


@dataclass(frozen=True, eq=False)
class ObjectPairs:
    """Pairs of objects whose boxes are near each other."""

    first: Index  # (P,) object rows
    second: Index  # (P,) object rows, larger than ``first``
    gap: Array  # (P,) m, signed gap of the coarse parts along ``direction``
    direction: Array  # (P, 3) unit vector in the world, from the first object to the second
    depth: Array  # (P,) m, overlap of the fine parts; 0 without overlap
    low: Array  # (n, 3) lowest corner of each object's box, m
    high: Array  # (n, 3) highest corner of each object's box, m
    contacts: Contacts  # near pairs of the coarse parts of these objects
    rough: Mask  # (P,) the depth is an upper bound, from coarse parts: exact depths would take too long

    def among(self, rows: Index) -> ObjectPairs:
        """The pairs of the objects ``rows`` (m,), ascending, renumbered to 0..m-1."""
        number = np.full(len(self.low), -1, dtype=np.int64)
        number[rows] = np.arange(len(rows))
        first, second = number[self.first], number[self.second]
        kept = (first >= 0) & (second >= 0)
        first, second, low, high = first[kept], second[kept], self.low[rows], self.high[rows]
        gap, direction, depth = (column[kept] for column in (self.gap, self.direction, self.depth))
        return ObjectPairs(
            first, second, gap, direction, depth, low, high, self.contacts.among(number), self.rough[kept]
        )

    def deepest(self) -> Array:
        """(n,) m, the deepest overlap of each object."""
        depth = np.zeros(len(self.low))
        np.maximum.at(depth, self.first, self.depth)
        np.maximum.at(depth, self.second, self.depth)
        return depth


@dataclass
class Budget:
    """Units of work that a search or a simulation may spend: one tested pair of convex parts, or one free object over
    one step of 35 solver iterations (about 0.05 ms, several times that where objects are deep in each other).
    """

    limit: float  # number of units at which the work ends
    spent: float = 0.0  # number of units spent so far

    @property
    def is_spent(self) -> bool:
        """Whether the limit is reached."""
        return self.spent >= self.limit


def simulation_units(objects: Objects, pairs: ObjectPairs, count: int) -> Array:
    """(count,) units of simulation that each of ``count`` scenes, given as objects and near pairs, may take."""
    first, second = pairs.first, pairs.second
    low = np.maximum(pairs.low[first], pairs.low[second])
    high = np.minimum(pairs.high[first], pairs.high[second])
    volume = np.prod(pairs.high - pairs.low, axis=1)
    common = np.prod(np.maximum(high - low, 0.0), axis=1)
    close = (pairs.depth > _DEEP) | (common >= _COINCIDENT * np.maximum(volume[first], volume[second]))
    close &= ~(objects.fixed[first] | objects.fixed[second])
    crowded = np.zeros(len(objects), dtype=bool)
    crowded[first[close]] = crowded[second[close]] = True
    crowd, free = (np.bincount(objects.scene[rows], minlength=count) for rows in (crowded, ~objects.fixed))
    more = np.maximum(PER_OBJECT * free + PER_PAIR * free * (free - 1) / 2, MIN_UNITS)
    return PER_SCENE + np.where(crowd > _CROWDED * free, 0.0, np.minimum(more, MAX_PER_OBJECT * free))  # type: ignore[no-any-return]


def components(count: int, first: Index, second: Index) -> Index:
    """(count,) number of the connected component of each node, edges given as (P,), (P,)."""
    edges = csr_array((np.ones(len(first)), (first, second)), shape=(count, count))
    return connected_components(edges, directed=False)[1].astype(np.int64)  # type: ignore[no-any-return]
