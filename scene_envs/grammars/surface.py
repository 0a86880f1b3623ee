"""Supports with their free 2-D region, where a child may be placed without overlap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from scene_envs.assets.base import Asset
from scene_envs.assets.support_shapes import upper_side


class PositionDistribution(Protocol):
    """A distribution over places (x, y) in the frame of a support, m."""

    def draw(self, rng: np.random.Generator) -> tuple[float, float]:
        """One place."""

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(P,) log density up to a constant, at ``points`` (P, 2); None for a distribution on a line or point."""


@dataclass(frozen=True)
class Gaussian:
    """A normal distribution of positions in the plane of a support.

    Attributes:
        x, y: Mean in the support's frame, m.
        along: Standard deviation (m) along ``direction``.
        across: Standard deviation (m) across it; None means that of ``along``.
        direction: Angle of the first axis from +x, rad.
    """

    x: float = 0.0
    y: float = 0.0
    along: float = 0.1
    across: float | None = None
    direction: float = 0.0

    @cached_property
    def _axes(self) -> tuple[float, float, float, float]:
        across = self.along if self.across is None else self.across
        return math.cos(self.direction), math.sin(self.direction), self.along, across

    def draw(self, rng: np.random.Generator) -> tuple[float, float]:
        cos, sin, along, across = self._axes
        u, v = along * rng.standard_normal(), across * rng.standard_normal()
        return self.x + cos * u - sin * v, self.y + sin * u + cos * v

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        cos, sin, along, across = self._axes
        if along == 0.0 or across == 0.0:
            return None
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        return -0.5 * (((cos * dx + sin * dy) / along) ** 2 + ((cos * dy - sin * dx) / across) ** 2)


@dataclass(frozen=True)
class Uniform:
    """Anywhere in a rectangle of the support: ``half_x``, ``half_y`` (m) about (``x``, ``y``)."""

    half_x: float
    half_y: float
    x: float = 0.0
    y: float = 0.0

    def draw(self, rng: np.random.Generator) -> tuple[float, float]:
        x = self.x + self.half_x * (2.0 * rng.random() - 1.0)
        return x, self.y + self.half_y * (2.0 * rng.random() - 1.0)

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        inside = (np.abs(points[:, 0] - self.x) <= self.half_x) & (np.abs(points[:, 1] - self.y) <= self.half_y)
        return np.where(inside, 0.0, -np.inf)


@dataclass(frozen=True)
class Line:
    """Anywhere on the segment between two points (x, y), m: along a wall, at the edge of a shelf."""

    start: tuple[float, float]
    end: tuple[float, float]

    def draw(self, rng: np.random.Generator) -> tuple[float, float]:
        (x, y), (end_x, end_y), t = self.start, self.end, rng.random()
        return x + t * (end_x - x), y + t * (end_y - y)

    def log_density(self, points: NDArray[np.float64]) -> None:
        return None  # a line has no density in the plane


@dataclass(frozen=True)
class Moved:
    """A distribution in its own frame at (``x``, ``y``) m, turned by ``yaw`` rad."""

    distribution: PositionDistribution
    x: float
    y: float
    yaw: float

    def draw(self, rng: np.random.Generator) -> tuple[float, float]:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.distribution.draw(rng)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        return self.distribution.log_density(np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=1))


@dataclass(frozen=True)
class Yaw:
    """Turn of a child about the vertical: one of ``choices`` plus a normal deviate.

    Attributes:
        std: Standard deviation, rad; infinite for any angle.
        choices: Angles (rad) of the object's +x axis from the support's, equally likely.
    """

    std: float = math.inf
    choices: tuple[float, ...] = (0.0,)

    def draw(self, rng: np.random.Generator) -> float:
        """One angle, rad."""
        if self.std == math.inf:
            return rng.random() * 2.0 * math.pi
        center = self.choices[0] if len(self.choices) == 1 else self.choices[int(rng.integers(len(self.choices)))]
        return center + self.std * rng.standard_normal()

    def turned(self, angle: float) -> Yaw:
        """The same distribution in a frame that is turned by ``angle``, rad."""
        return self if self.std == math.inf else Yaw(self.std, tuple(choice + angle for choice in self.choices))


CLEARANCE = 5e-4
"""Margin (m) by which the plan of an asset is larger than the asset, so that neighbours never touch."""


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


def heights_of(asset: Asset) -> tuple[float, float, float]:
    """z of the foot, of the top, and of an object at rest in the middle of ``asset``, m, asset frame."""
    return _tidy(asset.bounds[0, 2]), _tidy(asset.bounds[1, 2]), carrying_height(asset)


