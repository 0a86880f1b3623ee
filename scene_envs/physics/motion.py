"""Motion of scenes under gravity: a closed form where there is one, PyBullet elsewhere."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scene_envs.physics.collision import Collider, ObjectPairs
from scene_envs.physics.geometry import LibraryGeometry, library_geometry
from scene_envs.physics.placement import Objects
from scene_envs.physics.support import Support, clusters
from scene_envs.physics.world import SolverSettings, World
from scene_envs.scene_types import SceneType

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_LOGGER = logging.getLogger(__name__)

_SEGMENT = 0.25
"""Seconds after which settling looks again at which shapes it needs, and whether anything still moves."""
_ROOM = 0.05
"""Objects further apart than this (m) sideways do not meet within a segment of settling."""
_STILL, _STILL_ANGLE = 5e-5, 5e-4
"""An object that moved less than this (m, rad) in a segment has come to rest."""
_TALL = 3
"""Objects on this many others are where the solver's own sinking becomes visible."""
_HIGH = 7
"""Objects on this many others are judged with the finest steps at once."""
_DOUBT = 6e-4, 3e-3
"""Motion (m) of an object high in a stack that calls for a finer integration before it is believed."""
FINEST = SolverSettings(1.0 / 960.0, 35)
"""What stacks are judged with in doubt: a tower of ten boxes sinks by about half a millimetre."""
_DAMPING = 0.3
"""Fraction of velocity that objects lose per second while they settle. Coarser steps do not pay here: with 1/240 s
jittered Dimsum scenes took 1.4 times as long to come to rest, and 1.5 % of objects were not ready afterwards."""


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
    group = clusters(moving, pairs.low, pairs.high, duration)
    lost: list[int] = []
    for scene in np.unique(moving.scene):
        rows = np.flatnonzero(moving.scene == scene)
        if moving.fixed[rows].all():
            continue
        moved, angle = _move(physics, moving[rows], fine[rows], group[rows], height[rows], duration)
        if not (np.isfinite(moved).all() and np.isfinite(angle).all()):
            _LOGGER.warning("the simulation of a scene diverged; its row is invalid")
            lost.append(int(scene))
            continue
        displacement[active[rows]] = moved
        rotation[active[rows]] = angle
    displacement[objects.fixed] = 0.0
    rotation[objects.fixed] = 0.0
    return displacement, rotation, np.array(lost, dtype=np.int64)


def _move(
    physics: Physics, objects: Objects, fine: Mask, group: Index, height: Index, duration: float
) -> tuple[Array, Array]:
    """Displacement (n,) m and rotation (n,) rad of one scene's objects, each cluster with the steps it needs."""
    displacement, rotation = np.zeros(len(objects)), np.zeros(len(objects))
    tallest = np.zeros(int(group.max()) + 1, dtype=np.int64)
    np.maximum.at(tallest, group[~objects.fixed], height[~objects.fixed])

    def run(chosen: Mask, settings: SolverSettings) -> None:
        rows = np.flatnonzero(objects.fixed | chosen)
        end = physics.world.simulate(objects[rows], fine[rows], group[rows], duration, settings)
        displacement[rows] = np.linalg.norm(end[1] - objects.translation[rows], axis=1)
        rotation[rows] = end[2]

    for settings in dict.fromkeys(settings_for(int(carriers)) for carriers in tallest[group[~objects.fixed]]):
        run(np.array([label >= 0 and settings_for(int(tallest[label])) == settings for label in group]), settings)
    doubtful = (height >= _TALL) & (displacement > _DOUBT[0]) & (displacement < _DOUBT[1])
    again = np.unique(group[doubtful & ~objects.fixed])
    again = again[tallest[again] < _HIGH]
    if len(again):  # high in a stack, a millimetre may be the integrator's: look again, closer
        run(np.isin(group, again), FINEST)
    return displacement, rotation


def settle_scene(physics: Physics, objects: Objects, duration: float) -> tuple[Array, Array, bool]:
    """Let one scene come to rest: rotation (n, 3, 3), translation (n, 3) m, and whether it stayed finite."""
    rotation, translation = objects.rotation.copy(), objects.translation.copy()
    at_rest = objects.fixed.copy()
    remaining = duration
    while remaining > 1e-9 and not at_rest.all():
        span = min(_SEGMENT, remaining)
        remaining -= span
        current = Objects(objects.scene, objects.slot, objects.category, rotation, translation, objects.fixed)
        pairs = physics.collider.pairs(current)
        group = clusters(current, pairs.low, pairs.high, span, sideways=_ROOM)
        awake = np.isin(group, group[~at_rest])
        rows = np.flatnonzero(awake | objects.fixed)
        moving, pairs = current[rows], pairs.among(rows)
        fine = physics.support.needs_fine(moving, pairs)
        settings = settings_for(int(physics.support.tallest(moving, pairs).max(initial=0)))
        settings = replace(settings, linear_damping=_DAMPING, angular_damping=_DAMPING)
        end_rotation, end_translation, angle = physics.world.simulate(moving, fine, group[rows], span, settings)
        if not (np.isfinite(end_rotation).all() and np.isfinite(end_translation).all()):
            return objects.rotation, objects.translation, False
        moved = np.linalg.norm(end_translation - translation[rows], axis=1)
        at_rest[rows] = objects.fixed[rows] | ((moved < _STILL) & (angle < _STILL_ANGLE))
        free = ~objects.fixed[rows]
        rotation[rows[free]], translation[rows[free]] = end_rotation[free], end_translation[free]
    return rotation, translation, True


def settings_for(height: int) -> SolverSettings:
    """Taller stacks need a finer integration to stand as still as they do in reality.

    Args:
        height: how many objects carry the topmost one.
    """
    return FINEST if height >= _HIGH else SolverSettings(1.0 / 480.0, 35)
