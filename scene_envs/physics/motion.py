"""Motion of scenes under gravity: a closed form where there is one, an engine's simulation elsewhere."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import Collider, scene_pairs
from scene_envs.physics.engines import Course, Engine, Moved
from scene_envs.physics.mujoco import MujocoEngine
from scene_envs.physics.parts import GRAVITY, LibraryGeometry, library_geometry
from scene_envs.physics.placement import Budget, ObjectPairs, Objects, components, object_boxes, place
from scene_envs.physics.statics import Rest, Statics, clusters, company
from scene_envs.scene_types import SceneType

_FAR, _MARGIN = 2e-3, 1e-3
"""An object that moved further than ``_FAR`` (m) may have met others, whose boxes are within ``_MARGIN`` (m) of the box
around its way."""
_MEETINGS = 4
"""Largest number of simulations of a scene; each after the first repeats objects that met."""
_REACH = 0.05
"""Fixed objects further than this (m) plus the height of free fall from a cluster are left out of its simulation."""
_KNOWN = 4096
"""Simulations of clusters that are remembered: trials of readiness and searches repeat those of objects that stay."""
_SEGMENT = 0.25
"""Length (s) of a segment; after each, settling chooses the shapes again and checks whether anything still moves."""
_EXACT = 1e-7
"""Objects this close (m) to where they rest stay where they are while a scene settles."""
_STILL, _STILL_ANGLE = 5e-5, 5e-4
"""An object that moved less than this (m, rad) in a segment has come to rest."""


class Physics:
    """Collision geometry, tests of support and rest, and the engine of one asset library, kept by this process."""

    def __init__(self, library: LibraryGeometry, engine: str) -> None:
        self.library = library
        self.engine: Engine
        if engine == "bullet":
            from scene_envs.physics.bullet import BulletEngine

            self.engine = BulletEngine(library)
        else:  # for Warp, too, which simulates whole batches
            self.engine = MujocoEngine(library)
        self.collider = Collider(library)
        self.statics = Statics(self.collider)
        self._known: dict[bytes, tuple[Moved, float]] = {}
        self._lock = threading.Lock()

    def rest(self, objects: Objects, pairs: ObjectPairs, duration: float) -> Rest:
        """Objects of some scenes that need no simulation for ``duration`` seconds."""
        contacts = self.collider.contacts(objects, pairs, self.statics.differs(objects, pairs))
        return self.statics.at_rest(objects, pairs, contacts, duration)

    def simulate(self, cluster: Objects, fine: Mask, height: Index, duration: float, course: Course) -> Moved:
        """As the engine's own; a cluster that was simulated alike a short time ago is not simulated again. Its work
        counts in the budget all the same, so results do not depend on what was simulated before.
        """
        facts = cluster.category, cluster.rotation, cluster.translation, cluster.fixed, fine, height
        setting = np.array([duration, *course.tilt, -1 if course.settling is None else course.settling])
        key = b"".join(np.ascontiguousarray(values).tobytes() for values in (*facts, setting))
        with self._lock:
            moved, spent = self._known.pop(key, (None, 0.0))
            if moved is not None:
                self._known[key] = moved, spent  # the last used one is the last
        if moved is not None and course.budget.spent + spent < course.budget.limit:
            course.budget.spent += spent
            return moved
        before = course.budget.spent
        moved = self.engine.simulate(cluster, fine, height, duration, course)
        if not course.budget.is_spent and moved.is_finite:
            with self._lock:
                self._known[key] = moved, course.budget.spent - before
                if len(self._known) > _KNOWN:
                    del self._known[next(iter(self._known))]
        return moved


_physics = cache(Physics)


def physics_of(scene_type: SceneType, engine: str) -> Physics:
    """The physics of a scene type's assets with an engine, shared within this process."""
    return _physics(library_geometry(scene_type.library.assets), engine)


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
    if tilt == (0.0, 0.0):
        way, units = physics.engine.fall(duration)
        loose, struck = _falls(physics.collider, objects, pairs, rest, way)
        for scene in objects.scene[loose]:
            budgets[scene].spent += units
        rest = Rest((rest.still | loose) & ~struck, np.where(loose, -way, rest.rise), rest.tilt)
    displacement, rotation = np.abs(rest.rise), rest.tilt.copy()
    lost: list[int] = []
    for scene in np.unique(objects.scene[~(rest.still | objects.fixed)]):
        rows = np.flatnonzero(objects.scene == scene)
        course = Course(budgets[scene], tilt=tilt)
        moved = advance(physics, objects[rows], pairs.among(rows), rest[rows], duration, course)
        if budgets[scene].is_spent or not moved.is_finite:
            lost.append(int(scene))
            continue
        displacement[rows] = np.linalg.norm(moved.translation - objects.translation[rows], axis=1)
        rotation[rows] = moved.angle
    displacement[objects.fixed] = 0.0
    rotation[objects.fixed] = 0.0
    return displacement, rotation, np.array(lost, dtype=np.int64)


