"""Collision geometry of assets: convex parts, flat contact faces, and the tables of a library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from scene_envs.arrays import Array, Index
from scene_envs.assets.base import Asset, ConvexPart

SIZE_CLASSES = ((8, 6), (16, 16), (32, 24))
"""(corners, face directions) up to which parts share padded arrays; larger parts make a last class."""
GRAVITY = 9.81
"""m/s^2."""
FRICTION = 0.6
"""Coulomb friction coefficient between any two objects."""
_FACE_TOLERANCE = 1e-5
"""Corners this close (m) to the extreme height belong to the face."""
_SAME_AREA = 1e-3
"""Relative difference of areas below which a face has no hole."""
_CONTAINED = 1e-6
"""A corner of a fine part up to this far (m) outside a coarse part still counts as inside."""
Records = TypeVar("Records", bound="Rows")


@dataclass(frozen=True, eq=False)
class PartGeometry:
    """A convex part with its face planes, asset frame."""

    vertices: Array  # (V, 3) m
    normals: Array  # (K, 3) distinct outward face normals
    offsets: Array  # (K,) m; the part is where ``normals @ x <= offsets``

    @classmethod
    def of(cls, part: ConvexPart) -> PartGeometry:
        """Face planes of ``part``; triangles of one flat face give one plane, a part without area those of its box."""
        corners = part.vertices[part.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        normals = normals[lengths > 1e-14] / lengths[lengths > 1e-14, None]
        kept: list[int] = []
        for index, normal in enumerate(normals):
            if not kept or (normals[kept] @ normal).max() < 1.0 - 1e-9:
                kept.append(index)
        normals = normals[kept] if kept else np.concatenate([np.eye(3), -np.eye(3)])
        return cls(part.vertices, normals, (normals @ part.vertices.T).max(axis=1))

    @property
    def size_class(self) -> int:
        """Index of the first of :data:`SIZE_CLASSES` that the part fits into, or their number."""
        sizes = len(self.vertices), len(self.normals)
        fits = (index for index, (v, k) in enumerate(SIZE_CLASSES) if sizes[0] <= v and sizes[1] <= k)
        return next(fits, len(SIZE_CLASSES))


@dataclass(frozen=True)
class ContactFace:
    """Position of a horizontal face of an asset, and extent of its solid area."""

    height: float  # height z in the asset frame, m
    center: tuple[float, float]  # centre (x, y) in the asset frame, m
    inner: float  # radius (m) of the largest circle inside the outline
    corners: float  # smallest distance (m) of an outline corner from the centre
    hole: float  # radius (m) outside of which the face is solid up to its outline; 0 without a hole


def contact_face(fine: Sequence[PartGeometry], coarse: Sequence[PartGeometry], side: int) -> ContactFace | None:
    """The face at the lowest (``side`` -1) or highest (+1) z. It is None where there is none, where the two levels of
    detail have different outlines, or where the outline is not solid all round (four legs), because fine and coarse
    parts then support objects differently.
    """
    height = side * max(float((side * part.vertices[:, 2]).max()) for part in fine)
    polygons = [polygon for part in fine if (polygon := _flat_corners(part, height)) is not None]
    outline = outline_of(np.concatenate(polygons)) if polygons else None
    coarse_polygons = [polygon for part in coarse if (polygon := _flat_corners(part, height)) is not None]
    coarse_outline = outline_of(np.concatenate(coarse_polygons)) if coarse_polygons else None
    if outline is None or coarse_outline is None or abs(area(outline) - area(coarse_outline)) > 1e-7:
        return None
    center = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
    radii = np.linalg.norm(outline - center, axis=1)
    inner = float(-_outside(center[None], outline)[0])
    hole = 0.0
    if abs(sum(area(polygon) for polygon in polygons) / area(outline) - 1.0) > _SAME_AREA:
        middles = 0.5 * (outline + np.roll(outline, -1, axis=0))
        gaps = np.stack([_outside(middles, polygon) for polygon in polygons]).min(axis=0)
        if gaps.max() > 1e-4:
            return None
        points = np.concatenate(polygons)
        inside = points[_outside(points, outline) < -1e-4]
        if not len(inside):
            return None
        hole = float(np.linalg.norm(inside - center, axis=1).max())
    return ContactFace(height, (float(center[0]), float(center[1])), inner, float(radii.min()), hole)


def _flat_corners(part: PartGeometry, height: float) -> Array | None:
    """Counter-clockwise outline (K, 2) of the part's face at ``height``, or None."""
    points = part.vertices[np.abs(part.vertices[:, 2] - height) < _FACE_TOLERANCE][:, :2]
    return outline_of(points)


