"""Collision of objects: overlapping pairs of a scene and their depths, by boxes, face planes and exact depths."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from typing import Protocol

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.parts import LibraryGeometry, PartFeatures
from scene_envs.physics.placement import (
    Contacts,
    ObjectPairs,
    Objects,
    PlacedObjects,
    PlacedParts,
    object_boxes,
    part_pairs,
    place,
    separations,
)

_BLOCK = 1 << 15
"""Elements of the arrays that hold face-corner or edge-edge combinations at a time (they stay in the cache)."""
_ROUNDING = 1e-13
"""Sine of an angle, or length (m), that may be a rounding error."""
TOUCHING = 2e-5
"""Overlap (m) below which the face-plane bound is taken as the depth, and no exact depth is computed."""
NEAR = 3e-3
"""Object pairs are listed when their boxes are at most this far apart (m)."""
NEAR_FIXED = 0.06
"""The same limit in height (m) where one of the two is fixed: the fall of an object onto it has a closed form."""
_TOO_MANY = 20_000_000
"""Limit of corner tests in the overlapping object pairs of one scene; above it, depths are upper bounds."""


class PenetrationDepth:
    """Penetration depth of pairs of convex parts at any poses, from the corners (V, 3) m of each part in its own frame;
    points inside the hull are ignored.
    """

    def __init__(self, parts: Sequence[Array]) -> None:
        features = [PartFeatures.of(vertices) for vertices in parts]
        self._corners = _Ragged([part.corners for part in features])
        self._normals = _Ragged([part.normals for part in features])
        self._offset = np.concatenate([part.offsets for part in features])
        self._edge_faces = np.concatenate([part.edge_faces for part in features]).T.copy()  # within the part
        edges = [
            np.stack(
                [part.edge_point, part.edge_direction, part.edge_outward, *part.normals[part.edge_faces.T]], axis=1
            )
            for part in features
        ]
        self._edges = _Ragged(edges)
        # Corners once more, for all faces against all corners: tables of 2^k corners per part, padded with repetitions
        self._table = np.array([max(3, (len(part.corners) - 1).bit_length()) for part in features], dtype=np.int64)
        self._row = np.zeros(len(features), dtype=np.int64)
        self._tables: dict[int, Array] = {}  # (3, parts, 2^k)
        for index in np.unique(self._table):
            members = np.flatnonzero(self._table == index)
            self._row[members] = np.arange(len(members))
            padded = [np.resize(features[m].corners, (1 << int(index), 3)) for m in members]
            self._tables[int(index)] = np.stack(padded).transpose(2, 0, 1).copy()

    def __call__(self, placed: PlacedParts, first: Index, second: Index) -> tuple[Array, Array]:
        """Depth (P,) m and direction (P, 3) of pairs of placed parts, given as two arrays (P,) of rows of ``placed``.

        The second part has to move by the depth along the direction, a unit vector in the world, until the two only
        touch. Where they are apart, minus the depth is the gap along it, at most their distance. NaN poses give NaN.
        """
        depth, direction = np.empty(len(first)), np.empty((len(first), 3))
        a, b = placed.part[first], placed.part[second]
        work = self._normals.count[a] << self._table[b]
        work += self._normals.count[b] << self._table[a]
        with np.errstate(invalid="ignore", over="ignore"):
            for rows in _blocks(work, 4 * _BLOCK):
                depth[rows], direction[rows] = self._of_block(placed, first[rows], second[rows])
        return depth, direction

    def _of_block(self, placed: PlacedParts, first: Index, second: Index) -> tuple[Array, Array]:
        halves = _Halves(placed, first, second)
        faces = _Faces(self, halves)
        depth, normal = faces.least_depth()
        open_pairs = np.flatnonzero(depth > 0)
        if len(open_pairs):
            self._edge_depths(halves, faces, open_pairs, depth, normal)
        turn = placed.rotation[first].transpose(1, 2, 0)
        return depth, _turned(turn, normal).T

    def _edge_depths(self, halves: _Halves, faces: _Faces, pairs: Index, depth: Array, normal: Array) -> None:
        """Lower ``depth`` (P,) and set ``normal`` (3, P), first part's frame, where edges are nearer than faces."""
        both = self._useful_edges(halves, faces, (2 * pairs[:, None] + (0, 1)).ravel(), depth)
        sides = [both[both.half & 1 == side] for side in (0, 1)]
        sides[1] = sides[1].turned(halves)
        count = np.bincount(sides[1].half >> 1, minlength=len(depth))
        start = np.cumsum(count) - count
        of_first = sides[0].half >> 1
        columns = count[of_first]
        found = []
        for rows in _blocks(columns, _BLOCK):
            row, within = _expand(columns[rows])
            one = row + rows.start
            found.append(_crossings(sides[0], one, sides[1], start[of_first[one]] + within))
        pair = np.concatenate([item[0] for item in found]) if found else np.empty(0, dtype=np.int64)
        if not len(pair):
            return
        value = np.concatenate([item[1] for item in found])
        direction = np.concatenate([item[2] for item in found], axis=1)
        better = np.flatnonzero(value < depth[pair])
        better = better[np.lexsort((value[better], pair[better]))]
        pair, value, direction = pair[better], value[better], direction[:, better]
        # Nearly parallel edges may seem to cross by rounding only. The width along the direction of a crossing is an
        # upper bound on the depth in any case. So widths are computed, for the smallest depths first, until no other
        # crossing can give a smaller one.
        current = np.flatnonzero(np.diff(pair, prepend=-1))
        while len(current):
            width = self._width(halves, pair[current], direction[:, current])
            less = width < depth[pair[current]]
            depth[pair[current[less]]] = width[less]
            normal[:, pair[current[less]]] = direction[:, current[less]]
            following = current + 1
            current, following = current[following < len(pair)], following[following < len(pair)]
            goes_on = (pair[following] == pair[current]) & (value[following] < depth[pair[current]])
            current = following[goes_on]

    def _useful_edges(self, halves: _Halves, faces: _Faces, half: Index, depth: Array) -> _Edges:
        """The edges of the owners of some half pairs that can improve on ``depth`` (P,), in the owners' frames."""
        part = halves.owner[half]
        row, within = _expand(self._edges.count[part])
        edge = self._edges.start[part][row] + within
        half = half[row]
        one, two = faces.start[half] + self._edge_faces[0][edge], faces.start[half] + self._edge_faces[1][edge]
        kept = np.flatnonzero(faces.support[one] != faces.support[two])
        edge, half, one, two = edge[kept], half[kept], one[kept], two[kept]
        limit = depth[half >> 1] - _ROUNDING
        kept = np.flatnonzero((faces.corner_depth(one, two) < limit) & (faces.corner_depth(two, one) < limit))
        edge, half, one, two = edge[kept], half[kept], one[kept], two[kept]
        return _Edges(half, self._edges.vectors.take(edge, axis=2))

    def _width(self, halves: _Halves, pair: Index, direction: Array) -> Array:
        """Overlap (Q,) m of the projections of some pairs onto one direction (3, Q) each, frame of the first part."""
        turned = -_turned(halves.turn.take(2 * pair, axis=2), direction)
        part = np.concatenate([halves.owner[2 * pair], halves.owner[2 * pair + 1]])
        count = self._corners.count[part]
        row, within = _expand(count)
        corner = self._corners.vectors.take(self._corners.start[part][row] + within, axis=1)
        height = _dot(corner, np.concatenate([direction, turned], axis=1).take(row, axis=1))
        top = np.maximum.reduceat(height, np.cumsum(count) - count).reshape(2, -1)
        return np.asarray(top[0] + top[1] - _dot(turned, halves.move.take(2 * pair, axis=1)))


