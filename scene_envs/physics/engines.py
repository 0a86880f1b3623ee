"""Engines: what computes the motion of objects, by name.

What is feasible, ready, at rest or projected is decided once, above the engines. An engine is asked where a cluster of
objects is after some time. Overlaps of CPU engines are the same exact ones (:mod:`scene_envs.physics.collision`); Warp
computes its own, on the device of the scenes.
"""

from __future__ import annotations

import importlib.util
import logging
import threading
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.physics.parts import GRAVITY, LibraryGeometry, angle_between, apply, matrices, quaternions, times
from scene_envs.physics.placement import Budget, Objects

_LOGGER = logging.getLogger(__name__)
ITERATIONS, CONVERGED = 35, 150
"""Iterations of an iterative contact solver per step: the usual number, and the number after which contacts neither
creep nor give way."""
DAMPING = 0.3
"""Fraction of velocity that objects lose per second while they settle."""
LOOK = 12
"""Number of steps between checks for rest."""
STILL_WAY, STILL_ANGLE = 1e-4, 1e-3
"""Objects are at rest when their present speed would take them less far than this (m, rad) in the whole duration."""
NAMES = ("auto", "bullet", "mujoco", "warp")
"""Names that a user can give."""
_MODULES = {"bullet": "pybullet", "mujoco": "mujoco", "warp": "mujoco_warp"}
_INSTALL = {
    "bullet": "pip install pybullet` on Python 3.10 or 3.11, for which it has wheels, or take physics=`mujoco",
    "mujoco": "pip install mujoco",
    "warp": "pip install mujoco-warp",
}


@dataclass(frozen=True, eq=False)
class Moved:
    """Objects after some time."""

    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) m
    angle: Array  # (n,) rad, angle that each object turned

    @property
    def is_finite(self) -> bool:
        """Whether the simulation did not diverge."""
        return bool(np.isfinite(self.rotation).all() and np.isfinite(self.translation).all())


@dataclass(frozen=True)
class Course:
    """How a scene is simulated."""

    budget: Budget  # work that may be spent; a simulation that reaches its limit ends at the poses reached
    tilt: tuple[float, float] = (0.0, 0.0)  # (x, y) angles by which gravity is tilted toward the x and the y axis, rad
    settling: int | None = None  # iterations per step of Bullet's solver in damped motion; None: undamped


class Engine(ABC):
    """What computes motion of the objects of one asset library. Results depend on the arguments alone, bit for bit:
    neither on slots nor on what was simulated before. Threads take turns.
    """

    step: float
    """Length of a step, s."""

    def __init__(self, library: LibraryGeometry) -> None:
        self._library = library
        self._lock = threading.Lock()

    @abstractmethod
    def simulate(self, cluster: Objects, fine: Mask, height: Index, duration: float, course: Course) -> Moved:
        """Where the objects (n,) of one scene are after ``duration`` seconds under gravity.

        Objects that are ``fine`` (n,) collide with their fine parts; ``height`` (n,) others carry each object, one
        above the other. The simulation may end early when all are at rest. Objects that were lost to a numerical
        failure come back as NaN, and fixed ones where they were.
        """

    def fall(self, duration: float) -> tuple[float, float]:
        """Way (m) of an object in free fall in ``duration`` seconds by the engine's steps, in which the speed grows
        first, and its work in units.
        """
        steps = max(1, round(duration / self.step))
        return 0.5 * GRAVITY * self.step**2 * steps * (steps + 1), steps

    def _frames(self, objects: Objects) -> tuple[Array, Array]:
        """Centres of mass (n, 3) m of objects, and quaternions (n, 4), w last, of their principal axes."""
        category, rotation = objects.category, objects.rotation
        position = objects.translation + apply(rotation, self._library.center_of_mass[category])
        return position, quaternions(times(rotation, self._library.axes[category]))

    def _moved(self, category: Index, position: Array, start: Array, end: Array) -> Moved:
        """Objects whose frames, as :meth:`_frames` gives them, turned from ``start`` (n, 4) to ``end`` (n, 4) and are
        at ``position`` (n, 3) m.
        """
        rotation = times(matrices(end), self._library.axes[category].swapaxes(1, 2))
        translation = position - apply(rotation, self._library.center_of_mass[category])
        return Moved(rotation, translation, angle_between(start, end))


def gravity(tilt: tuple[float, float]) -> Array:
    """(3,) m/s^2, tilted by the (x, y) angles (rad)."""
    return GRAVITY * np.array([*np.sin(tilt), -np.cos(np.hypot(*tilt))])  # type: ignore[no-any-return]


def is_installed(name: str) -> bool:
    """Whether the engine ``name`` can be imported."""
    return importlib.util.find_spec(_MODULES[name]) is not None


@cache
def _automatic() -> str:
    """The engine that ``auto`` takes, said once in the log."""
    name, why = "bullet", "PyBullet is installed"
    if not is_installed("bullet"):
        name, why = "mujoco", "PyBullet is not installed; it has wheels for Python 3.10 and 3.11 only"
    _LOGGER.info("physics=auto takes the engine %s: %s", name, why)
    return name


def engine_name(physics: str) -> str:
    """The name of the engine that ``physics`` asks for; ``auto`` takes Bullet where it is installed, else MuJoCo.

    Raises:
        InvalidInputError: there is no engine of this name.
        MissingDependencyError: the engine is not installed.
    """
    if physics not in NAMES:
        raise InvalidInputError(f"physics={physics!r} is no engine; give one of {', '.join(NAMES)}")
    if physics == "auto":
        return _automatic()
    if not is_installed(physics):
        raise MissingDependencyError(
            f"physics={physics} needs {_MODULES[physics]}, which is not installed; "
            f"install it with `{_INSTALL[physics]}`"
        )
    return physics