def outline_of(points: Array) -> Array | None:
    """Counter-clockwise convex outline (K, 2) of points (P, 2); None where they lie on a line."""
    if len(points) < 3:
        return None
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return None


def area(polygon: Array) -> float:
    """Area of a counter-clockwise polygon (K, 2)."""
    x, y = polygon[:, 0], polygon[:, 1]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _outside(points: Array, polygon: Array) -> Array:
    """(P,) m, distance of each point outside the convex polygon; negative inside."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return ((points[:, None] - polygon[None]) * normal[None]).sum(axis=2).max(axis=1)


@dataclass(frozen=True, eq=False)
class LevelGeometry:
    """All parts of one asset at one level of detail."""

    parts: tuple[PartGeometry, ...]  # convex parts
    ids: Index  # (P,) index of each part in the library
    vertices: Array  # (sum V, 3) corners of all parts, m
    starts: Index  # (P,) first row of each part in ``vertices``


@dataclass(frozen=True, eq=False)
class AssetGeometry:
    """One asset: its two levels of detail, and the flat faces it can stand on or carry others with."""

    asset: Asset  # asset with this geometry
    fine: LevelGeometry  # parts that are hollow where the asset is hollow
    coarse: LevelGeometry  # fewer parts that enclose ``fine``; the same object as ``fine`` where there are none
    bottom: ContactFace | None  # flat face at the lowest z of the asset frame, or None
    top: ContactFace | None  # flat face at the highest z, or None

    @property
    def is_hollow(self) -> bool:
        """Whether the two levels differ."""
        return self.coarse is not self.fine


@dataclass(frozen=True, eq=False)
class PartTable:
    """Parts of one size class, padded with copies of their first corner and direction."""

    vertices: Array  # (P, V, 3) m
    normals: Array  # (P, K, 3)
    offsets: Array  # (P, K) m


class LibraryGeometry:
    """Collision geometry of several assets; category ``c`` is ``assets[c]``."""

    def __init__(self, assets: Sequence[Asset]) -> None:
        self.parts: list[PartGeometry] = []
        self.assets = tuple(self._add(asset) for asset in assets)
        self.static = np.array([asset.static or asset.mass <= 0 for asset in assets])
        self.center_of_mass = np.stack([np.asarray(asset.center_of_mass, dtype=np.float64) for asset in assets])
        self.mass = np.array([asset.mass for asset in assets], dtype=np.float64)
        principal = [principal_inertia(asset.inertia) for asset in assets]
        self.moments = np.stack([moments for moments, _ in principal])  # (C, 3) kg m^2
        self.axes = np.stack([axes for _, axes in principal])  # (C, 3, 3) principal axes of each asset, columns
        fine = [asset.fine.parts for asset in self.assets]
        self.corners = np.array([sum(len(part.vertices) for part in parts) for parts in fine], dtype=np.int64)
        self.directions = np.array([sum(len(part.normals) for part in parts) for parts in fine], dtype=np.int64)
        self.size_class = np.array([part.size_class for part in self.parts], dtype=np.int64)
        self.row = np.zeros(len(self.parts), dtype=np.int64)
        self.tables: dict[int, PartTable] = {}
        for index in np.unique(self.size_class).tolist():
            members = np.flatnonzero(self.size_class == index)
            self.row[members] = np.arange(len(members))
            parts = [self.parts[m] for m in members]
            columns = ([getattr(part, field.name) for part in parts] for field in fields(PartTable))
            self.tables[index] = PartTable(*map(padded, columns))

    def _add(self, asset: Asset) -> AssetGeometry:
        fine = self._level(asset.fine)
        coarse = self._level(asset.coarse) if len(asset.coarse) < len(asset.fine) else fine
        if coarse is not fine and not _encloses(coarse, fine):
            coarse = fine
        faces = [contact_face(fine.parts, coarse.parts, side) for side in (-1, 1)]
        return AssetGeometry(asset, fine, coarse, faces[0], faces[1])

    def _level(self, parts: Sequence[ConvexPart]) -> LevelGeometry:
        geometry = tuple(PartGeometry.of(part) for part in parts)
        ids = np.arange(len(self.parts), len(self.parts) + len(geometry))
        self.parts.extend(geometry)
        counts = np.array([len(part.vertices) for part in geometry])
        starts = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        return LevelGeometry(geometry, ids, np.concatenate([part.vertices for part in geometry]), starts)


def _encloses(coarse: LevelGeometry, fine: LevelGeometry) -> bool:
    """Whether every fine part lies inside one coarse part."""
    return all(
        any((outer.normals @ part.vertices.T <= outer.offsets[:, None] + _CONTAINED).all() for outer in coarse.parts)
        for part in fine.parts
    )


def padded(rows: Sequence[Array]) -> Array:
    """Arrays (k, ...) of different lengths as one, padded with copies of the first entry of each."""
    longest = max(map(len, rows))
    return np.stack([np.concatenate([row, np.repeat(row[:1], longest - len(row), axis=0)]) for row in rows])


def inset_hull(part: PartGeometry, distance: float) -> Array:
    """Corners (V, 3) of the part with every face moved inward by ``distance`` (m), by two fifths of the thickness if it
    is too thin. Bullet enlarges convex meshes by its margin, so that a hull smaller by it acts at its true size.
    """
    from scipy.optimize import linprog

    count = len(part.normals)
    deepest = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([part.normals, np.ones(count)]),
        b_ub=part.offsets,
        bounds=[(None, None)] * 3 + [(0.0, None)],
    )
    center, radius = deepest.x[:3], deepest.x[3]
    distance = min(distance, 0.8 * radius)
    planes = np.column_stack([part.normals, distance - part.offsets])
    try:
        corners = HalfspaceIntersection(planes, center).intersections
        return corners[ConvexHull(corners).vertices]
    except QhullError:
        return center + (part.vertices - center) * (1.0 - distance / radius)


@cache
def library_geometry(assets: tuple[Asset, ...]) -> LibraryGeometry:
    """The geometry of ``assets``, built on first use and shared by everything in this process."""
    return LibraryGeometry(assets)


def apply(rotation: Array, vector: Array) -> Array:
    """Rotations (..., 3, 3) of vectors (..., 3); written out, so that a row never depends on the others."""
    r, v = rotation, vector[..., None, :]
    return r[..., 0] * v[..., 0] + r[..., 1] * v[..., 1] + r[..., 2] * v[..., 2]  # type: ignore[no-any-return]


def times(a: Array, b: Array) -> Array:
    """Products (n, 3, 3) of matrices, row by row as in :func:`apply`."""
    return a[..., :, 0:1] * b[..., 0:1, :] + a[..., :, 1:2] * b[..., 1:2, :] + a[..., :, 2:3] * b[..., 2:3, :]


def quaternions(matrices: Array) -> Array:
    """(n, 4) in PyBullet's order (x, y, z, w), from whichever of four equal forms is the most accurate."""
    m = matrices.reshape(-1, 9).T
    a, b, c = m[0], m[4], m[8]
    x, y, z = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    xy, xz, yz = m[1] + m[3], m[2] + m[6], m[5] + m[7]
    forms = np.array(
        [[1 + a - b - c, xy, xz, x], [xy, 1 - a + b - c, yz, y], [xz, yz, 1 - a - b + c, z], [x, y, z, 1 + a + b + c]]
    )  # (form, component, n)
    best = np.array([a, b, c, a + b + c]).argmax(axis=0)
    quaternion = forms[best, :, np.arange(len(best))]
    return quaternion / np.sqrt((quaternion * quaternion).sum(axis=1, keepdims=True))  # type: ignore[no-any-return]


