"""Motion of scenes under gravity: a closed form where there is one, PyBullet elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.bullet import SolverSettings, World
from scene_envs.physics.collision import Collider
from scene_envs.physics.parts import LibraryGeometry, library_geometry
from scene_envs.physics.placement import Budget, ObjectPairs, Objects, object_boxes, place
from scene_envs.physics.statics import Rest, Statics, Support, clusters, company
from scene_envs.scene_types import SceneType

_FAR, _MARGIN = 2e-3, 1e-3
"""An object that moved further than ``_FAR`` (m) may have met others, whose boxes are within ``_MARGIN`` (m) of the box
around its way."""
_MEETINGS = 4
"""Largest number of simulations of a scene; each after the first repeats objects that met."""
_TALL = 3
"""Number of carrying objects from which the sinking that the solver itself causes becomes visible."""
_HIGH = 7
"""Number of carrying objects from which stacks are simulated with the finest steps at once."""
_DOUBT = 6e-4, 3e-3
"""Range of motion (m) of an object high in a stack that is simulated again with finer steps."""
ITERATIONS, CONVERGED = 35, 150
"""Solver iterations per step: the usual number, and the number after which contacts neither creep nor give way."""
FINEST = SolverSettings(1.0 / 960.0, ITERATIONS)
"""Settings for stacks in doubt: with them, a tower of ten boxes sinks by about half a millimetre."""
_LONG, _CREEP = 1.0, 1e-2
"""In simulations longer than ``_LONG`` (s), motion below ``_CREEP`` (m) may be creep of the solver. It is simulated
again with ``CONVERGED`` iterations."""
_DAMPING = 0.3
"""Fraction of velocity that objects lose per second while they settle."""
_SEGMENT = 0.25
"""Length (s) of a segment; after each, settling chooses the shapes again and checks whether anything still moves."""
_STILL, _STILL_ANGLE = 5e-5, 5e-4
"""An object that moved less than this (m, rad) in a segment has come to rest."""


class Physics:
    """Collision geometry, tests of support and rest, and simulator of one asset library, kept by this process."""

    def __init__(self, library: LibraryGeometry) -> None:
        self.library = library
        self.collider = Collider(library)
        self.support = Support(library)
        self.statics = Statics(library)

    def rest(self, objects: Objects, pairs: ObjectPairs, duration: float) -> Rest:
        """Objects of some scenes that need no simulation for ``duration`` seconds."""
        contacts = self.collider.contacts(objects, pairs, self.support.differs(objects, pairs))
        return self.statics.at_rest(objects, pairs, contacts, duration)

    @cached_property
    def world(self) -> World:
        """The PyBullet world, made on first use; MissingDependencyError without PyBullet."""
        return World(self.library)


_physics = cache(Physics)


def physics_of(scene_type: SceneType) -> Physics:
    """The physics of a scene type's assets, shared within this process."""
    return _physics(library_geometry(scene_type.library.assets))


@dataclass(frozen=True, eq=False)
class Moved:
    """Objects of one scene after some time."""

    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) m
    angle: Array  # (n,) rad, angle that each object turned

    @property
    def is_finite(self) -> bool:
        """Whether the simulation did not diverge."""
        return bool(np.isfinite(self.rotation).all() and np.isfinite(self.translation).all())


def motion(
    physics: Physics,
    objects: Objects,
    pairs: ObjectPairs,
    duration: float,
    budgets: Sequence[Budget],
    tilt: tuple[float, float] = (0.0, 0.0),
) -> tuple[Array, Array, Index]:
    """Displacement (n,) m and rotation (n,) rad of the objects of several scenes in ``duration`` seconds, and the
    scenes whose simulation diverged or needed more than the units in its budget. ``tilt`` is the (x, y) angles (rad) by
    which gravity is tilted in simulations.
    """
    rest = physics.rest(objects, pairs, duration)
    displacement, rotation = np.abs(rest.rise), rest.tilt.copy()
    lost: list[int] = []
    for scene in np.unique(objects.scene[~(rest.still | objects.fixed)]):
        rows = np.flatnonzero(objects.scene == scene)
        moved = advance(physics, objects[rows], pairs.among(rows), rest[rows], duration, budgets[scene], tilt=tilt)
        if budgets[scene].is_spent or not moved.is_finite:
            lost.append(int(scene))
            continue
        displacement[rows] = np.linalg.norm(moved.translation - objects.translation[rows], axis=1)
        rotation[rows] = moved.angle
    displacement[objects.fixed] = 0.0
    rotation[objects.fixed] = 0.0
    return displacement, rotation, np.array(lost, dtype=np.int64)


