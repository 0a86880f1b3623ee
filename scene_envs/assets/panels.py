"""Coloured surfaces: boxes with patterns on their faces, lofts through sections, and moved meshes.

A pattern is a list of patches; the face is cut along their edges, so that no triangles overlap.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from scene_envs.arrays import Array
from scene_envs.assets.surfaces import Color, fan, grid_faces, join, quad_faces, surface

Face = Literal["-x", "+x", "-y", "+y", "bottom", "top"]
FACES: tuple[Face, ...] = ("-x", "+x", "-y", "+y", "bottom", "top")


class Patch(NamedTuple):
    """A coloured rectangle on a face, in fractions of its width and height as seen from outside."""

    left: float
    low: float
    right: float
    high: float
    color: Color


def painted_face(
    corner: ArrayLike, along: ArrayLike, up: ArrayLike, color: Color, patches: Sequence[Patch] = ()
) -> trimesh.Trimesh:
    """A rectangle with patches on it; later patches cover earlier ones.

    Args:
        corner: (3,) lower left corner, m.
        along: (3,) vector from there to the lower right corner, m.
        up: (3,) vector from there to the upper left corner, m; ``along x up`` points outward.
        color: Colour of the background.
        patches: Patches painted on the rectangle.
    """
    start, right, rise = (np.asarray(v, dtype=np.float64) for v in (corner, along, up))
    across = np.unique(np.clip([0.0, 1.0, *(e for p in patches for e in (p.left, p.right))], 0.0, 1.0))
    upward = np.unique(np.clip([0.0, 1.0, *(e for p in patches for e in (p.low, p.high))], 0.0, 1.0))
    u, v = 0.5 * (across[1:] + across[:-1]), 0.5 * (upward[1:] + upward[:-1])
    palette = [color, *(patch.color for patch in patches)]
    owner = np.zeros((len(u), len(v)), dtype=int)
    for index, patch in enumerate(patches, start=1):
        inside = ((u > patch.left) & (u < patch.right))[:, None] & ((v > patch.low) & (v < patch.high))[None]
        owner[inside] = index
    normal = np.cross(right, rise)
    normal /= np.linalg.norm(normal)
    meshes = []
    for index, cells in _rectangles(owner).items():
        left, low, end, high = np.array(cells).T
        ends = [(across[a], upward[b]) for a, b in ((left, low), (end, low), (end, high), (left, high))]
        corners = np.stack([start + u[:, None] * right + v[:, None] * rise for u, v in ends], axis=1)  # (cells, 4, 3)
        normals = np.tile(normal, (4 * len(cells), 1))
        meshes.append(surface(corners.reshape(-1, 3), quad_faces(len(cells)), palette[index], normals))
    return join(*meshes)


def _rectangles(owner: NDArray[np.int64]) -> dict[int, list[tuple[int, int, int, int]]]:
    """Rectangles (left, low, right, high) of cells, by owner; ``right`` and ``high`` are exclusive.

    Strips of one owner that have the same ends in successive rows are joined.
    """
    joined: dict[int, list[tuple[int, int, int, int]]] = {}
    open_strips: dict[tuple[int, int, int], int] = {}
    for j in range(owner.shape[1] + 1):
        strips: set[tuple[int, int, int]] = set()
        if j < owner.shape[1]:
            starts = np.concatenate([[0], np.flatnonzero(np.diff(owner[:, j])) + 1, [len(owner)]])
            strips = {(int(owner[a, j]), int(a), int(b)) for a, b in pairwise(starts)}
        for strip in sorted(set(open_strips) - strips):
            index, a, b = strip
            joined.setdefault(index, []).append((a, open_strips.pop(strip), b, j))
        for strip in strips:
            open_strips.setdefault(strip, j)
    return joined


def painted_box(
    size: tuple[float, float, float],
    color: Color | Mapping[Face, Color],
    art: Mapping[Face, Sequence[Patch]] | None = None,
    *,
    base: tuple[float, float, float] = (0.0, 0.0, 0.0),
    front: Literal["-y", "+x"] = "-y",
) -> trimesh.Trimesh:
    """An axis-aligned box with a colour, and optionally a pattern, per face.

    Args:
        size: (x, y, z) side lengths, m.
        color: One colour, or one per face (all six).
        art: Patches per face.
        base: Centre of the bottom face, m.
        front: Side from which the top is seen upright.
    """
    colors = color if isinstance(color, Mapping) else dict.fromkeys(FACES, color)
    x, y, z = np.diag(np.asarray(size, dtype=np.float64))
    low = np.asarray(base, dtype=np.float64) - 0.5 * (x + y)
    frames: dict[Face, tuple[Array, Array, Array]] = {
        "-x": (low + y, -y, z),
        "+x": (low + x, y, z),
        "-y": (low, x, z),
        "+y": (low + x + y, -x, z),
        "bottom": (low + y, x, -y),
        "top": (low + z, x, y) if front == "-y" else (low + x + z, y, -x),
    }
    patterns = art or {}
    return join(*(painted_face(*frames[face], colors[face], patterns.get(face, ())) for face in FACES))


def lettering(
    left: float, low: float, right: float, high: float, color: Color, widths: Sequence[float] = (1.0,) * 6
) -> list[Patch]:
    """Patches that look like a line of large letters: bars of these relative widths with gaps between."""
    gap = 0.34
    total = sum(widths) + gap * (len(widths) - 1)
    patches, x = [], left
    for width in widths:
        step = (right - left) / total
        patches.append(Patch(x, low, x + width * step, high, color))
        x += (width + gap) * step
    return patches


def loft(sections: ArrayLike, color: Color, *, caps: tuple[bool, bool] = (True, True)) -> trimesh.Trimesh:
    """A smooth skin through P sections of K points each (P, K, 3), m, with flat caps at its first and last end.

    The points run counter-clockwise when seen from the last section looking back at the first.
    """
    grid = np.asarray(sections, dtype=np.float64)
    count, around = grid.shape[:2]
    ends = [surface(grid[0], fan(around)[:, ::-1], color), surface(grid[-1], fan(around), color)]
    return join(
        surface(grid.reshape(-1, 3), grid_faces(count, around), color),
        *(end for end, kept in zip(ends, caps, strict=True) if kept),
    )


def moved(mesh: trimesh.Trimesh, rotation: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """The mesh at another pose: rotation (3, 3), then translation (3,) m; colours are kept."""
    turn = np.asarray(rotation, dtype=np.float64)
    visual: Any = mesh.visual
    return trimesh.Trimesh(
        vertices=mesh.vertices @ turn.T + np.asarray(translation),
        faces=mesh.faces,
        vertex_normals=mesh.vertex_normals @ turn.T,
        vertex_colors=visual.vertex_colors,
        process=False,
    )