def matrices(xyzw: Array) -> Array:
    """(n, 3, 3) rotation matrices of quaternions (n, 4) in the order (x, y, z, w)."""
    x, y, z, w = (xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def angle_between(a: Array, b: Array) -> Array:
    """Angle (n,) between unit quaternions (x, y, z, w), accurate when tiny."""
    scalar = np.abs((a * b).sum(axis=1))
    (x, y, z), (u, v, w) = a[:, :3].T, b[:, :3].T
    cross = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
    vector = a[:, 3:] * b[:, :3] - b[:, 3:] * a[:, :3] - cross
    return 2.0 * np.arctan2(np.linalg.norm(vector, axis=1), scalar)


def principal_inertia(inertia: Array) -> tuple[Array, Array]:
    """Principal moments (..., 3) kg m^2, ascending, and the rotation (..., 3, 3) from their axes to the asset's."""
    moments, axes = np.linalg.eigh(np.asarray(inertia, dtype=np.float64))
    axes[..., 0] *= np.copysign(1.0, np.linalg.det(axes))[..., None]
    return moments, axes


class Rows:
    """A dataclass of arrays (n, ...) that are indexed and concatenated together."""

    def __getitem__(self: Records, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Records:
        """The records of ``rows``: integers, or a mask (n,)."""
        return type(self)(*(values[rows] for values in self._columns()))

    def __add__(self: Records, other: Records) -> Records:
        return type(self)(*(np.concatenate(pair) for pair in zip(self._columns(), other._columns(), strict=True)))

    def _columns(self) -> list[Any]:
        return [getattr(self, name) for name in self.__dataclass_fields__]  # type: ignore[attr-defined]
