"""Surfaces of visual meshes that more than a profile describes: fruit with a red cheek, a can with a wave, a printed
carton, cutlery.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart
from scene_envs.assets.shapes import (
    Color,
    Profile,
    arc,
    circle,
    convex_hull,
    facing,
    fan,
    grid_faces,
    join,
    loft,
    moved,
    quad_faces,
    sheet,
    surface,
    walls,
)

Station = tuple[float, float, float, float]
"""(x, width, lowest z, highest z) of a section across the length, m."""


def _lobes(angle: Array, z: Array, depth: float, height: float) -> Array:
    return 1.0 - depth * (1.0 - np.cos(5.0 * angle)) * np.abs(z / height - 0.5)


def _pebbles(angle: Array, z: Array, depth: float) -> Array:
    return 1.0 - depth * (0.5 + 0.5 * np.cos(11.0 * angle + 400.0 * z) * np.cos(7.0 * angle - 900.0 * z))


def _lip(angle: Array, z: Array, start: float, top: float) -> Array:
    share = np.clip((z - start) / (top - start), 0.0, 1.0) ** 2
    return 1.0 + 0.075 * share * np.exp(-(((angle - np.pi) / 0.32) ** 2))


_SWELLS: dict[str, Callable[..., Array]] = {"lobes": _lobes, "pebbles": _pebbles, "lip": _lip}
"""Factors on the radius by angles (1, S) rad and heights (P, 1) m: five lobes, fine bumps, a spout toward -x."""


def revolve(
    profile: Profile,
    colors: Sequence[Color],
    cells: Sequence[str],
    *,
    samples: int = 0,
    segments: int = 32,
    swell: tuple[Any, ...] = (),
) -> trimesh.Trimesh:
    """Revolve a smooth half section, points (r, z) m, outside on its right, about z and paint it cell by cell.
    ``samples`` puts that many points on a smooth curve through the profile, never beyond the axis. ``cells`` are rows
    of digits along the profile, one digit per segment around, that choose from ``colors``; one row serves all, and so
    does one digit. ``swell`` names a factor on the radius, with its numbers: ``("lobes", depth, height m)``,
    ``("pebbles", depth)`` or ``("lip", start m, top m)``.
    """
    section = np.asarray(profile, dtype=np.float64)
    if samples:
        section = np.maximum(arc([(r, 0.0, z) for r, z in profile], samples)[:, [0, 2]], 0.0)
    angles = 2.0 * np.pi * np.arange(segments) / segments
    radius = np.repeat(section[:, :1], segments, axis=1)
    if swell:
        radius = radius * _SWELLS[swell[0]](angles[None, :], section[:, 1:], *swell[1:])
    unit = circle(segments)
    points = np.stack(
        [radius * unit[:, 0], radius * unit[:, 1], np.repeat(section[:, 1:], segments, axis=1)], axis=-1
    )  # (P, segments, 3)
    chosen = np.broadcast_to([[int(digit) for digit in row] for row in cells], (len(section) - 1, segments))
    return _painted(points, _normals(points, section), chosen, colors)


def sleeve(levels: Sequence[Sequence[float]], radius: float, colors: Sequence[Color]) -> trimesh.Trimesh:
    """The wall of a cylinder of ``radius`` m in K - 1 coloured bands whose edges may wave. ``levels`` are the heights
    (m) of the K edges of the bands, bottom first, one per angle or one for all.
    """
    heights = np.stack(np.broadcast_arrays(*levels)).astype(np.float64)
    unit = circle(heights.shape[1])
    x, y = (np.broadcast_to(radius * unit[:, axis], heights.shape) for axis in (0, 1))
    points = np.stack([x, y, heights], axis=-1)
    normals = np.broadcast_to(np.column_stack([unit, np.zeros(len(unit))]), points.shape)
    bands = np.repeat(np.arange(len(heights) - 1)[:, None], heights.shape[1], axis=1)
    return _painted(points, normals, bands, colors)


def slabs(rectangles: Sequence[tuple[float, float, float, float]], colors: Sequence[Color]) -> trimesh.Trimesh:
    """A closed body between K flat rectangles with round corners, bottom first: width, depth, radius of the corners and
    height, m. Colours: the underside, K - 1 walls, the top.
    """
    angles = np.linspace(0.0, 0.5 * np.pi, 8)
    outlines = []
    for width, depth, radius, z in rectangles:
        corners = []
        for quarter, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
            turned = angles + quarter * 0.5 * np.pi
            center = np.array([x * (width / 2.0 - radius), y * (depth / 2.0 - radius)])
            corners.append(center + radius * np.column_stack([np.cos(turned), np.sin(turned)]))
        outline = np.concatenate(corners)
        outlines.append(np.column_stack([outline, np.full(len(outline), z)]))
    skins = []
    for (low, high), color in zip(pairwise(outlines), colors[1:-1], strict=True):
        quads = walls(low, high)
        normals = facing(quads)
        corner = normals + np.roll(normals, 1, axis=0)
        corner /= np.linalg.norm(corner, axis=1, keepdims=True)
        normals = np.stack([corner, np.roll(corner, -1, axis=0), np.roll(corner, -1, axis=0), corner], axis=1)
        skins.append(surface(quads.reshape(-1, 3), quad_faces(len(quads)), color, normals.reshape(-1, 3)))
    return join(sheet(outlines[0][::-1], colors[0]), *skins, sheet(outlines[-1], colors[-1]))


def printed(marks: Sequence[tuple[float, Color, Any]]) -> list[trimesh.Trimesh]:
    """Flat marks on the faces of a carton toward -y and +y: distance from the x-z plane (m), colour and outline, which
    is a rectangle (left, low, right, high), an ellipse (x, z, half width, corners, height over width) or points (x, z).
    """
    meshes = []
    for turn in (1.0, -1.0):
        for distance, color, shape in marks:
            outline = np.asarray(shape, dtype=np.float64)
            if len(shape) == 4:
                left, low, right, high = shape
                outline = np.array([[left, low], [right, low], [right, high], [left, high]])
            elif len(shape) == 5:
                x, z, radius, corners, squash = shape
                outline = np.array([x, z]) + radius * circle(corners) * [1.0, squash]
            front = np.full(len(outline), -turn * distance)
            meshes.append(sheet(np.column_stack([turn * outline[:, 0], front, outline[:, 1]]), color))
    return meshes


def beam(stations: Sequence[Station], y: float = 0.0) -> list[ConvexPart]:
    """One part between each two neighbouring stations, ``y`` (m) in its middle; they share their end faces."""
    sections = [
        np.array([[x, y + side * width, z] for side in (-0.5, 0.5) for z in (low, high)])
        for x, width, low, high in stations
    ]
    return [convex_hull(np.concatenate(ends)) for ends in pairwise(sections)]


def bar(stations: Sequence[Station], color: Color, y: float = 0.0, samples: int = 14) -> trimesh.Trimesh:
    """A rounded bar through the stations, ``y`` (m) in its middle."""
    from scipy.interpolate import PchipInterpolator

    table = np.array(stations)
    x = np.unique([*np.linspace(table[0, 0], table[-1, 0], samples), *table[:, 0]])
    width, low, high = PchipInterpolator(table[:, 0], table[:, 1:])(x).T
    angles = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False) + np.pi / 12
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ring = np.sign(ring) * np.abs(ring) ** 0.6  # between an ellipse and a rectangle
    ring /= np.abs(ring).max(axis=0)
    sides = y + 0.5 * width[:, None] * ring[:, 0]
    heights = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * ring[:, 1]
    return loft(np.stack([np.broadcast_to(x[:, None], sides.shape), sides, heights], axis=-1), color)


def scoop(
    steps: Sequence[tuple[float, float]],
    center: float,
    size: tuple[float, float],
    rim: tuple[float, float, float, float],
    color: Color,
    caps: tuple[bool, bool],
) -> trimesh.Trimesh:
    """The bowl of a spoon, through ellipses around x = ``center`` of these shares of the half axes ``size``, each lower
    by a share than the sloping rim, whose z at x is ``height - fall * (x - start) / reach`` (``rim``, m).
    """
    height, fall, start, reach = rim
    loops = []
    for scale, drop in steps:
        flat = np.array([center, 0.0]) + scale * circle(24) * np.array(size)
        loops.append(np.column_stack([flat, (height - fall * (flat[:, 0] - start) / reach) * (1.0 - drop)]))
    return loft(loops, color, caps=caps)


def prism(outlines: ArrayLike, heights: tuple[float, float], color: Color) -> trimesh.Trimesh:
    """A sharp-edged skin between two outlines (2, K, 2) m at two heights (m), counter-clockwise from above."""
    low, high = (np.column_stack([o, np.full(len(o), z)]) for o, z in zip(np.asarray(outlines), heights, strict=True))
    sides = surface(walls(low, high).reshape(-1, 3), quad_faces(len(low)), color)
    return join(sides, sheet(high, color), surface(low, fan(len(low))[:, ::-1], color))


def barrel(
    section: Profile, axis: float, skins: Sequence[tuple[Sequence[tuple[float, float]], Color, float]]
) -> list[trimesh.Trimesh]:
    """Skins along x through scaled copies (x, scale) of a section (y, z) m around z = ``axis`` (m), each in one colour;
    1 as they are, -1 turned toward the other end.
    """
    return [
        moved(
            loft([[(x, scale * y, axis + scale * z) for y, z in section] for x, scale in stations], color),
            np.diag([side, side, 1.0]),
        )
        for stations, color, side in skins
    ]


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


def _painted(points: Array, normals: Array, chosen: NDArray[np.int64], colors: Sequence[Color]) -> trimesh.Trimesh:
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