class _Ragged:
    """Vectors of all parts in one array ``vectors`` (3, ..., n), with ``start`` and ``count`` per part."""

    def __init__(self, vectors: list[Array]) -> None:
        self.vectors = np.concatenate(vectors).T.copy()
        self.count = np.array([len(item) for item in vectors], dtype=np.int64)
        self.start = np.cumsum(self.count) - self.count


class _Halves:
    """Pairs seen from both sides: half ``2 p`` belongs to the first part of pair ``p``, half ``2 p + 1`` to the second.
    In each, features of the part ``owner`` (2 P,) are tested, not of ``other`` (2 P,); ``turn`` (3, 3, 2 P) and
    ``move`` (3, 2 P) m lead from the frame of the owner to that of the other.
    """

    def __init__(self, placed: PlacedParts, first: Index, second: Index) -> None:
        self.owner = np.stack([placed.part[first], placed.part[second]], axis=1).ravel()
        self.other = np.stack([placed.part[second], placed.part[first]], axis=1).ravel()
        one, two = (placed.rotation[rows].transpose(1, 2, 0) for rows in (first, second))
        apart = (placed.translation[second] - placed.translation[first]).T
        relative = two[0][:, None] * one[0] + two[1][:, None] * one[1] + two[2][:, None] * one[2]
        self.turn = np.stack([relative, relative.swapaxes(0, 1)], axis=-1).reshape(3, 3, -1)
        moves = [-_turned(two.swapaxes(0, 1), apart), _turned(one.swapaxes(0, 1), apart)]
        self.move = np.stack(moves, axis=-1).reshape(3, -1)


