"""Visual surfaces that change around their axis: fruit with a red cheek, a can with a wave, a printed box."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from scene_envs.arrays import Array
from scene_envs.assets.shapes import Color, Profile, arc, circle, grid_faces, join, quad_faces, sheet, surface, walls

Cells = NDArray[np.int64]
"""Indices into the colours of a surface, one per cell."""

Paint = Callable[[Array, Array], Cells]
"""Function of the angles (1, S) rad and the heights (P, 1) m of cells, bottom to top along the profile, that gives the
colours of the cells."""


def curve(points: Profile, samples: int = 24) -> Array:
    """(samples, 2): a smooth half section through the points (r, z), m, never beyond the axis."""
    through = arc([(r, 0.0, z) for r, z in points], samples)[:, [0, 2]]
    return np.column_stack([np.maximum(through[:, 0], 0.0), np.maximum(through[:, 1], 0.0)])


def revolve(
    profile: ArrayLike,
    colors: Sequence[Color],
    paint: Paint,
    *,
    segments: int = 32,
    swell: Callable[[Array, Array], Array] | None = None,
) -> trimesh.Trimesh:
    """Revolve a smooth half section (P, 2), points (r, z) m, outside on its right, about z and paint it cell by cell.
    ``paint`` chooses from ``colors`` by angle and height of a cell's middle; ``swell`` is a factor on the radius by
    angle (rad) and height (m), for lobes and spouts.
    """
    section = np.asarray(profile, dtype=np.float64)
    angles = 2.0 * np.pi * np.arange(segments) / segments
    radius = np.repeat(section[:, :1], segments, axis=1)
    if swell is not None:
        radius = radius * swell(angles[None, :], section[:, 1:])
    unit = circle(segments)
    points = np.stack(
        [radius * unit[:, 0], radius * unit[:, 1], np.repeat(section[:, 1:], segments, axis=1)], axis=-1
    )  # (P, segments, 3)
    middle = 0.5 * (section[1:, 1:] + section[:-1, 1:])
    chosen = np.broadcast_to(paint(angles[None, :] + np.pi / segments, middle), (len(middle), segments))
    return _painted(points, _normals(points, section), chosen, colors)


def sleeve(radius: float, levels: ArrayLike, colors: Sequence[Color]) -> trimesh.Trimesh:
    """The wall of a cylinder of ``radius`` m in K - 1 coloured bands whose edges may wave. ``levels`` (K, segments) are
    the heights (m) of the edges of the bands, bottom first, one per angle.
    """
    heights = np.asarray(levels, dtype=np.float64)
    unit = circle(heights.shape[1])
    x, y = (np.broadcast_to(radius * unit[:, axis], heights.shape) for axis in (0, 1))
    points = np.stack([x, y, heights], axis=-1)
    normals = np.broadcast_to(np.column_stack([unit, np.zeros(len(unit))]), points.shape)
    bands = np.repeat(np.arange(len(heights) - 1)[:, None], heights.shape[1], axis=1)
    return _painted(points, normals, bands, colors)


def loft(loops: ArrayLike, colors: Sequence[Color]) -> trimesh.Trimesh:
    """A closed body between convex outlines (K, P, 3) m, counter-clockwise seen from above, bottom first; the first and
    the last are flat and filled in. Colours: the underside, K - 1 walls, the top.
    """
    outlines = np.asarray(loops, dtype=np.float64)
    skins = []
    for low, high, color in zip(outlines[:-1], outlines[1:], colors[1:-1], strict=True):
        quads = walls(low, high)
        facing = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
        facing /= np.linalg.norm(facing, axis=1, keepdims=True)
        corner = facing + np.roll(facing, 1, axis=0)
        corner /= np.linalg.norm(corner, axis=1, keepdims=True)
        normals = np.stack([corner, np.roll(corner, -1, axis=0), np.roll(corner, -1, axis=0), corner], axis=1)
        skins.append(surface(quads.reshape(-1, 3), quad_faces(len(quads)), color, normals.reshape(-1, 3)))
    return join(sheet(outlines[0, ::-1], colors[0]), *skins, sheet(outlines[-1], colors[-1]))


def _normals(points: Array, section: Array) -> Array:
    """(P, S, 3) unit normals of a revolved grid; on the axis, the normal is parallel to the axis."""
    along = np.gradient(points, axis=0)
    around = np.roll(points, -1, axis=1) - np.roll(points, 1, axis=1)
    normals = np.cross(around, along)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    steps = np.gradient(section, axis=0)
    tangent = np.stack([-steps[:, 1], steps[:, 0]], axis=-1)
    up = np.zeros_like(points)
    up[..., 2] = np.where(tangent[:, 1] >= 0, -1.0, 1.0)[:, None]
    return np.where(length > 1e-12, normals / np.maximum(length, 1e-12), up)


def _painted(points: Array, normals: Array, chosen: Cells, colors: Sequence[Color]) -> trimesh.Trimesh:
    """A grid of points (P, S, 3), closed around, with one colour per cell (P - 1, S)."""
    triangles, of = grid_faces(*points.shape[:2]), np.tile(chosen.ravel(), 2)
    flat, shading = points.reshape(-1, 3), normals.reshape(-1, 3)
    meshes = []
    for index in np.unique(chosen):
        faces = triangles[of == index]
        corners = flat[faces]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        used, faces = np.unique(faces[area > 1e-12], return_inverse=True)
        meshes.append(surface(flat[used], faces.reshape(-1, 3), colors[int(index)], shading[used]))
    return join(*meshes)
