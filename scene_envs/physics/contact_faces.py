"""Contact faces: the flat faces of assets that carry objects or rest on others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from scene_envs.arrays import Array
from scene_envs.physics.parts import PartGeometry

_FLAT = 1e-5
"""Corners this close (m) to the extreme height belong to the face."""
_SAME_AREA = 1e-3
"""Relative difference of areas below which a face has no hole."""


@dataclass(frozen=True)
class ContactFace:
    """Position of a horizontal face of an asset, and extent of its solid area."""

    height: float  # height z in the asset frame, m
    center: tuple[float, float]  # centre (x, y) in the asset frame, m
    inner: float  # radius (m) of the largest circle inside the outline
    corners: float  # smallest distance (m) of an outline corner from the centre
    outer: float  # largest distance (m) of an outline corner from the centre
    hole: float  # radius (m) outside of which the face is solid up to its outline; 0 without a hole


def contact_face(fine: Sequence[PartGeometry], coarse: Sequence[PartGeometry], side: int) -> ContactFace | None:
    """The face at the lowest (``side`` -1) or highest (+1) z, or None.

    The result is None also when the two levels of detail have different outlines there, or when the outline is not
    solid all the way round (four legs). In these cases fine and coarse parts support objects differently.
    """
    height = side * max(float((side * part.vertices[:, 2]).max()) for part in fine)
    polygons = [polygon for part in fine if (polygon := _flat_corners(part, height)) is not None]
    outline = _hull2(np.concatenate(polygons)) if polygons else None
    coarse_polygons = [polygon for part in coarse if (polygon := _flat_corners(part, height)) is not None]
    coarse_outline = _hull2(np.concatenate(coarse_polygons)) if coarse_polygons else None
    if outline is None or coarse_outline is None or abs(_area(outline) - _area(coarse_outline)) > 1e-7:
        return None
    center = 0.5 * (outline.min(axis=0) + outline.max(axis=0))
    radii = np.linalg.norm(outline - center, axis=1)
    inner = float(-_outside(center[None], outline)[0])
    hole = 0.0
    if abs(sum(_area(polygon) for polygon in polygons) / _area(outline) - 1.0) > _SAME_AREA:
        middles = 0.5 * (outline + np.roll(outline, -1, axis=0))
        gaps = np.stack([_outside(middles, polygon) for polygon in polygons]).min(axis=0)
        if gaps.max() > 1e-4:
            return None
        points = np.concatenate(polygons)
        inside = points[_outside(points, outline) < -1e-4]
        if not len(inside):
            return None
        hole = float(np.linalg.norm(inside - center, axis=1).max())
    return ContactFace(
        height, (float(center[0]), float(center[1])), inner, float(radii.min()), float(radii.max()), hole
    )


def _flat_corners(part: PartGeometry, height: float) -> Array | None:
    """Counter-clockwise outline (K, 2) of the part's face at ``height``, or None."""
    points = part.vertices[np.abs(part.vertices[:, 2] - height) < _FLAT][:, :2]
    return _hull2(points) if len(points) >= 3 else None


def _hull2(points: Array) -> Array | None:
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return None


def _area(polygon: Array) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def _outside(points: Array, polygon: Array) -> Array:
    """(P,) m, distance of each point outside the convex polygon; negative inside."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    normal = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1, keepdims=True)
    return ((points[:, None] - polygon[None]) * normal[None]).sum(axis=2).max(axis=1)