class _Faces:
    """The faces of the owners of half pairs, from ``start`` (2 P,) of each half on, with their ``normal`` (n,) index;
    ``support`` (n,) is the number of the deepest corner of the other part under each face.
    """

    def __init__(self, depths: PenetrationDepth, halves: _Halves) -> None:
        count = depths._normals.count[halves.owner]
        self.start = np.cumsum(count) - count
        half, within = _expand(count)
        self.normal = depths._normals.start[halves.owner][half] + within
        self._own = depths._normals.vectors.take(self.normal, axis=1)
        self._seen = _turned(halves.turn.take(half, axis=2), self._own)  # in the other's frame
        self._level = _dot(self._seen, halves.move.take(half, axis=1)) + depths._offset[self.normal]
        self._half = half
        self.support = np.empty(len(half), dtype=np.int64)
        self._corner = np.empty((3, len(half)))
        self.depth = np.empty(len(half))
        kind = depths._table[halves.other]
        for index in np.unique(kind):
            rows = np.flatnonzero(kind[half] == index)
            table = depths._tables[int(index)]
            step = max(1, _BLOCK >> int(index))
            for begin in range(0, len(rows), step):
                some = rows[begin : begin + step]
                owners = depths._row[halves.other[half[some]]]
                x, y, z = (column.take(owners, axis=0) for column in table)  # (rows, corners)
                seen = self._seen[:, some, None]
                height = seen[0] * x + seen[1] * y + seen[2] * z
                lowest = height.argmin(axis=1)
                line = np.arange(len(some))
                self.support[some] = lowest
                self.depth[some] = self._level[some] - height[line, lowest]
                for axis, column in enumerate((x, y, z)):
                    self._corner[axis, some] = column[line, lowest]

    def least_depth(self) -> tuple[Array, Array]:
        """Least depth (P,) m over all faces, and its normal (3, P) from first to second, in the first's frame."""
        depth = np.minimum.reduceat(self.depth, self.start[::2])
        pair = self._half >> 1
        best = np.flatnonzero(self.depth == depth[pair])[::-1]
        face = self.start[::2].copy()
        face[pair[best]] = best  # the first of equal depths is written last, and stays
        of_second = (self._half[face] & 1).astype(bool)
        normal = np.where(of_second, -self._seen[:, face], self._own[:, face])
        normal[:, np.isnan(depth)] = np.nan
        return depth, normal

    def corner_depth(self, one: Index, two: Index) -> Array:
        """Depth (m) under face ``two`` of the corner that is deepest under face ``one``."""
        return self._level[two] - _dot(self._seen.take(two, axis=1), self._corner.take(one, axis=1))