def carrying_height(asset: Asset) -> float:
    """z (m, asset frame) at which something in the middle of ``asset`` rests: a plate's base, the floor of a bowl."""
    height = max(float(upper_side(part, np.zeros((1, 1, 2)))[0, 0]) for part in asset.fine)
    return _tidy(height if height > -math.inf else asset.bounds[1, 2])


def _tidy(value: float) -> float:
    """A length rounded to nine decimals, to remove rounding errors."""
    return float(np.round(value, 9)) + 0.0


_DRAWS = 24
"""Draws from a child's own distribution before the free region is enumerated."""
_CELL = 0.02
"""Side of the cells (m) in which a crowded free region is enumerated; larger where the region is larger than 2 m."""
_MAX_CELLS = 100
"""Largest number of cells along each side of a region."""


@dataclass(frozen=True)
class Region:
    """Region of the frames of children: a rectangle cut by an optional disc, in the support's frame.

    Attributes:
        half_x, half_y: Half sides of the rectangle (m) in which object frames stay.
        radius: Radius (m) of the disc about the support's origin in which whole footprints stay.
        overhang: Largest distance (m) of footprints beyond the rectangle; 0 keeps all of them inside.
        x, y: Centre of the rectangle, m.
    """

    half_x: float
    half_y: float
    radius: float = math.inf
    overhang: float = math.inf
    x: float = 0.0
    y: float = 0.0

    def contains(self, child: Placed) -> bool:
        """Whether a child with this footprint is inside."""
        if abs(child.x - self.x) > self.half_x or abs(child.y - self.y) > self.half_y:
            return False
        plan = child.plan
        if isinstance(plan, Disc):
            if math.hypot(child.x, child.y) + plan.radius > self.radius:
                return False
            return (
                abs(child.x - self.x) + plan.radius <= self.half_x + self.overhang
                and abs(child.y - self.y) + plan.radius <= self.half_y + self.overhang
            )
        if self.radius == math.inf and self.overhang == math.inf:
            return True
        limit_x, limit_y = self.half_x + self.overhang, self.half_y + self.overhang
        return all(
            math.hypot(x, y) <= self.radius and abs(x - self.x) <= limit_x and abs(y - self.y) <= limit_y
            for x, y in child.corners()
        )

    def limits(self, foot: float) -> tuple[float, float, float]:
        """Bounds (m) for the frame of a child whose footprint holds a disc of radius ``foot``: the largest distance
        from the centre of the rectangle in x and in y, and from the support's origin.
        """
        over = min(0.0, self.overhang - foot)
        return self.half_x + over, self.half_y + over, max(0.0, self.radius - foot)

    @cached_property
    def cells(self) -> tuple[NDArray[np.float64], float, float]:
        """(P, 2) centres of the cells that cover the rectangle, and the two sides of a cell, m."""
        nx, ny = (min(_MAX_CELLS, max(1, math.ceil(2 * half / _CELL))) for half in (self.half_x, self.half_y))
        wide, deep = 2 * self.half_x / nx, 2 * self.half_y / ny
        xs = (np.arange(nx) + 0.5) * wide - self.half_x + self.x
        ys = (np.arange(ny) + 0.5) * deep - self.half_y + self.y
        return np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2), wide, deep


@dataclass(frozen=True)
class Outline:
    """Area that a child needs on its support.

    Attributes:
        keep_out: Area that no other child's keep-out may meet; one plan per level of a stack.
        footprint: Area that must lie in the region; one plan per level.
    """

    keep_out: tuple[Plan, ...]
    footprint: tuple[Plan, ...]

    @cached_property
    def core(self) -> float:
        """Radius (m) of a disc about the frame that lies within the keep-out at every yaw."""
        return max(inscribed(plan) for plan in self.keep_out)

    @cached_property
    def foot(self) -> float:
        """Radius (m) of a disc about the frame that lies within the footprint at every yaw."""
        return max(inscribed(plan) for plan in self.footprint)