def _falls(collider: Collider, objects: Objects, pairs: ObjectPairs, rest: Rest, way: float) -> tuple[Mask, Mask]:
    """(n,) objects of some scenes that fall freely by ``way`` (m) and meet nothing, and (n,) objects at rest onto which
    others fall.
    """
    falling = ~(rest.still | objects.fixed)
    close = [rows[pairs.gap < _MARGIN] for rows in (pairs.first, pairs.second)]
    _spread(falling, *close)
    loose, struck = falling.copy(), np.zeros(len(objects), dtype=bool)
    if not falling.any():
        return loose, struck
    touching = pairs.depth > 0
    loose[pairs.first[touching]] = loose[pairs.second[touching]] = False
    _spread(loose, *close)
    first, second = scene_pairs(objects)
    first, second = (rows[falling[first] | falling[second]] for rows in (first, second))
    first, second = collider.may_meet(objects, pairs, first, second, np.outer(falling, (0.0, 0.0, -way)), _MARGIN)
    struck[first[~falling[first]]] = struck[second[~falling[second]]] = True
    _spread(loose, first, second)
    return loose, struck & rest.still


def _spread(chosen: Mask, first: Index, second: Index) -> None:
    """Remove from ``chosen`` (n,), in place, all that are linked to others by pairs (P,), (P,)."""
    while (lost := chosen[first] != chosen[second]).any():
        chosen[first[lost]] = chosen[second[lost]] = False


def advance(
    physics: Physics, objects: Objects, pairs: ObjectPairs, rest: Rest, duration: float, course: Course
) -> Moved:
    """The objects of one scene ``duration`` seconds later, or at the poses reached when the budget is spent.

    Objects at rest get the pose of their closed form. All others are simulated in clusters of objects near each other,
    each with the fixed objects that it can reach. When an object reaches one of another cluster, or one that was not
    simulated, the two are simulated again together.
    """
    translation = objects.translation.copy()
    translation[:, 2] += rest.rise
    moved = Moved(objects.rotation.copy(), translation, rest.tilt.copy())
    due = company(objects, pairs, ~(rest.still | objects.fixed))
    group = np.full(len(objects), -1, dtype=np.int64)
    rows = np.flatnonzero(due)
    group[rows] = clusters(objects[rows], pairs.low[rows], pairs.high[rows])
    whole = np.zeros(len(objects), dtype=bool)  # simulated with all fixed objects
    for _ in range(_MEETINGS):
        left_out = _simulate(physics, objects, pairs, due, group, whole, duration, moved, course)
        if course.budget.is_spent or not moved.is_finite:
            break
        first, second = _meetings(physics, objects, pairs, due, group, left_out, moved)
        if not len(first):
            break
        whole[first[objects.fixed[second]]] = True
        touched = np.zeros(len(objects), dtype=bool)
        touched[first] = touched[second] = True
        touched &= ~objects.fixed
        touched |= np.isin(group, group[touched & (group >= 0)])
        due = company(objects, pairs, touched)
        due |= np.isin(group, group[due & (group >= 0)])
        whole[due] = whole[due].any()
        group = _joined(objects, pairs, due, group, first, second)
    return moved


def _joined(objects: Objects, pairs: ObjectPairs, due: Mask, group: Index, first: Index, second: Index) -> Index:
    """``group`` (n,) with new numbers for the clusters of the objects ``due`` (n,): those of one old cluster, pairs
    that met (Q,), (Q,), and objects near each other are together.
    """
    members = np.flatnonzero(due & (group >= 0))
    _, leading, old = np.unique(group[members], return_index=True, return_inverse=True)
    near = due[pairs.first] & due[pairs.second]
    met = due[first] & due[second]
    one = np.concatenate([members, pairs.first[near], first[met]])
    other = np.concatenate([members[leading][old], pairs.second[near], second[met]])
    return np.where(due, components(len(objects), one, other) + int(group.max()) + 1, group)