def advance(
    physics: Physics,
    objects: Objects,
    pairs: ObjectPairs,
    rest: Rest,
    duration: float,
    budget: Budget,
    *,
    settling: int | None = None,
    tilt: tuple[float, float] = (0.0, 0.0),
) -> Moved:
    """The objects of one scene ``duration`` seconds later, or at the poses reached when ``budget`` is spent.

    Objects at rest get the pose of their closed form; all others are simulated with the objects they touch. When one of
    these reaches an object that was not simulated, or had come to rest and left, the two are simulated again together.
    ``settling`` is the number of solver iterations per step of a damped motion; None simulates undamped, and doubtful
    motion again with other settings. ``tilt`` is as for :func:`motion`.
    """
    translation = objects.translation.copy()
    translation[:, 2] += rest.rise
    moved = Moved(objects.rotation.copy(), translation, rest.tilt.copy())
    chosen = company(objects, pairs, ~(rest.still | objects.fixed))
    group = np.full(len(objects), -1, dtype=np.int64)
    rows = np.flatnonzero(chosen)
    group[rows] = clusters(objects[rows], pairs.low[rows], pairs.high[rows])
    due = chosen
    for _ in range(_MEETINGS):
        left = _simulate(physics, objects, pairs, due, group, duration, moved, budget, settling=settling, tilt=tilt)
        if budget.is_spent or not moved.is_finite:
            break
        hits = _meetings(physics, objects, pairs, due, group, left, moved)
        if hits is None:
            break
        touched = np.zeros(len(objects), dtype=bool)
        touched[np.concatenate(hits)] = True
        touched |= np.isin(group, group[touched & (group >= 0)])
        due = company(objects, pairs, touched)
        due |= np.isin(group, group[due & (group >= 0)])
        # one cluster for all of these few objects; those that were at rest are at rest again
        group[due] = int(group.max()) + 1
    return moved


def _simulate(
    physics: Physics,
    objects: Objects,
    pairs: ObjectPairs,
    due: Mask,
    group: Index,
    duration: float,
    moved: Moved,
    budget: Budget,
    *,
    settling: int | None,
    tilt: tuple[float, float],
) -> Mask:
    """Simulate the objects ``due`` (n,), write their poses into ``moved``, and return those that left early (n,)."""
    left = np.zeros(len(objects), dtype=bool)
    rows = np.flatnonzero(due | objects.fixed)
    among, near = objects[rows], pairs.among(rows)
    fine, height = np.zeros(len(objects), dtype=bool), np.zeros(len(objects), dtype=np.int64)
    fine[rows], height[rows] = physics.support.needs_fine(among, near), physics.support.tallest(among, near)
    tallest = np.zeros(int(group.max()) + 1, dtype=np.int64)
    np.maximum.at(tallest, group[due], height[due])

    def run(members: Mask, settings: SolverSettings) -> None:
        if budget.is_spent:
            return
        if settling is not None:
            settings = SolverSettings(settings.time_step, settling, _DAMPING)
        settings = replace(settings, tilt=tilt)
        rows = np.flatnonzero(objects.fixed | members)
        end = physics.world.simulate(objects[rows], fine[rows], group[rows], duration, settings, budget)
        free = ~objects.fixed[rows]
        moved.rotation[rows[free]], moved.translation[rows[free]] = end[0][free], end[1][free]
        moved.angle[rows[free]], left[rows[free]] = end[2][free], end[3][free]

    for settings in dict.fromkeys(settings_for(int(carriers)) for carriers in tallest[group[due]]):
        run(due & np.array([label >= 0 and settings_for(int(tallest[label])) == settings for label in group]), settings)
    if settling is not None:
        return left
    displacement = np.linalg.norm(moved.translation - objects.translation, axis=1)
    doubtful = due & (height >= _TALL) & (displacement > _DOUBT[0]) & (displacement < _DOUBT[1])
    again = np.unique(group[doubtful])
    again = again[tallest[again] < _HIGH]
    if len(again):  # high in a stack, a millimetre may be an integration error: simulate again with finer steps
        run(due & np.isin(group, again), FINEST)
    if duration > _LONG:
        displacement = np.linalg.norm(moved.translation - objects.translation, axis=1)
        creeping = due & (displacement > _DOUBT[0]) & (displacement < _CREEP)
        if creeping.any():
            run(due & np.isin(group, group[creeping]), replace(settings_for(0), iterations=CONVERGED))
    return left