@dataclass
class FreeSurface:
    """A flat support while it is being filled.

    >>> from scene_envs.grammars.surface import Gaussian
    >>> surface = FreeSurface(Region(0.5, 0.5))
    >>> rng = np.random.default_rng(0)
    >>> cup = Outline((Disc(0.1),), (Disc(0.1),))
    >>> a, b = (surface.place(Gaussian(along=0.01), Yaw(), cup, rng) for _ in range(2))
    >>> math.dist(a[:2], b[:2]) >= 0.2
    True
    """

    region: Region
    _placed: list[Placed] = field(default_factory=list)
    _cores: list[tuple[float, float, float]] = field(default_factory=list)

    def mark(self) -> int:
        """Number of plans on the surface, for :meth:`reset`."""
        return len(self._placed)

    def reset(self, mark: int) -> None:
        """Remove the children placed since :meth:`mark`."""
        del self._placed[mark:], self._cores[mark:]

    def fit(self, x: float, y: float, yaws: Sequence[float], outline: Outline) -> list[Placed] | None:
        """The child's keep-outs at (x, y) with one yaw (rad) per level, if it fits there; else None."""
        turns = [(math.cos(yaw), math.sin(yaw)) for yaw in yaws]
        feet = (Placed(plan, x, y, cos, sin) for plan, (cos, sin) in zip(outline.footprint, turns, strict=False))
        if not all(map(self.region.contains, feet)):
            return None
        child = [Placed(plan, x, y, cos, sin) for plan, (cos, sin) in zip(outline.keep_out, turns, strict=False)]
        return None if any(meet(level, other) for other in self._placed for level in child) else child

    def place(
        self, where: PositionDistribution, yaw: Yaw, outline: Outline, rng: np.random.Generator, levels: int = 1
    ) -> tuple[float, float, tuple[float, ...]] | None:
        """Place one child at a draw of ``where`` restricted to the free region; None when there is no room.

        A few plain draws are tried first. On a crowded support the free cells are enumerated, and one of them is drawn
        in proportion to its density. The result is the position x, y (m), and the yaw (rad) of each of its ``levels``.
        """
        region = self.region
        half_x, half_y, radius = region.limits(outline.foot)
        for _ in range(_DRAWS):
            x, y = where.draw(rng)
            if abs(x - region.x) > half_x or abs(y - region.y) > half_y or x * x + y * y > radius * radius:
                continue
            if self._is_taken(x, y, outline.core):
                continue
            spot = self._settle(x, y, yaw, outline, rng, levels)
            if spot is not None:
                return spot
        return self._place_in_cells(where, yaw, outline, rng, levels)

    def _is_taken(self, x: float, y: float, core: float) -> bool:
        """Whether a disc of radius ``core`` (m) at (x, y) meets another child's inner disc; misses some overlaps."""
        for other_x, other_y, other in self._cores:
            dx, dy, reach = x - other_x, y - other_y, core + other
            if dx * dx + dy * dy < reach * reach:
                return True
        return False

    def _settle(
        self, x: float, y: float, yaw: Yaw, outline: Outline, rng: np.random.Generator, levels: int
    ) -> tuple[float, float, tuple[float, ...]] | None:
        """Keep the child at (x, y), turned at random, if it fits there."""
        yaws = tuple(yaw.draw(rng) for _ in range(levels))
        child = self.fit(x, y, yaws, outline)
        if child is None:
            return None
        self._placed += child
        self._cores += [(*placed.center(), _inner(placed.plan)) for placed in child]
        return x, y, yaws

    def _place_in_cells(
        self, where: PositionDistribution, yaw: Yaw, outline: Outline, rng: np.random.Generator, levels: int
    ) -> tuple[float, float, tuple[float, ...]] | None:
        cells, wide, deep = self.region.cells
        log_density = where.log_density(cells)
        if log_density is None:
            return None
        free = np.isfinite(log_density) & self._roomy(cells, outline)
        candidates, log_density = cells[free], log_density[free]
        if not len(candidates):
            return None
        cumulative = np.cumsum(np.exp(log_density - log_density.max()))
        for _ in range(_DRAWS):
            x, y = candidates[np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right")]
            x, y = float(x + (rng.random() - 0.5) * wide), float(y + (rng.random() - 0.5) * deep)
            if not self._is_taken(x, y, outline.core):
                spot = self._settle(x, y, yaw, outline, rng, levels)
                if spot is not None:
                    return spot
        return None

    def _roomy(self, cells: NDArray[np.float64], outline: Outline) -> NDArray[np.bool_]:
        """(P,) bool: cells that discs within the plans do not rule out; some of these may have no room."""
        inner, foot, region = outline.core, outline.foot, self.region
        _, wide, deep = region.cells
        free = np.hypot(cells[:, 0], cells[:, 1]) + foot <= region.radius
        free &= np.abs(cells[:, 0] - region.x) + foot <= region.half_x + region.overhang + wide
        free &= np.abs(cells[:, 1] - region.y) + foot <= region.half_y + region.overhang + deep
        for x, y, other in self._cores:
            free &= (cells[:, 0] - x) ** 2 + (cells[:, 1] - y) ** 2 >= (inner + other) ** 2
        return free


def _inner(plan: Plan) -> float:
    """Radius (m) of the largest disc about the centre of the plan that lies within it."""
    return plan.radius if isinstance(plan, Disc) else min(plan.half_x, plan.half_y)
