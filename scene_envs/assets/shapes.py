"""Convex parts from a few numbers: boxes, solids of revolution, rings of wedges, rods; and their mass.

All lengths are metres, all points are in the asset frame (z up). Circles are regular polygons whose
corners lie on the nominal circle, so that a diameter is the distance between opposite corners.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull, QhullError

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart
from scene_envs.errors import InvalidInputError

Profile = Sequence[tuple[float, float]]
"""Points (r, z) of a half section, m."""


class MassProperties(NamedTuple):
    """Mass (kg), centre of mass (3,) m and inertia (3, 3) kg m^2 about the centre of mass, asset axes."""

    mass: float
    center_of_mass: Array
    inertia: Array


def convex_hull(points: ArrayLike) -> ConvexPart:
    """The hull of points (P, 3), with triangles facing outward.

    Raises:
        InvalidInputError: fewer than four points, or all in one plane.
    """
    cloud = np.asarray(points, dtype=np.float64)
    try:
        hull = ConvexHull(cloud)
    except (QhullError, ValueError) as error:
        raise InvalidInputError(
            f"{len(cloud)} points span no volume, so they have no convex hull; give at least four points "
            "that do not lie in one plane"
        ) from error
    triangles = cloud[hull.simplices]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = np.einsum("fi,fi->f", normals, hull.equations[:, :3]) < 0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, faces = np.unique(faces, return_inverse=True)
    return ConvexPart(cloud[used], faces.reshape(-1, 3).astype(np.int64))


def hull_of(parts: Iterable[ConvexPart]) -> ConvexPart:
    """The convex hull of several parts, as coarse models use it."""
    return convex_hull(np.concatenate([part.vertices for part in parts]))


def box(size: tuple[float, float, float], base: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ConvexPart:
    """An axis-aligned box; ``base`` is the centre of its bottom face.

    >>> box((0.2, 0.1, 0.05)).bounds.tolist()
    [[-0.1, -0.05, 0.0], [0.1, 0.05, 0.05]]
    """
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
    return convex_hull(corners * np.asarray(size) + np.asarray(base))


def circle(segments: int, phase: float = 0.0) -> NDArray[np.float64]:
    """(segments, 2): corners of the regular polygon in the unit circle, the first at angle ``phase`` (rad)."""
    angles = phase + 2.0 * np.pi * np.arange(segments) / segments
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def solid(profile: Profile, segments: int, phase: float = 0.0) -> ConvexPart:
    """The convex hull of a half section revolved about z: cylinders, frusta, convex bodies.

    Args:
        profile: Points (r, z), m; r = 0 gives a single point.
        segments: Number of corners of the polygon that replaces a circle.
        phase: Angle of the first corner, rad.

    >>> cylinder = solid([(0.1, 0.0), (0.1, 0.2)], 16)
    >>> len(cylinder.vertices), cylinder.bounds[1].round(3).tolist()
    (32, [0.1, 0.1, 0.2])
    """
    unit = circle(segments, phase)
    layers = [
        np.array([[0.0, 0.0, z]]) if r == 0.0 else np.column_stack([r * unit, np.full(segments, z)]) for r, z in profile
    ]
    return convex_hull(np.concatenate(layers))


def ring(profile: Profile, segments: int, phase: float = 0.0) -> list[ConvexPart]:
    """A convex section swept about z as ``segments`` wedges that touch and do not overlap.

    Args:
        profile: Corners (r, z) of a convex section with r > 0, m.
        segments: Number of wedges.
        phase: Angle of the first joint, rad.

    >>> walls = ring([(0.10, 0.0), (0.12, 0.0), (0.12, 0.09), (0.10, 0.09)], 16)
    >>> len(walls), len(walls[0].vertices)
    (16, 8)
    """
    section = np.asarray(profile, dtype=np.float64)
    if (section[:, 0] <= 0).any():
        raise InvalidInputError(f"a ring needs radii above 0 m, got {section[:, 0].min()}; use solid instead")
    unit = circle(segments, phase)
    joints = np.concatenate(
        [section[None, :, :1] * unit[:, None, :], np.broadcast_to(section[None, :, 1:], (segments, len(section), 1))],
        axis=2,
    )  # (segments, P, 3)
    return [convex_hull(np.concatenate([joints[i], joints[(i + 1) % segments]])) for i in range(segments)]


def rods(path: Sequence[tuple[float, float, float]], width: float, thickness: float) -> list[ConvexPart]:
    """Boxes along a path in the x-z plane: handles and spouts.

    Args:
        path: P points (x, y, z), m, all with the same y.
        width: Size along y, m.
        thickness: Size across the path in the x-z plane, m.

    Returns:
        P - 1 parts; neighbours share their end faces, cut along the bisector (mitred).
    """
    points = np.asarray(path, dtype=np.float64)
    step = np.diff(points[:, [0, 2]], axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    tangents = np.concatenate([step[:1], step[:-1] + step[1:], step[-1:]])
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.stack([-tangents[:, 1], np.zeros(len(points)), tangents[:, 0]], axis=1)
    nearest = np.concatenate([step[:1], step])  # mitred ends are longer, so that the thickness stays the same
    scale = 1.0 / np.abs(np.einsum("pi,pi->p", tangents, nearest))
    half = 0.5 * thickness * scale[:, None] * across
    side = np.array([0.0, 0.5 * width, 0.0])
    ends = np.stack([points + half + side, points + half - side, points - half + side, points - half - side], axis=1)
    return [convex_hull(np.concatenate([ends[i], ends[i + 1]])) for i in range(len(points) - 1)]


def volume(parts: Iterable[ConvexPart]) -> float:
    """Summed volume of the parts, m^3 (overlap counts twice)."""
    return float(sum(np.linalg.det(part.vertices[part.faces]).sum() / 6.0 for part in parts))


def mass_properties(parts: Iterable[ConvexPart], mass: float) -> MassProperties:
    """Mass properties of the parts at one density, scaled to ``mass`` kg.

    Exact integrals over the tetrahedra between the origin and each face. With ``mass`` 0 the inertia is 0.
    """
    triangles = np.concatenate([part.vertices[part.faces] for part in parts])  # (F, 3, 3)
    volumes = np.linalg.det(triangles) / 6.0
    total = volumes.sum()
    sums = triangles.sum(axis=1)
    center = (volumes[:, None] * sums).sum(axis=0) / (4.0 * total)
    # Integral of x x^T over a tetrahedron (0, a, b, c): V/20 (sum_k v_k v_k^T + s s^T), s = a + b + c.
    second = np.einsum("f,fki,fkj->ij", volumes, triangles, triangles) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    covariance = second / (20.0 * total) - np.outer(center, center)
    inertia = mass * (np.trace(covariance) * np.eye(3) - covariance)
    return MassProperties(mass, center, 0.5 * (inertia + inertia.T))
