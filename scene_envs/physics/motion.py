"""Motion of scenes under gravity: a closed form where there is one, PyBullet elsewhere."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scene_envs.physics.collision import Collider, ObjectPairs
from scene_envs.physics.geometry import LibraryGeometry, library_geometry
from scene_envs.physics.placement import Objects
from scene_envs.physics.support import Support
from scene_envs.physics.world import SolverSettings, World
from scene_envs.scene_types import SceneType

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_LOGGER = logging.getLogger(__name__)

_SEGMENT = 0.25
"""Seconds after which settling looks again at which shapes it needs, and whether anything still moves."""
_STILL = 2e-5
"""An object that moved less than this (m, or rad) in a segment has come to rest."""
_TALL = 3
"""Objects on this many others are where the solver's own sinking becomes visible."""
_DOUBT = 6e-4, 3e-3
"""Motion (m) of an object high in a stack that calls for a finer integration before it is believed."""
FINEST = SolverSettings(1.0 / 960.0, 35)
"""What stacks are judged with in doubt: a tower of ten boxes sinks by about half a millimetre."""
_DAMPING = 0.3
"""Fraction of velocity that objects lose per second while they settle."""


class Physics:
    """Everything this process keeps for one asset library.

    Args:
        library: geometry of the assets.
    """

    def __init__(self, library: LibraryGeometry) -> None:
        self.library = library
        self.collider = Collider(library)
        self.support = Support(library)
        self._world: World | None = None

    @property
    def world(self) -> World:
        """The PyBullet world, made on first use; MissingDependencyError without PyBullet."""
        if self._world is None:
            self._world = World(self.library)
        return self._world


_PHYSICS: dict[int, Physics] = {}


def physics_of(scene_type: SceneType) -> Physics:
    """The physics of a scene type's assets, shared within this process."""
    library = library_geometry(scene_type.library.assets)
    if id(library) not in _PHYSICS:
        _PHYSICS[id(library)] = Physics(library)
    return _PHYSICS[id(library)]


def motion(physics: Physics, objects: Objects, pairs: ObjectPairs, duration: float) -> tuple[Array, Array, Index]:
    """How far objects of several scenes move in ``duration`` seconds.

    Args:
        physics: of the scenes' assets.
        objects: the objects.
        pairs: their near pairs.
        duration: s.

    Returns:
        displacement (n,) m, rotation (n,) rad, and the scenes whose simulation diverged.
    """
    resting, displacement, rotation = physics.support.at_rest(objects, pairs.low, pairs.high, duration)
    active = np.flatnonzero(~resting)
    moving, pairs = objects[active], pairs.among(active)
    fine = physics.support.needs_fine(moving, pairs)
    height = physics.support.tallest(moving, pairs)
    lost: list[int] = []
    for scene in np.unique(moving.scene):
        rows = np.flatnonzero(moving.scene == scene)
        if moving.fixed[rows].all():
            continue
        tall = height[rows] >= _TALL
        settings = settings_for(int(height[rows].max()))
        end_rotation, end_translation, angle = physics.world.simulate(moving[rows], fine[rows], duration, settings)
        moved = np.linalg.norm(end_translation - moving.translation[rows], axis=1)
        if settings != FINEST and (tall & (moved > _DOUBT[0]) & (moved < _DOUBT[1])).any():
            # High in a stack, a millimetre may be the integrator's: look again, closer.
            end_rotation, end_translation, angle = physics.world.simulate(moving[rows], fine[rows], duration, FINEST)
            moved = np.linalg.norm(end_translation - moving.translation[rows], axis=1)
        if not (np.isfinite(moved).all() and np.isfinite(end_rotation).all()):
            _LOGGER.warning("the simulation of a scene diverged; its row is invalid")
            lost.append(int(scene))
            continue
        displacement[active[rows]] = moved
        rotation[active[rows]] = angle
    displacement[objects.fixed] = 0.0
    rotation[objects.fixed] = 0.0
    return displacement, rotation, np.array(lost, dtype=np.int64)


def settle_scene(physics: Physics, objects: Objects, duration: float) -> tuple[Array, Array, bool]:
    """Let one scene come to rest: rotation (n, 3, 3), translation (n, 3) m, and whether it stayed finite."""
    rotation, translation = objects.rotation, objects.translation
    remaining = duration
    while remaining > 1e-9 and not objects.fixed.all():
        span = min(_SEGMENT, remaining)
        remaining -= span
        current = Objects(objects.scene, objects.slot, objects.category, rotation, translation, objects.fixed)
        pairs = physics.collider.pairs(current)
        fine = physics.support.needs_fine(current, pairs)
        settings = settings_for(int(physics.support.tallest(current, pairs).max(initial=0)), damping=_DAMPING)
        end_rotation, end_translation, angle = physics.world.simulate(current, fine, span, settings)
        if not (np.isfinite(end_rotation).all() and np.isfinite(end_translation).all()):
            return objects.rotation, objects.translation, False
        free = ~objects.fixed
        moved = np.linalg.norm(end_translation - translation, axis=1)[free].max(initial=0.0)
        rotation = np.where(free[:, None, None], end_rotation, rotation)
        translation = np.where(free[:, None], end_translation, translation)
        if moved < _STILL and angle[free].max(initial=0.0) < _STILL:
            break
    return rotation, translation, True


def settings_for(height: int, damping: float = 0.0) -> SolverSettings:
    """Taller stacks need a finer integration to stand as still as they do in reality.

    Args:
        height: how many objects carry the topmost one.
        damping: fraction of velocity lost per second.
    """
    if height >= 7:
        return replace(FINEST, linear_damping=damping, angular_damping=damping)
    return SolverSettings(1.0 / 480.0, 25 if height < _TALL else 40, damping, damping)
