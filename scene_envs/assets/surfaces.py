"""Coloured visual meshes from a few numbers: lathes, tubes, planks.

A surface carries vertex colours and vertex normals; faces of different colour never share a vertex.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from scene_envs.arrays import Array
from scene_envs.assets.shapes import Profile, circle

Color = tuple[int, int, int]
"""(r, g, b) in 0..255."""

_SMOOTH = np.cos(np.radians(40.0))
"""Spans of a profile that meet at less than 40 degrees are shaded as one curved surface."""


def surface(vertices: ArrayLike, faces: ArrayLike, color: Color, normals: ArrayLike | None = None) -> trimesh.Trimesh:
    """One mesh of one colour; normals (V, 3) default to those of the faces around a vertex."""
    vertices = np.asarray(vertices, dtype=np.float64)
    colors = np.tile(np.array([*color, 255], dtype=np.uint8), (len(vertices), 1))
    mesh = trimesh.Trimesh(vertices, np.asarray(faces), vertex_normals=normals, vertex_colors=colors, process=False)
    mesh.vertex_normals  # noqa: B018  (computed here, so that joining keeps them)
    return mesh


def join(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """One mesh of several; colours and normals are kept."""
    starts = [0, *np.cumsum([len(mesh.vertices) for mesh in meshes[:-1]]).tolist()]
    return trimesh.Trimesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        vertex_normals=np.concatenate([mesh.vertex_normals for mesh in meshes]),
        vertex_colors=np.concatenate([mesh.visual.vertex_colors for mesh in meshes]),  # type: ignore[union-attr]
        process=False,
    )


def quad_faces(count: int) -> NDArray[np.int64]:
    """(2 count, 3): two triangles for each of ``count`` quadrilaterals with corners 4 k .. 4 k + 3."""
    first = 4 * np.arange(count)[:, None]
    return np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])


def fan(count: int) -> NDArray[np.int64]:
    """(count - 2, 3): triangles of a convex outline of ``count`` corners."""
    return np.stack([np.zeros(count - 2, dtype=np.int64), np.arange(1, count - 1), np.arange(2, count)], axis=1)


def grid_faces(rows: int, around: int) -> NDArray[np.int64]:
    """(2 (rows - 1) around, 3): triangles between neighbouring rows of points, each row closed around."""
    grid = np.arange(rows * around).reshape(rows, around)
    a, b = grid[:-1], np.roll(grid[:-1], -1, axis=1)
    d, c = grid[1:], np.roll(grid[1:], -1, axis=1)
    return np.concatenate([np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)])


def lathe(
    profile: Profile, colors: Color | Sequence[Color], *, segments: int = 48, phase: float = 0.0, flat: bool = False
) -> trimesh.Trimesh:
    """Revolve an open or closed polyline of P points about z.

    Args:
        profile: Points (r, z), m, with the outside on the right: upward on the outside of a vessel, downward on its
            inside.
        colors: One colour, or one per span (P - 1).
        segments: Number of facets around the axis.
        phase: Angle of the first corner, rad.
        flat: Whether facets stay visible (square dishes).
    """
    points = np.asarray(profile, dtype=np.float64)
    steps = np.diff(points, axis=0)
    steps /= np.linalg.norm(steps, axis=1, keepdims=True)
    spans = np.stack([steps[:, 1], -steps[:, 0]], axis=1)  # outward 2-D normals
    palette = [colors] * len(spans) if isinstance(colors[0], int) else list(colors)
    meshes = []
    for index, normal in enumerate(spans):
        ends = []
        for neighbour in (index - 1, index + 1):
            smooth = 0 <= neighbour < len(spans) and float(normal @ spans[neighbour]) > _SMOOTH
            ends.append(normal + spans[neighbour] if smooth else normal)
        meshes.append(_span(points[index], points[index + 1], ends, palette[index], segments, phase, flat))  # type: ignore[arg-type]
    return join(*meshes)


def _span(
    low: Array, high: Array, normals: Sequence[Array], color: Color, segments: int, phase: float, flat: bool
) -> trimesh.Trimesh:
    unit = circle(segments, phase)
    corners = [np.column_stack([r * unit, np.full(segments, z)]) for r, z in (low, high)]
    here, there = np.arange(segments), (np.arange(segments) + 1) % segments
    degenerate = np.array([low[0] == 0.0, high[0] == 0.0])
    keep = np.repeat(~degenerate, segments)  # a span that starts or ends on the axis has half as many triangles
    if flat:
        quads = np.stack([corners[0], corners[0][there], corners[1][there], corners[1]], axis=1)
        facing = np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])
        facing /= np.linalg.norm(facing, axis=1, keepdims=True)
        return surface(quads.reshape(-1, 3), quad_faces(segments)[keep], color, facing.repeat(4, axis=0))
    faces = np.concatenate(
        [np.stack([here, there, segments + there], axis=1), np.stack([here, segments + there, segments + here], axis=1)]
    )
    radial = [np.column_stack([n[0] * unit, np.full(segments, n[1])]) / np.linalg.norm(n) for n in normals]
    return surface(np.concatenate(corners), faces[keep], color, np.concatenate(radial))


def tube(path: ArrayLike, radii: ArrayLike, color: Color, *, sides: int = 10) -> trimesh.Trimesh:
    """A round tube along a path (P, 3) in the x-z plane, with flat end caps; ``radii`` is one, or one per point."""
    points = np.asarray(path, dtype=np.float64)
    size = np.broadcast_to(np.asarray(radii, dtype=np.float64), (len(points),))
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.stack([tangents[:, 2], np.zeros(len(points)), -tangents[:, 0]], axis=1)
    unit = circle(sides)
    spokes = across[:, None] * unit[None, :, :1] + np.array([0.0, 1.0, 0.0]) * unit[None, :, 1:]  # (P, sides, 3)
    vertices = points[:, None] + size[:, None, None] * spokes
    body = surface(vertices.reshape(-1, 3), grid_faces(len(points), sides), color, spokes.reshape(-1, 3))
    caps = [surface(vertices[0], fan(sides)[:, ::-1], color), surface(vertices[-1], fan(sides), color)]
    return join(body, *caps)


def planks(
    radius: float, z: float, colors: Sequence[Color], *, count: int, rows: int, columns: int = 6
) -> trimesh.Trimesh:
    """A round board seen from above: ``count`` strips along y in turning colours.

    Each strip is cut into ``rows`` x ``columns`` compact cells, because software renderers walk the
    bounding box of each triangle.
    """
    edges = np.linspace(-radius, radius, count + 1)
    along = np.linspace(-1.0, 1.0, rows + 1)
    strips = []
    for index, (left, right) in enumerate(pairwise(edges)):
        x = np.linspace(left, right, columns + 1)
        reach = np.sqrt(np.maximum(radius**2 - x**2, 0.0))
        vertices = np.stack(
            [np.repeat(x, rows + 1), np.outer(reach, along).ravel(), np.full(len(x) * (rows + 1), z)], axis=1
        )
        corner = (np.arange(len(x) - 1)[:, None] * (rows + 1) + np.arange(rows)).ravel()
        across = corner + rows + 1
        faces = np.concatenate(
            [np.stack([corner, across, across + 1], axis=1), np.stack([corner, across + 1, corner + 1], axis=1)]
        )
        up = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
        strips.append(surface(vertices, faces, colors[index % len(colors)], up))
    return join(*strips)


def arc(points: Sequence[tuple[float, float, float]], samples: int = 16) -> Array:
    """(samples, 3): a smooth curve through the points, for the visual of handles and spouts."""
    from scipy.interpolate import make_interp_spline

    knots = np.asarray(points, dtype=np.float64)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    spline = make_interp_spline(length, knots, k=min(3, len(knots) - 1))
    return np.asarray(spline(np.linspace(0.0, length[-1], samples)))