def _meetings(
    physics: Physics, objects: Objects, pairs: ObjectPairs, due: Mask, group: Index, left: Mask, moved: Moved
) -> tuple[Index, Index] | None:
    """Pairs of objects that met but were not simulated together; the first of each was simulated just now."""
    far = np.linalg.norm(moved.translation - objects.translation, axis=1)
    reach = np.linalg.norm(pairs.high - pairs.low, axis=1)
    movers = np.flatnonzero(due & (far + moved.angle * reach > _FAR))
    others = np.flatnonzero(~objects.fixed)
    if not len(movers) or len(others) < 2:
        return None
    ends = replace(objects[movers], rotation=moved.rotation[movers], translation=moved.translation[movers])
    low, high = object_boxes(place(physics.library, ends, "coarse"))
    low, high = np.minimum(low, pairs.low[movers]) - _MARGIN, np.maximum(high, pairs.high[movers]) + _MARGIN
    meets = (low[:, None] <= pairs.high[others][None]) & (pairs.low[others][None] <= high[:, None])
    first, second = np.nonzero(meets.all(axis=2))
    first, second = movers[first], others[second]
    apart = (group[first] != group[second]) | (group[second] < 0)
    first, second = first[apart], second[apart]
    if not ((group[second] < 0) | left[second] | ~due[second]).any():
        return None
    return first, second


def settings_for(height: int) -> SolverSettings:
    """Solver settings of a stack whose topmost object stands on ``height`` others: taller stacks get finer steps."""
    return FINEST if height >= _HIGH else SolverSettings(1.0 / 480.0, ITERATIONS)


def settle_scene(
    physics: Physics,
    objects: Objects,
    pairs: ObjectPairs,
    duration: float,
    iterations: int,
    bottom: float,
    budget: Budget,
) -> tuple[Array, Array, bool]:
    """Let one scene come to rest: rotation (n, 3, 3), translation (n, 3) m, and whether they stayed finite. This takes
    at most ``duration`` seconds. Objects below the height ``bottom`` (m) are simulated no further, and when ``budget``
    is spent, all stay at the poses reached.
    """
    current = objects
    calm = np.zeros(len(objects), dtype=bool)  # was simulated, and did not move
    remaining = duration
    while remaining > 1e-9 and not budget.is_spent:
        span = min(_SEGMENT, remaining)
        remaining -= span
        rest = physics.rest(current, pairs, span)
        active = ~(rest.still | current.fixed)
        fallen = active & (current.translation[:, 2] < bottom)
        done = fallen | active & ~company(current, pairs, active & ~calm & ~fallen)
        rest = Rest(rest.still | done, rest.rise, rest.tilt)
        if not (active & ~done).any() and (np.abs(rest.rise) < _STILL).all():
            break
        moved = advance(physics, current, pairs, rest, span, budget, settling=iterations)
        if not moved.is_finite:
            return objects.rotation, objects.translation, False
        far = np.linalg.norm(moved.translation - current.translation, axis=1)
        calm = (far < _STILL) & (moved.angle < _STILL_ANGLE)
        current = replace(current, rotation=moved.rotation, translation=moved.translation)
        if remaining > 1e-9 and not budget.is_spent:
            pairs = physics.collider.pairs(current)
    return current.rotation, current.translation, True