class _Edges:
    """Edges of pairs: half pair (n,), and (3, 5, n) an end (m), direction, outward vector, normals of the two faces."""

    def __init__(self, half: Index, vectors: Array) -> None:
        self.half, self.vectors = half, vectors

    def __getitem__(self, rows: Mask) -> _Edges:
        return _Edges(self.half[rows], self.vectors[:, :, rows])

    def turned(self, halves: _Halves) -> _Edges:
        """In the frame of the other part."""
        vectors = _turned(halves.turn.take(self.half, axis=2)[:, :, None], self.vectors)
        vectors[:, 0] += halves.move.take(self.half, axis=1)
        return _Edges(self.half, vectors)


def _crossings(a: _Edges, i: Index, b: _Edges, j: Index) -> tuple[Index, Array, Array]:
    """Pair (Q,), depth (Q,) and direction (3, Q) of the edges ``i`` of ``a`` and ``j`` of ``b`` whose arcs cross."""
    kept = _opposite(_dot(b.vectors[:, 3:].take(j, axis=2), a.vectors[:, 1].take(i, axis=1)[:, None]))
    i, j = i[kept], j[kept]
    along = b.vectors[:, 1].take(j, axis=1)
    sines = _dot(a.vectors[:, 3:].take(i, axis=2), along[:, None])
    kept = _opposite(sines)
    i, j, along, sines = i[kept], j[kept], along[:, kept], sines[:, kept]
    # The point of the arc at right angles to the other edge: it is between the middle of the arc and the end at which
    # the sine has the opposite sign.
    point, _, middle, one, two = a.vectors.take(i, axis=2).swapaxes(0, 1)
    sine = _dot(middle, along)
    use_one = (sines[0] > 0) != (sine > 0)
    normal = middle * np.abs(np.where(use_one, *sines)) + np.where(use_one, one, two) * np.abs(sine)
    normal /= np.sqrt(_dot(normal, normal))
    other, _, outward, _, _ = b.vectors.take(j, axis=2).swapaxes(0, 1)
    facing = np.flatnonzero(_dot(normal, outward) < 0)
    depth = _dot(normal, point - other)
    return a.half[i[facing]] >> 1, depth[facing], normal[:, facing]


def _opposite(values: Array) -> Index:
    """Columns of (2, n) with one positive and one negative value, by more than rounding."""
    return np.flatnonzero((np.minimum(*values) < -_ROUNDING) & (np.maximum(*values) > _ROUNDING))


def _dot(one: Array, two: Array) -> Array:
    return one[0] * two[0] + one[1] * two[1] + one[2] * two[2]  # type: ignore[no-any-return]


def _turned(rotation: Array, vectors: Array) -> Array:
    """(3, 3, ..., n) applied to (3, ..., n); written out, so that a column's result never depends on the others."""
    return rotation[:, 0] * vectors[0] + rotation[:, 1] * vectors[1] + rotation[:, 2] * vectors[2]  # type: ignore[no-any-return]


def _expand(count: Index) -> tuple[Index, Index]:
    """Rows for ``count`` (n,) entries per item: the item of each row (m,), and its number within the item (m,)."""
    item = np.repeat(np.arange(len(count)), count)
    return item, np.arange(len(item)) - np.repeat(np.cumsum(count) - count, count)


def _blocks(work: Index, limit: int) -> Iterator[slice]:
    """Consecutive rows whose ``work`` sums to at most ``limit``, or single rows."""
    total = np.cumsum(work)
    start = 0
    while start < len(work):
        done = int(total[start - 1]) if start else 0
        end = max(start + 1, int(np.searchsorted(total, done + limit, side="right")))
        yield slice(start, end)
        start = end


class Depths(Protocol):
    """How deep objects overlap."""

    def __call__(
        self, objects: Objects, first: Index, second: Index, gap: Array, totals: bool
    ) -> tuple[Array, Array, Index]:
        """Depth (P,) m of the fine parts of each pair of objects, whose coarse parts have the signed ``gap`` (P,) m. With
        ``totals``, also the sum of the depths of all pairs of their parts (P,) m, and the number of these (P,).
        """


