"""Collision geometry of an asset library, built once per process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from scene_envs.arrays import Array, Index
from scene_envs.assets.base import Asset, ConvexPart
from scene_envs.physics.contact_faces import ContactFace, contact_face
from scene_envs.physics.parts import PartGeometry

_CONTAINED = 1e-6
"""A corner of a fine part up to this far (m) outside a coarse part still counts as inside."""


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
        fine = [asset.fine.parts for asset in self.assets]
        self.corners = np.array([sum(len(part.vertices) for part in parts) for parts in fine], dtype=np.int64)
        self.directions = np.array([sum(len(part.normals) for part in parts) for parts in fine], dtype=np.int64)
        self.size_class = np.array([part.size_class for part in self.parts], dtype=np.int64)
        self.row = np.zeros(len(self.parts), dtype=np.int64)
        self.tables: dict[int, PartTable] = {}
        for index in np.unique(self.size_class).tolist():
            members = np.flatnonzero(self.size_class == index)
            self.row[members] = np.arange(len(members))
            self.tables[index] = _table([self.parts[m] for m in members])

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
    for part in fine.parts:
        if not any(
            (outer.normals @ part.vertices.T <= outer.offsets[:, None] + _CONTAINED).all() for outer in coarse.parts
        ):
            return False
    return True


def _table(parts: Sequence[PartGeometry]) -> PartTable:
    corners = max(len(part.vertices) for part in parts)
    directions = max(len(part.normals) for part in parts)
    vertices = np.empty((len(parts), corners, 3))
    normals = np.empty((len(parts), directions, 3))
    offsets = np.empty((len(parts), directions))
    for index, part in enumerate(parts):
        vertices[index] = part.vertices[0]
        vertices[index, : len(part.vertices)] = part.vertices
        normals[index], offsets[index] = part.normals[0], part.offsets[0]
        normals[index, : len(part.normals)] = part.normals
        offsets[index, : len(part.offsets)] = part.offsets
    return PartTable(vertices, normals, offsets)


def inset_hull(part: PartGeometry, distance: float) -> Array:
    """Corners (V, 3) of the part with every face moved inward by ``distance`` (m).

    Bullet enlarges convex meshes by its margin, so a hull that is smaller by the margin acts at its true size.
    A part too thin for the whole distance is inset by two fifths of its thickness.
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
