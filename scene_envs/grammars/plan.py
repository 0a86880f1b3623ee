"""Plans of objects: discs and rectangles in the plane of a support, and their intersection test."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scene_envs.assets.base import Asset

CLEARANCE = 5e-4
"""Margin (m) by which the plan of an asset is larger than the asset, so that neighbours never touch."""
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Disc:
    """A circle about the frame of an object; ``radius`` in m."""

    radius: float

    @property
    def reach(self) -> float:
        """Largest distance (m) of the plan from the frame."""
        return self.radius


@dataclass(frozen=True)
class Rectangle:
    """An axis-aligned rectangle in the frame of an object.

    Attributes:
        half_x, half_y: Half sides, m.
        center_x, center_y: Centre in the object frame, m.
    """

    half_x: float
    half_y: float
    center_x: float = 0.0
    center_y: float = 0.0

    @cached_property
    def reach(self) -> float:
        """Largest distance (m) of the plan from the frame."""
        return math.hypot(abs(self.center_x) + self.half_x, abs(self.center_y) + self.half_y)


Plan = Disc | Rectangle


def inscribed(plan: Plan) -> float:
    """Radius (m) of the largest disc about the frame that lies within the plan; 0 when the frame is outside."""
    if isinstance(plan, Disc):
        return plan.radius
    return max(0.0, min(plan.half_x - abs(plan.center_x), plan.half_y - abs(plan.center_y)))


class Placed(NamedTuple):
    """A plan at a place: frame (x, y) in m, cosine and sine of its yaw."""

    plan: Plan
    x: float
    y: float
    cos: float
    sin: float

    def corners(self) -> list[tuple[float, float]]:
        """The four corners of a rectangle, counter-clockwise, m."""
        plan = self.plan
        if isinstance(plan, Disc):
            raise TypeError("a disc has no corners")
        x, y = self.center()
        ux, uy = self.cos * plan.half_x, self.sin * plan.half_x
        vx, vy = -self.sin * plan.half_y, self.cos * plan.half_y
        return [(x + ux + vx, y + uy + vy), (x - ux + vx, y - uy + vy), (x - ux - vx, y - uy - vy),
                (x + ux - vx, y + uy - vy)]  # fmt: skip

    def center(self) -> tuple[float, float]:
        """Centre of the plan, m."""
        if isinstance(self.plan, Disc):
            return self.x, self.y
        a, b = self.plan.center_x, self.plan.center_y
        return self.x + self.cos * a - self.sin * b, self.y + self.sin * a + self.cos * b


def meet(first: Placed, second: Placed) -> bool:
    """Whether two plans overlap.

    >>> square = Rectangle(0.1, 0.1)
    >>> meet(Placed(square, 0.0, 0.0, 1.0, 0.0), Placed(Disc(0.05), 0.16, 0.0, 1.0, 0.0))
    False
    >>> meet(Placed(square, 0.0, 0.0, 1.0, 0.0), Placed(Disc(0.05), 0.13, 0.13, 1.0, 0.0))
    True
    """
    dx, dy = second.x - first.x, second.y - first.y
    reach = first.plan.reach + second.plan.reach
    if dx * dx + dy * dy >= reach * reach:
        return False
    if isinstance(first.plan, Disc):
        if isinstance(second.plan, Disc):
            return True
        return _disc_meets(second, first.x, first.y, first.plan.radius)
    if isinstance(second.plan, Disc):
        return _disc_meets(first, second.x, second.y, second.plan.radius)
    return not (_apart(first, second) or _apart(second, first))


def _disc_meets(box: Placed, x: float, y: float, radius: float) -> bool:
    plan = box.plan
    assert isinstance(plan, Rectangle)
    center_x, center_y = box.center()
    dx, dy = x - center_x, y - center_y
    along = max(0.0, abs(box.cos * dx + box.sin * dy) - plan.half_x)
    across = max(0.0, abs(box.cos * dy - box.sin * dx) - plan.half_y)
    return along * along + across * across < radius * radius


def _apart(box: Placed, other: Placed) -> bool:
    """Whether a side of ``box`` separates the two rectangles."""
    plan = box.plan
    assert isinstance(plan, Rectangle)
    center_x, center_y = box.center()
    along, across = [], []
    for x, y in other.corners():
        dx, dy = x - center_x, y - center_y
        along.append(box.cos * dx + box.sin * dy)
        across.append(box.cos * dy - box.sin * dx)
    return (
        min(along) >= plan.half_x
        or max(along) <= -plan.half_x
        or min(across) >= plan.half_y
        or max(across) <= -plan.half_y
    )


def plan_of(asset: Asset) -> Plan:
    """The smaller of the disc about the frame and the axis-aligned rectangle that hold ``asset``, with a margin."""
    corners = np.concatenate([part.vertices for part in asset.fine])
    radius = float(np.hypot(corners[:, 0], corners[:, 1]).max()) + CLEARANCE
    low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    half = 0.5 * (high - low) + CLEARANCE
    if math.pi * radius**2 < 4.0 * half[0] * half[1]:
        return Disc(radius)
    center = 0.5 * (low + high)
    return Rectangle(*(float(v) for v in (*half, *np.round(center, 9))))


def foot_of(asset: Asset) -> float:
    """z of the lowest point of ``asset`` in its frame, m."""
    return _tidy(asset.bounds[0, 2])


def top_of(asset: Asset) -> float:
    """z of the highest point of ``asset`` in its frame, m."""
    return _tidy(asset.bounds[1, 2])


def carrying_height(asset: Asset) -> float:
    """z (m, asset frame) at which something in the middle of ``asset`` rests: a plate's base, the floor of a bowl."""
    heights = [top for part in asset.fine if (top := _top_on_axis(part.vertices[part.faces])) is not None]
    return _tidy(max(heights)) if heights else top_of(asset)


def _top_on_axis(triangles: NDArray[np.float64]) -> float | None:
    """Highest z at which a convex part (F, 3, 3) crosses the line x = y = 0; None when it does not."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    offsets = np.einsum("fi,fi->f", normals, triangles[:, 0])
    slope = normals[:, 2]
    scale = np.abs(normals).max()
    level = np.abs(slope) <= 1e-9 * scale
    if (offsets[level] < -_ROUNDING * scale).any():
        return None
    high = (offsets[slope > 1e-9 * scale] / slope[slope > 1e-9 * scale]).min()
    low = (offsets[slope < -1e-9 * scale] / slope[slope < -1e-9 * scale]).max()
    return float(high) if high >= low - _ROUNDING else None


def _tidy(value: float) -> float:
    """A length rounded to nine decimals, to remove rounding errors."""
    return float(np.round(value, 9)) + 0.0
