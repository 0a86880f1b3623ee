"""Supports that know their free 2-D region: where a child may still be placed without overlap."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

_DRAWS = 24
"""Draws from a child's own distribution before the free region is enumerated."""
_CELL = 0.02
"""Side of the cells (m) in which a crowded free region is enumerated."""


@dataclass(frozen=True)
class Gaussian:
    """Where a child would like to stand: a normal distribution in the plane of its support.

    Attributes:
        x, y: mean, m, in the support's frame.
        along: standard deviation (m) along ``direction``.
        across: standard deviation (m) across it; the same as ``along`` when None.
        direction: angle of the first axis from +x, rad.
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
        """One position (x, y), m."""
        cos, sin, along, across = self._axes
        u, v = along * rng.standard_normal(), across * rng.standard_normal()
        return self.x + cos * u - sin * v, self.y + sin * u + cos * v

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(P,) log density up to a constant, at ``points`` (P, 2)."""
        cos, sin, along, across = self._axes
        dx, dy = points[:, 0] - self.x, points[:, 1] - self.y
        result: NDArray[np.float64] = -0.5 * (
            ((cos * dx + sin * dy) / along) ** 2 + ((cos * dy - sin * dx) / across) ** 2
        )
        return result


@dataclass(frozen=True)
class Region:
    """A rectangle cut by an optional disc, both centred on the support's origin.

    Attributes:
        half_x, half_y: half sides of the rectangle (m) in which object frames stay.
        radius: radius (m) of the disc in which whole footprints stay; infinite for none.
    """

    half_x: float
    half_y: float
    radius: float = math.inf

    def contains(self, x: float, y: float, footprint: float) -> bool:
        """Whether a child with a round ``footprint`` (radius, m) at (x, y) is inside."""
        if abs(x) > self.half_x or abs(y) > self.half_y:
            return False
        return math.hypot(x, y) + footprint <= self.radius

    @cached_property
    def cells(self) -> NDArray[np.float64]:
        """(P, 2) cell centres that cover the rectangle, m."""
        nx, ny = (max(1, math.ceil(2 * half / _CELL)) for half in (self.half_x, self.half_y))
        xs = (np.arange(nx) + 0.5) * (2 * self.half_x / nx) - self.half_x
        ys = (np.arange(ny) + 0.5) * (2 * self.half_y / ny) - self.half_y
        return np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)


@dataclass
class FreeSurface:
    """A flat support while it is being filled.

    Children keep their distance: two centres are at least the sum of their keep-out radii apart.

    >>> surface = FreeSurface(Region(0.5, 0.5))
    >>> rng = np.random.default_rng(0)
    >>> a, b = (surface.place(Gaussian(along=0.01), 0.1, 0.1, rng) for _ in range(2))
    >>> math.dist(a, b) >= 0.2
    True
    """

    region: Region
    _placed: list[tuple[float, float, float]] = field(default_factory=list)

    def is_free(self, x: float, y: float, keep_out: float, footprint: float) -> bool:
        """Whether a child with this keep-out radius and footprint (m) fits at (x, y)."""
        if not self.region.contains(x, y, footprint):
            return False
        for other_x, other_y, other in self._placed:
            dx, dy, reach = x - other_x, y - other_y, keep_out + other
            if dx * dx + dy * dy < reach * reach:
                return False
        return True

    def place(
        self, wish: Gaussian, keep_out: float, footprint: float, rng: np.random.Generator
    ) -> tuple[float, float] | None:
        """Place one child where its distribution, cut to the free region, says; None when there is no room.

        A few plain draws are tried first; on a crowded support the free cells are enumerated and one of
        them is drawn by its density.
        """
        for _ in range(_DRAWS):
            x, y = wish.draw(rng)
            if self.is_free(x, y, keep_out, footprint):
                break
        else:
            spot = self._draw_from_cells(wish, keep_out, footprint, rng)
            if spot is None:
                return None
            x, y = spot
        self._placed.append((x, y, keep_out))
        return x, y

    def _draw_from_cells(
        self, wish: Gaussian, keep_out: float, footprint: float, rng: np.random.Generator
    ) -> tuple[float, float] | None:
        cells = self.region.cells
        free = np.hypot(cells[:, 0], cells[:, 1]) + footprint <= self.region.radius
        for x, y, other in self._placed:
            free &= (cells[:, 0] - x) ** 2 + (cells[:, 1] - y) ** 2 >= (keep_out + other) ** 2
        candidates = cells[free]
        if not len(candidates):
            return None
        log_density = wish.log_density(candidates)
        cumulative = np.cumsum(np.exp(log_density - log_density.max()))
        for _ in range(_DRAWS):
            x, y = candidates[np.searchsorted(cumulative, rng.random() * cumulative[-1], side="right")]
            x, y = float(x + (rng.random() - 0.5) * _CELL), float(y + (rng.random() - 0.5) * _CELL)
            if self.is_free(x, y, keep_out, footprint):
                return x, y
        return None
