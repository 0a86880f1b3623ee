"""Convex hulls of surfaces: deviation of a surface from its hull, and hulls with few corners."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart
from scene_envs.assets.shapes import convex_hull

MAX_CORNERS = 64
"""Largest number of corners of a hull; the cost of collision tests grows in proportion."""
_COARSE_CORNERS = 16
"""Corners of the inner hull whose faces are moved outward to make an enclosing hull."""
_DIRECTIONS = np.array(list(np.ndindex(3, 3, 3)), dtype=np.float64) - 1.0
"""Directions to the 26 neighbours of a cell, and the zero vector."""


def few_cornered_hull(points: Array, tolerance: float, corners: int = MAX_CORNERS) -> tuple[ConvexPart, float]:
    """A hull of some of the points (P, 3), and the farthest distance (m) of a point outside it.

    Starts from the extreme points and adds the farthest outlier until all are within ``tolerance`` (m) or
    ``corners`` are used, as quickhull does.

    Raises:
        InvalidInputError: the points lie in one plane.

    >>> turns = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    >>> disc = np.array([[np.cos(t), np.sin(t), z] for t in turns for z in (0.0, 0.1)])
    >>> part, outside = few_cornered_hull(disc, 0.02)
    >>> len(part.vertices) <= 64, outside <= 0.02
    (True, True)
    """
    full = convex_hull(points)
    if len(full.vertices) <= corners and len(full.vertices) <= 16:
        return full, 0.0
    cloud = full.vertices
    chosen = np.unique(np.argmax(cloud @ _DIRECTIONS.T, axis=0))[:corners].tolist()
    if np.linalg.matrix_rank(cloud[chosen] - cloud[chosen[0]], tol=1e-9) < 3:
        return full, 0.0
    while True:
        planes = ConvexHull(cloud[chosen]).equations
        outside = (cloud @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        worst = int(outside.argmax())
        if outside[worst] <= tolerance or len(chosen) >= corners:
            return convex_hull(cloud[chosen]), max(0.0, float(outside[worst]))
        chosen.append(worst)


def concavity(points: Array, hull: ConvexPart) -> float:
    """Largest depth (m) of the points (P, 3) below the surface of ``hull``."""
    planes = ConvexHull(hull.vertices).equations
    deepest = 0.0
    for start in range(0, len(points), 4096):
        gaps = points[start : start + 4096] @ planes[:, :3].T + planes[:, 3]
        deepest = max(deepest, float((-gaps).min(axis=1).max()))
    return deepest


def enclosing_hull(parts: Sequence[ConvexPart]) -> ConvexPart:
    """One convex part that encloses all parts, with few faces; the exact hull when that has few corners."""
    points = np.concatenate([part.vertices for part in parts])
    exact = convex_hull(points)
    if len(exact.vertices) <= MAX_CORNERS:
        return exact
    inner, _ = few_cornered_hull(points, 0.0, _COARSE_CORNERS)
    normals = np.concatenate([ConvexHull(inner.vertices).equations[:, :3], np.eye(3), -np.eye(3)])
    offsets = (points @ normals.T).max(axis=0)
    try:
        corners = HalfspaceIntersection(np.column_stack([normals, -offsets]), inner.vertices.mean(axis=0)).intersections
        return convex_hull(corners[np.isfinite(corners).all(axis=1)])
    except QhullError:
        return exact


def thickness(part: ConvexPart) -> float:
    """Smallest distance (m) between a face of the part and the corner farthest from it."""
    planes = ConvexHull(part.vertices).equations
    return float((-(part.vertices @ planes[:, :3].T + planes[:, 3])).max(axis=0).min())


def has_volume(points: Array) -> bool:
    """Whether the points (P, 3) span a volume, up to rounding."""
    if len(points) < 4:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] > 1e-6 * max(spread[0], 1e-300))
