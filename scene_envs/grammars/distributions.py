"""Distributions of positions and of turns about the vertical, in the frame of a support."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


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
        """One position (x, y), m."""
        cos, sin, along, across = self._axes
        u, v = along * rng.standard_normal(), across * rng.standard_normal()
        return self.x + cos * u - sin * v, self.y + sin * u + cos * v

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(P,) log density up to a constant, at ``points`` (P, 2); None for a point or a line."""
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
        """One position (x, y), m."""
        return (
            self.x + self.half_x * (2.0 * rng.random() - 1.0),
            self.y + self.half_y * (2.0 * rng.random() - 1.0),
        )

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(P,) 0 inside, minus infinity outside."""
        inside = (np.abs(points[:, 0] - self.x) <= self.half_x) & (np.abs(points[:, 1] - self.y) <= self.half_y)
        return np.where(inside, 0.0, -np.inf)


@dataclass(frozen=True)
class Line:
    """Anywhere on the segment between two points (x, y), m: along a wall, at the edge of a shelf."""

    start: tuple[float, float]
    end: tuple[float, float]

    def draw(self, rng: np.random.Generator) -> tuple[float, float]:
        """One position (x, y), m."""
        t = rng.random()
        return (
            self.start[0] + t * (self.end[0] - self.start[0]),
            self.start[1] + t * (self.end[1] - self.start[1]),
        )

    def log_density(self, points: NDArray[np.float64]) -> None:
        """None: a line has no density in the plane."""
        return None


@dataclass(frozen=True)
class Moved:
    """A distribution in its own frame at (``x``, ``y``) m, turned by ``yaw`` rad."""

    distribution: PositionDistribution
    x: float
    y: float
    yaw: float

    def draw(self, rng: np.random.Generator) -> tuple[float, float]:
        """One position (x, y), m."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.distribution.draw(rng)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """(P,) log density up to a constant, at ``points`` (P, 2)."""
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
