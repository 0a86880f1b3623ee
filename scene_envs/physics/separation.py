"""Separating planes between many pairs of convex parts at once, in numpy.

For two convex parts, a face direction that separates them gives a lower bound on their distance; any other face
direction gives an upper bound on the depth of their overlap. For flat contact the bound is exact, so nearly all pairs
of a tidy scene need no further test.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from scene_envs.arrays import Array, Index
from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.parts import SIZE_CLASSES

_CLASSES = len(SIZE_CLASSES) + 1
_BLOCK = 1 << 16
"""Face-corner combinations computed together: their arrays stay in the cache."""


@dataclass(frozen=True, eq=False)
class PlacedParts:
    """Parts of placed objects."""

    part: Index  # (I,) index of the part in the library
    rotation: Array  # (I, 3, 3), asset frame to world
    translation: Array  # (I, 3) m, world


def rotate(rotation: Array, points: Array) -> Array:
    """(..., 3, 3) applied to (..., P, 3); written out, so that a row's result never depends on the others."""
    r, p = rotation[..., None, :, :], points[..., :, None, :]
    return r[..., 0] * p[..., 0] + r[..., 1] * p[..., 1] + r[..., 2] * p[..., 2]  # type: ignore[no-any-return]


def separations(library: LibraryGeometry, placed: PlacedParts, first: Index, second: Index) -> tuple[Array, Array]:
    """Largest signed gap of each pair of ``placed`` parts, rows (P,), over all face directions of both.

    Returns:
        gap (P,) m, positive when a face plane separates the pair, and the direction (P, 3) of that plane in the world,
        from the first part to the second. The true distance is at least ``gap``, the true depth at most ``-gap``.
    """
    gap = np.empty(len(first))
    direction = np.empty((len(first), 3))
    classes = library.size_class[placed.part]
    groups = classes[first] * _CLASSES + classes[second]
    for group in np.unique(groups):
        class_a, class_b = divmod(int(group), _CLASSES)
        rows = np.flatnonzero(groups == group)
        step = max(1, _BLOCK // _combinations(library, class_a, class_b))
        for start in range(0, len(rows), step):
            some = rows[start : start + step]
            gap[some], direction[some] = _one_group(library, placed, first[some], second[some], class_a, class_b)
    return gap, direction


def _combinations(library: LibraryGeometry, class_a: int, class_b: int) -> int:
    """Faces of one part times corners of the other, both ways, for parts of two size classes."""
    a, b = library.tables[class_a], library.tables[class_b]
    return a.normals.shape[1] * b.vertices.shape[1] + b.normals.shape[1] * a.vertices.shape[1]


def _one_group(
    library: LibraryGeometry, placed: PlacedParts, first: Index, second: Index, class_a: int, class_b: int
) -> tuple[Array, Array]:
    table_a, table_b = library.tables[class_a], library.tables[class_b]
    row_a, row_b = library.row[placed.part[first]], library.row[placed.part[second]]
    rotation_a, rotation_b = placed.rotation[first], placed.rotation[second]
    shift = placed.translation[second] - placed.translation[first]  # (P, 3)
    gap_a, normal_a = _face_gaps(
        table_a.normals[row_a], table_a.offsets[row_a], rotation_a, table_b.vertices[row_b], rotation_b, shift
    )
    gap_b, normal_b = _face_gaps(
        table_b.normals[row_b], table_b.offsets[row_b], rotation_b, table_a.vertices[row_a], rotation_a, -shift
    )
    use_a = gap_a >= gap_b
    return np.where(use_a, gap_a, gap_b), np.where(use_a[:, None], normal_a, -normal_b)


def grouped_gaps(
    library: LibraryGeometry, placed: PlacedParts, first: Index, second: Index, shift: Array
) -> Iterator[tuple[Index, Array, Array]]:
    """Signed gaps of pairs of ``placed`` parts, rows (P,), over *all* face directions of both, in groups of equal size.

    ``shift`` (P, 3) m leads from the origin of the first part's object to the origin of the second part's object.

    Yields:
        rows (Q,) of the pairs, gaps (Q, K) m, and directions (Q, K, 3) in the world, from first to second.
    """
    classes = library.size_class[placed.part]
    groups = classes[first] * _CLASSES + classes[second]
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        table_a, table_b = (library.tables[index] for index in divmod(int(group), _CLASSES))
        a, b = first[rows], second[rows]
        row_a, row_b = library.row[placed.part[a]], library.row[placed.part[b]]
        turn_a, turn_b = placed.rotation[a], placed.rotation[b]
        gap_a, normal_a = _all_face_gaps(
            table_a.normals[row_a], table_a.offsets[row_a], turn_a, table_b.vertices[row_b], turn_b, shift[rows]
        )
        gap_b, normal_b = _all_face_gaps(
            table_b.normals[row_b], table_b.offsets[row_b], turn_b, table_a.vertices[row_a], turn_a, -shift[rows]
        )
        yield rows, np.concatenate([gap_a, gap_b], axis=1), np.concatenate([normal_a, -normal_b], axis=1)


def _face_gaps(
    normals: Array, offsets: Array, rotation: Array, vertices: Array, other: Array, shift: Array
) -> tuple[Array, Array]:
    """Best face of the owner: (P,) gap and (P, 3) world normal; ``shift`` leads to the other part."""
    own = rotation.swapaxes(-1, -2)
    seen = rotate(rotate(other.swapaxes(-1, -2), own).swapaxes(-1, -2), normals)  # (P, K, 3) in the other's frame
    away = rotate(other.swapaxes(-1, -2), shift[:, None])[:, 0]
    gaps = _lowest(seen, vertices) + _along(seen, away) - offsets
    best = gaps.argmax(axis=1)
    rows = np.arange(len(best))
    return gaps[rows, best], rotate(rotation, normals[rows, best][:, None])[:, 0]


def _all_face_gaps(
    normals: Array, offsets: Array, rotation: Array, vertices: Array, other: Array, shift: Array
) -> tuple[Array, Array]:
    """Every face of the owner: (P, K) gaps and (P, K, 3) world normals."""
    world = rotate(rotation, normals)
    seen = rotate(other.swapaxes(-1, -2), world)
    return _lowest(seen, vertices) + _along(world, shift) - offsets, world


def _lowest(directions: Array, vertices: Array) -> Array:
    """(P, K) m: least height of vertices (P, V, 3) along directions (P, K, 3) of the same frame."""
    height = directions[:, :, None, 0] * vertices[:, None, :, 0]
    height += directions[:, :, None, 1] * vertices[:, None, :, 1]
    height += directions[:, :, None, 2] * vertices[:, None, :, 2]
    return height.min(axis=2)  # type: ignore[no-any-return]


def _along(directions: Array, vector: Array) -> Array:
    """(P, K) m: components of vectors (P, 3) along directions (P, K, 3)."""
    x, y, z = vector[:, None, 0], vector[:, None, 1], vector[:, None, 2]
    return directions[..., 0] * x + directions[..., 1] * y + directions[..., 2] * z  # type: ignore[no-any-return]