class ExactDepths:
    """Exact depths of a library's parts: face planes bound them from above, and the deepest are computed."""

    def __init__(self, library: LibraryGeometry) -> None:
        self._library = library
        self.exact = PenetrationDepth([part.vertices for part in library.parts])

    def __call__(
        self, objects: Objects, first: Index, second: Index, gap: Array, totals: bool
    ) -> tuple[Array, Array, Index]:
        """See :class:`Depths`."""
        depth, total, part_count = np.zeros(len(gap)), np.zeros(len(gap)), np.zeros(len(gap), dtype=np.int64)
        # The depth of objects that barely touch is the bound from the face planes of the enclosing coarse parts.
        # Sums over part pairs need the fine parts, unless each of the two objects has only one.
        simple = gap > -TOUCHING
        if totals:
            single = np.array([len(asset.fine.parts) == 1 for asset in self._library.assets])
            simple &= single[objects.category[first]] & single[objects.category[second]]
        depth[simple] = total[simple] = -gap[simple]
        part_count[simple] = 1
        hard = np.flatnonzero(~simple)
        if not len(hard):
            return depth, total, part_count
        used, local = np.unique(np.concatenate([first[hard], second[hard]]), return_inverse=True)
        fine = place(self._library, objects[used], "fine")
        pair, a, b = part_pairs(fine, local[: len(hard)], local[len(hard) :])
        near = _boxes_near(fine.low, fine.high, a, b, 0.0)
        pair, a, b = pair[near], a[near], b[near]
        bound, _ = separations(self._library, fine.parts, a, b)
        bound = -bound
        deep = bound > 0
        pair, a, b, bound = pair[deep], a[deep], b[deep], bound[deep]
        order = np.lexsort((-bound, pair))
        a, b, bound, target = a[order], b[order], bound[order], hard[pair[order]]
        for rows in _rounds(target, bound, depth, totals):
            value = bound[rows]
            ask = np.flatnonzero(value > TOUCHING)
            exact, _ = self.exact(fine.parts, a[rows[ask]], b[rows[ask]])
            value[ask] = np.minimum(value[ask], exact)
            meet = value > 0
            np.maximum.at(depth, target[rows[meet]], value[meet])
            np.add.at(total, target[rows[meet]], value[meet])
            np.add.at(part_count, target[rows[meet]], 1)
        return depth, total, part_count


class Collider:
    """Search for near and overlapping objects; geometry is built once, poses are arguments."""

    def __init__(self, library: LibraryGeometry, depths: Depths) -> None:
        self.library = library
        self._depths = depths

    def pairs(self, objects: Objects, *, totals: bool = False) -> ObjectPairs:
        """Near pairs of objects within each of one or more scenes; two fixed objects are never a pair. With ``totals``
        the depths of all part pairs are summed as well, the literature's per-geometry measure.
        """
        coarse = place(self.library, objects, "coarse")
        low, high = object_boxes(coarse)
        first, second = scene_pairs(objects)
        near = _boxes_near(low, high, first, second, NEAR, objects.fixed[first] | objects.fixed[second])
        first, second = first[near], second[near]
        contacts, pair = self._near_parts(objects, coarse, first, second, *part_pairs(coarse, first, second))
        order = np.lexsort((contacts.gap, pair))
        keep, leading = np.unique(pair[order], return_index=True)
        best = order[leading]  # the contact with the smallest gap of each pair
        first, second, gap, direction = first[keep], second[keep], contacts.gap[best], contacts.direction[best]
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
            found = self._depths(objects, first[exact], second[exact], gap[exact], totals)
            depth[exact], total[exact], part_count[exact] = found
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


def corner_tests(library: LibraryGeometry, objects: Objects, first: Index, second: Index) -> Array:
    """(P,) work to test each pair: corners of one object's parts times face directions of the other's, both ways."""
    corners, directions = library.corners[objects.category], library.directions[objects.category]
    return (corners[first] * directions[second] + directions[first] * corners[second]).astype(np.float64)


def _rounds(target: Index, bound: Array, depth: Array, every: bool) -> Iterator[Index]:
    """Rows of candidates that can still deepen their object pair; twice as many per pair in each round, or all at once.
    Candidates of an object pair ``target`` (Q,) stand together, with descending upper bounds ``bound`` (Q,) m of their
    depths. Between rounds, the caller updates ``depth`` (P,) m, the depths found so far.
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
