"""Supports with their free 2-D region, where a child may be placed without overlap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scene_envs.grammars.distributions import PositionDistribution, Yaw
from scene_envs.grammars.plan import Disc, Placed, Plan, inscribed, meet

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
        """Bounds (m) for the frame of a child whose footprint holds a disc of radius ``foot``.

        Returns:
            Largest distance from the centre of the rectangle in x and in y, and from the support's origin.
        """
        over = min(0.0, self.overhang - foot)
        return self.half_x + over, self.half_y + over, max(0.0, self.radius - foot)

    @cached_property
    def _cells(self) -> tuple[NDArray[np.float64], float, float]:
        nx, ny = (min(_MAX_CELLS, max(1, math.ceil(2 * half / _CELL))) for half in (self.half_x, self.half_y))
        wide, deep = 2 * self.half_x / nx, 2 * self.half_y / ny
        xs = (np.arange(nx) + 0.5) * wide - self.half_x + self.x
        ys = (np.arange(ny) + 0.5) * deep - self.half_y + self.y
        return np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2), wide, deep

    @property
    def cells(self) -> NDArray[np.float64]:
        """(P, 2) cell centres that cover the rectangle, m."""
        return self._cells[0]

    @property
    def cell_size(self) -> tuple[float, float]:
        """Sides of a cell, m."""
        return self._cells[1], self._cells[2]


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

    >>> from scene_envs.grammars.distributions import Gaussian
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
        for plan, (cos, sin) in zip(outline.footprint, turns, strict=False):
            if not self.region.contains(Placed(plan, x, y, cos, sin)):
                return None
        child = [Placed(plan, x, y, cos, sin) for plan, (cos, sin) in zip(outline.keep_out, turns, strict=False)]
        for other in self._placed:
            for level in child:
                if meet(level, other):
                    return None
        return child

    def place(
        self, where: PositionDistribution, yaw: Yaw, outline: Outline, rng: np.random.Generator, levels: int = 1
    ) -> tuple[float, float, tuple[float, ...]] | None:
        """Place one child at a draw of ``where`` restricted to the free region; None when there is no room.

        A few plain draws are tried first. On a crowded support the free cells are enumerated, and one of them is drawn
        in proportion to its density.

        Returns:
            Position x, y (m), and the yaw (rad) of each of its ``levels``.
        """
        region = self.region
        half_x, half_y, radius = region.limits(outline.foot)
        keep_out = outline.core
        for _ in range(_DRAWS):
            x, y = where.draw(rng)
            if abs(x - region.x) > half_x or abs(y - region.y) > half_y or x * x + y * y > radius * radius:
                continue
            if self._is_taken(x, y, keep_out):
                continue
            spot = self._settle(x, y, yaw, outline, rng, levels)
            if spot is not None:
                return spot
        return self._place_in_cells(where, yaw, outline, rng, levels)

    def _is_taken(self, x: float, y: float, core: float) -> bool:
        """Whether a disc of radius ``core`` (m) at (x, y) meets another child's inner disc.

        This test is quick, but misses some overlaps.
        """
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
        cells = self.region.cells
        log_density = where.log_density(cells)
        if log_density is None:
            return None
        free = np.isfinite(log_density) & self._roomy(cells, outline)
        candidates, log_density = cells[free], log_density[free]
        if not len(candidates):
            return None
        wide, deep = self.region.cell_size
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
        """(P,) bool: cells that discs within the plans do not rule out.

        This test is quick, but some of these cells may have no room.
        """
        inner, foot = outline.core, outline.foot
        region = self.region
        free = np.hypot(cells[:, 0], cells[:, 1]) + foot <= region.radius
        free &= np.abs(cells[:, 0] - region.x) + foot <= region.half_x + region.overhang + region.cell_size[0]
        free &= np.abs(cells[:, 1] - region.y) + foot <= region.half_y + region.overhang + region.cell_size[1]
        for x, y, other in self._cores:
            free &= (cells[:, 0] - x) ** 2 + (cells[:, 1] - y) ** 2 >= (inner + other) ** 2
        return free


def _inner(plan: Plan) -> float:
    """Radius (m) of the largest disc about the centre of the plan that lies within it."""
    return plan.radius if isinstance(plan, Disc) else min(plan.half_x, plan.half_y)