def _simulate(
    physics: Physics,
    objects: Objects,
    pairs: ObjectPairs,
    due: Mask,
    group: Index,
    whole: Mask,
    duration: float,
    moved: Moved,
    course: Course,
) -> Mask:
    """Simulate the clusters of the objects ``due`` (n,), and write their poses into ``moved``. Returns the pairs (n, n)
    of an object and a fixed one that was left out of its simulation, as too far away; no object ``whole`` (n,) has any.
    """
    left_out = np.zeros((len(objects), len(objects)), dtype=bool)
    rows = np.flatnonzero(due | objects.fixed)
    among, near = objects[rows], pairs.among(rows)
    fine, height = np.zeros(len(objects), dtype=bool), np.zeros(len(objects), dtype=np.int64)
    fine[rows], height[rows] = physics.statics.needs_fine(among, near), physics.statics.tallest(among, near)
    reach = _REACH + 0.5 * GRAVITY * duration**2
    for label in np.unique(group[due]):
        if course.budget.is_spent:
            break
        members = due & (group == label)
        low, high = pairs.low[members].min(axis=0) - reach, pairs.high[members].max(axis=0) + reach
        close = objects.fixed & (whole[members].any() | ((pairs.low <= high) & (pairs.high >= low)).all(axis=1))
        left_out[np.ix_(members, objects.fixed & ~close)] = True
        rows = np.flatnonzero(members | close)
        end = physics.simulate(objects[rows], fine[rows], height[rows], duration, course)
        free = ~objects.fixed[rows]
        moved.rotation[rows[free]], moved.translation[rows[free]] = end.rotation[free], end.translation[free]
        moved.angle[rows[free]] = end.angle[free]
    return left_out


def _meetings(
    physics: Physics, objects: Objects, pairs: ObjectPairs, due: Mask, group: Index, left_out: Mask, moved: Moved
) -> tuple[Index, Index]:
    """Pairs of objects that met but were not simulated together; the first of each was simulated just now. ``left_out``
    (n, n) are the pairs of an object and a fixed one that was left out of its simulation.
    """
    far = np.linalg.norm(moved.translation - objects.translation, axis=1)
    reach = np.linalg.norm(pairs.high - pairs.low, axis=1)
    movers = np.flatnonzero(due & (far + moved.angle * reach > _FAR))
    if not len(movers):
        return movers, movers
    ends = replace(objects[movers], rotation=moved.rotation[movers], translation=moved.translation[movers])
    low, high = object_boxes(place(physics.library, ends, "coarse"))
    low, high = np.minimum(low, pairs.low[movers]) - _MARGIN, np.maximum(high, pairs.high[movers]) + _MARGIN
    meets = ((low[:, None] <= pairs.high[None]) & (pairs.low[None] <= high[:, None])).all(axis=2)
    apart = (group[movers][:, None] != group[None]) | (group[None] < 0)
    first, second = np.nonzero(meets & np.where(objects.fixed[None], left_out[movers], apart))
    first, way = movers[first], moved.translation - objects.translation
    turned = (moved.angle * reach)[first] > _MARGIN
    met = physics.collider.may_meet(objects, pairs, first[~turned], second[~turned], way, 2 * _MARGIN)
    return np.concatenate([first[turned], met[0]]), np.concatenate([second[turned], met[1]])


def settle_scene(
    physics: Physics,
    objects: Objects,
    pairs: ObjectPairs,
    duration: float,
    bottom: float,
    course: Course,
    calm: Mask | None = None,
) -> tuple[Array, Array, bool]:
    """Let one scene come to rest: rotation (n, 3, 3), translation (n, 3) m, and whether they stayed finite. This takes
    at most ``duration`` seconds. Objects below the height ``bottom`` (m) are simulated no further, and when the budget
    is spent, all stay at the poses reached. Objects that are ``calm`` (n,) stand still unless others reach them.
    """
    current = objects
    calm = np.zeros(len(objects), dtype=bool) if calm is None else calm  # was simulated, and did not move
    remaining = duration
    while remaining > 1e-9 and not course.budget.is_spent:
        span = min(_SEGMENT, remaining)
        remaining -= span
        rest = physics.rest(current, pairs, span)
        active = ~(rest.still | current.fixed)
        fallen = active & (current.translation[:, 2] < bottom)
        done = fallen | active & ~company(current, pairs, active & ~calm & ~fallen)
        rest = Rest(rest.still | done, np.where(np.abs(rest.rise) < _EXACT, 0.0, rest.rise), rest.tilt)
        if not (active & ~done).any() and (np.abs(rest.rise) < _STILL).all():
            break
        moved = advance(physics, current, pairs, rest, span, course)
        if not moved.is_finite:
            return objects.rotation, objects.translation, False
        far = np.linalg.norm(moved.translation - current.translation, axis=1)
        calm = (far < _STILL) & (moved.angle < _STILL_ANGLE)
        current = replace(current, rotation=moved.rotation, translation=moved.translation)
        if remaining > 1e-9 and not course.budget.is_spent:
            pairs = physics.collider.pairs(current)
    return current.rotation, current.translation, True
