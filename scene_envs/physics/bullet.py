"""PyBullet: bodies of an asset library, and the simulation of one scene with them."""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from scene_envs.arrays import Array, Index, Mask
from scene_envs.errors import PhysicsError
from scene_envs.physics.engines import (
    CONVERGED,
    DAMPING,
    ITERATIONS,
    LOOK,
    STILL_ANGLE,
    STILL_WAY,
    Course,
    Engine,
    Moved,
    gravity,
)
from scene_envs.physics.parts import FRICTION, LevelGeometry, LibraryGeometry, inset_hull
from scene_envs.physics.placement import Objects
from scene_envs.progress import quiet_pybullet

BodyKey = tuple[int, str]
"""Asset category and level of detail ("fine" or "coarse") of a body."""

SCALE = 20.0
"""Bullet length units per metre. Bullet grows each convex mesh by 0.001 units and rounds its edges by as much. With one
unit per metre this would be 1 mm; with this scale it is 0.05 mm. Times and masses are not scaled; gravity and inertia
are scaled to match."""
MARGIN = 1e-3 / SCALE
"""Margin (m) that Bullet adds to each convex mesh. Hulls are shrunk by it, so that they act at their true size."""

_PARKING = 1000.0
"""Height (Bullet units) of the first parked body; the next ones are above it."""
_PARKING_STEP = 10.0 * SCALE
_SPARE_BODIES = 32
_SPARE_FACTOR = 3
"""A pool is built again when it has more bodies than this many times the bodies that a scene needs, plus
``_SPARE_BODIES``: in every step Bullet compares the boxes of all bodies, including parked ones."""
_ZERO = (0.0, 0.0, 0.0)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)
_USUAL_STEP, _FINEST_STEP = 1.0 / 480.0, 1.0 / 960.0
"""Lengths of a step (s): the usual one, and that for stacks in doubt, in which a tower of ten boxes sinks by about half
a millimetre."""
_TALL = 3
"""Number of carrying objects from which the sinking that the solver itself causes becomes visible."""
_HIGH = 7
"""Number of carrying objects from which stacks are simulated with the finest steps at once."""
_DOUBT = 6e-4, 3e-3
"""Range of motion (m) of an object high in a stack that is simulated again with finer steps."""
_LONG, _CREEP = 1.0, 1e-2
"""In simulations longer than ``_LONG`` (s), motion below ``_CREEP`` (m) may be creep of the solver. It is simulated
again with ``CONVERGED`` iterations."""


class BodyPool:
    """Bodies of one asset library in a PyBullet client of their own.

    The motion of a scene is independent of the scenes before it for two reasons: the broadphase is Bullet's simple one,
    which keeps no tree and lists pairs in the order of the bodies; and a body that is placed or parked gets a fresh
    proxy, which drops its pairs, contacts and warm starts. Raises MissingDependencyError without pybullet, and
    PhysicsError without a free client slot.
    """

    def __init__(self, library: LibraryGeometry) -> None:
        self.bullet = quiet_pybullet(
            "settling and equilibrium need pybullet, whose wheels exist for Python 3.10 and 3.11; "
            "install it there with: pip install pybullet"
        )
        self.client: int = self.bullet.connect(self.bullet.DIRECT)
        if self.client < 0:
            raise PhysicsError("PyBullet has no free client slot; close clients that are no longer used")
        self._library = library
        self._bodies: dict[BodyKey, list[int]] = {}
        self._parking: dict[int, tuple[float, float, float]] = {}
        self._wavefronts: dict[BodyKey, str] = {}

    def take(self, needed: Mapping[BodyKey, int]) -> dict[BodyKey, list[int]]:
        """The first ``needed[key]`` parked bodies of each key, whatever calls came before; may raise PhysicsError."""
        have = sum(len(bodies) for bodies in self._bodies.values())
        missing = any(len(self._bodies.get(key, ())) < count for key, count in needed.items())
        if missing or have > _SPARE_FACTOR * sum(needed.values()) + _SPARE_BODIES:
            sizes = {key: len(bodies) for key, bodies in self._bodies.items()} if missing else {}
            self._build({key: max(sizes.get(key, 0), needed.get(key, 0)) for key in {*sizes, *needed}})
        return {key: self._bodies[key][:count] for key, count in needed.items()}

    def place(self, body: int, position: Sequence[float], quaternion: Sequence[float]) -> None:
        """Put a body at a position (Bullet units) and orientation, at rest, with a fresh broadphase proxy."""
        bullet, client = self.bullet, self.client
        bullet.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)
        bullet.resetBaseVelocity(body, _ZERO, _ZERO, physicsClientId=client)
        bullet.setCollisionFilterGroupMask(body, -1, 1, 1, physicsClientId=client)

    def wake(self, body: int, category: int, quaternion: Sequence[float], *, fixed: bool, damping: float) -> None:
        """Turn a parked body to its orientation and give it the dynamics of the coming simulation."""
        bullet, client = self.bullet, self.client
        bullet.resetBasePositionAndOrientation(body, self._parking[body], quaternion, physicsClientId=client)
        if self._library.static[category]:
            return
        bullet.resetBaseVelocity(body, _ZERO, _ZERO, physicsClientId=client)
        bullet.changeDynamics(
            body,
            -1,
            mass=0.0 if fixed else float(self._library.mass[category]),
            localInertiaDiagonal=_ZERO if fixed else self._inertia(category),
            linearDamping=damping,
            angularDamping=damping,
            activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )

    def park(self, body: int, category: int) -> None:
        """Take a body out of the scene."""
        self.place(body, self._parking[body], _UPRIGHT)
        if not self._library.static[category]:
            self.bullet.changeDynamics(
                body, -1, activationState=self.bullet.ACTIVATION_STATE_SLEEP, physicsClientId=self.client
            )

    def clear(self) -> None:
        """Drop all bodies; the next :meth:`take` builds those that it needs."""
        self._bodies = {}

    def _build(self, sizes: Mapping[BodyKey, int]) -> None:
        bullet, client = self.bullet, self.client
        self.clear()  # an interrupt below must leave no ids of bodies that are gone
        bullet.resetSimulation(flags=bullet.RESET_USE_SIMPLE_BROADPHASE, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            numSubSteps=0,
            contactBreakingThreshold=2e-3 * SCALE,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            solverResidualThreshold=0.0,
            # Overlaps within the limits close in 20 ms. With a larger value, fruit that is pushed out keeps rolling.
            contactERP=0.1,
            physicsClientId=client,
        )
        # A shared small visual: without one PyBullet would read the collision mesh again for every body.
        visual = bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=(1e-3, 1e-3, 1e-3), physicsClientId=client)
        bodies: dict[BodyKey, list[int]] = {}
        self._parking = {}
        with tempfile.TemporaryDirectory() as folder:
            for key in sorted(sizes):  # the same order in every process
                shape = self._shape(key, Path(folder))
                bodies[key] = []
                for _ in range(sizes[key]):
                    place = (0.0, 0.0, _PARKING + _PARKING_STEP * len(self._parking))
                    body = self._body(key[0], shape, visual, place)
                    self._parking[body] = place
                    bodies[key].append(body)
        self._bodies = bodies

    def _shape(self, key: BodyKey, folder: Path) -> int:
        """Collision shape of an asset: a compound of its convex parts, about the centre of mass, from a file."""
        category, level = key
        if key not in self._wavefronts:
            geometry: LevelGeometry = getattr(self._library.assets[category], level)
            axes, center = self._library.axes[category], self._library.center_of_mass[category]
            self._wavefronts[key] = _wavefront(
                [SCALE * (inset_hull(part, MARGIN) - center) @ axes for part in geometry.parts]
            )
        path = folder / f"{category}-{level}.obj"
        path.write_text(self._wavefronts[key])
        shape = int(
            self.bullet.createCollisionShape(self.bullet.GEOM_MESH, fileName=str(path), physicsClientId=self.client)
        )
        if shape < 0:
            name = self._library.assets[category].asset.name
            raise PhysicsError(f"PyBullet refused the collision shape of asset {name!r} ({level} parts)")
        return shape

    def _inertia(self, category: int) -> list[float]:
        return (SCALE**2 * self._library.moments[category]).tolist()  # type: ignore[no-any-return]

    def _body(self, category: int, shape: int, visual: int, place: tuple[float, float, float]) -> int:
        static = bool(self._library.static[category])
        mass = 0.0 if static else float(self._library.mass[category])
        body = self.bullet.createMultiBody(
            mass, shape, visual, basePosition=place, useMaximalCoordinates=True, physicsClientId=self.client
        )
        if body < 0:
            raise PhysicsError(f"PyBullet could not create a body for asset category {category}")
        # Bullet multiplies the friction coefficients of the two bodies.
        settings: dict[str, Any] = {"lateralFriction": math.sqrt(FRICTION), "restitution": 0.0}
        if not static:
            # Mass and inertia are set in one call: setting the inertia alone would reset the mass.
            settings |= {"mass": mass, "localInertiaDiagonal": self._inertia(category)}
            settings["activationState"] = self.bullet.ACTIVATION_STATE_SLEEP
        self.bullet.changeDynamics(body, -1, physicsClientId=self.client, **settings)
        return int(body)


def _wavefront(hulls: list[Array]) -> str:
    """A Wavefront file with one group per hull (V, 3); Bullet makes a compound of them."""
    lines: list[str] = []
    offset = 1
    for index, vertices in enumerate(hulls):
        lines.append(f"o hull{index}")
        lines.extend(f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices)
        lines.extend(f"f {a + offset} {b + offset} {c + offset}" for a, b, c in ConvexHull(vertices).simplices)
        offset += len(vertices)
    return "\n".join(lines) + "\n"


class BulletEngine(Engine):
    """PyBullet. Bodies are sorted, placed and parked in an order that does not depend on the slots, and never sleep. A
    call that is interrupted leaves no bodies behind. Raises as :class:`BodyPool`.
    """

    step = _USUAL_STEP

    @cached_property
    def _pool(self) -> BodyPool:
        """Bodies, made on first use: depths need no PyBullet."""
        return BodyPool(self._library)

    def simulate(self, cluster: Objects, fine: Mask, height: Index, duration: float, course: Course) -> Moved:
        """See :class:`~scene_envs.physics.engines.Engine`. Motion that the solver itself may have caused, high in a
        stack or as creep in a long simulation, is computed again with finer steps or more iterations.
        """
        free = ~cluster.fixed
        tallest = int(height[free].max(initial=0))
        step = _FINEST_STEP if tallest >= _HIGH else _USUAL_STEP
        if course.settling is not None:
            return self._run(cluster, fine, duration, course, step, course.settling)
        moved = self._run(cluster, fine, duration, course, step, ITERATIONS)
        way = np.linalg.norm(moved.translation - cluster.translation, axis=1)
        doubtful = free & (height >= _TALL) & (way > _DOUBT[0]) & (way < _DOUBT[1])
        if doubtful.any() and step != _FINEST_STEP and not course.budget.is_spent:
            moved = self._run(cluster, fine, duration, course, _FINEST_STEP, ITERATIONS)
            way = np.linalg.norm(moved.translation - cluster.translation, axis=1)
        creeping = free & (way > _DOUBT[0]) & (way < _CREEP)
        if duration > _LONG and creeping.any() and not course.budget.is_spent:
            moved = self._run(cluster, fine, duration, course, _USUAL_STEP, CONVERGED)
        return moved

    def _run(
        self, cluster: Objects, fine: Mask, duration: float, course: Course, step: float, iterations: int
    ) -> Moved:
        """One simulation in steps of length ``step`` (s), each of some iterations of the sequential-impulse solver."""
        with self._lock:
            try:
                return self._simulate(cluster, fine, duration, course, step, iterations)
            except BaseException:  # an interrupt too: bodies that are not parked would meet those of later clusters
                self._pool.clear()
                raise

    def _simulate(
        self, cluster: Objects, fine: Mask, duration: float, course: Course, step: float, iterations: int
    ) -> Moved:
        bullet, client = self._pool.bullet, self._pool.client
        category, fixed, free = cluster.category, cluster.fixed, np.flatnonzero(~cluster.fixed)
        position, quaternion = self._frames(cluster)
        position *= SCALE
        bodies, order = self._bodies(cluster, fine)
        for row in order:
            place = int(bodies[row]), int(category[row]), quaternion[row].tolist()
            self._pool.wake(*place, fixed=bool(fixed[row]), damping=0.0 if course.settling is None else DAMPING)
        # After waking: Bullet sets the gravity of active bodies only.
        bullet.setGravity(*(SCALE * gravity(course.tilt)).tolist(), physicsClientId=client)
        # Bullet refreshes a body's world inertia only when it integrates. Some steps out of contact do that.
        steps = max(1, round(duration / step))
        for _ in range(2 + steps % 2):
            bullet.stepSimulation(physicsClientId=client)
        for row in order:
            self._pool.place(int(bodies[row]), position[row].tolist(), quaternion[row].tolist())
        bullet.setPhysicsEngineParameter(fixedTimeStep=step, numSolverIterations=iterations, physicsClientId=client)
        done = 0
        while done < steps:
            ahead = min(LOOK, steps - done)
            for _ in range(ahead):
                bullet.stepSimulation(physicsClientId=client)
            done += ahead
            course.budget.spent += ahead * len(free) * iterations / ITERATIONS
            if done < steps and (course.budget.is_spent or self._is_still(bodies[free], duration)):
                for _ in range((steps - done) % 2):  # the number of all steps is always even
                    bullet.stepSimulation(physicsClientId=client)
                break
        end_position, end_quaternion = position.copy(), quaternion.copy()
        for row in free.tolist():
            end_position[row], end_quaternion[row] = bullet.getBasePositionAndOrientation(
                int(bodies[row]), physicsClientId=client
            )
        for row in order:
            self._pool.park(int(bodies[row]), int(category[row]))
        moved = self._moved(category, end_position / SCALE, quaternion, end_quaternion)
        if not moved.is_finite:
            self._pool.clear()
        return moved

    def _bodies(self, objects: Objects, fine: Mask) -> tuple[Index, Index]:
        """A body (n,) for each object, and the order (n,) in which to treat them."""
        x, y, z = objects.translation.T
        order = np.lexsort((x, y, z, fine, objects.category))
        keys: list[BodyKey] = [
            (int(category), "fine" if is_fine else "coarse")
            for category, is_fine in zip(objects.category, fine, strict=True)
        ]
        parked = {key: iter(bodies) for key, bodies in self._pool.take(Counter(keys)).items()}
        bodies = np.empty(len(objects), dtype=np.int64)
        for row in order:
            bodies[row] = next(parked[keys[row]])
        return bodies, order

    def _is_still(self, bodies: Index, duration: float) -> bool:
        """Whether all of these bodies are slower than the limits of rest."""
        speed, turn = STILL_WAY * SCALE / duration, STILL_ANGLE / duration
        for body in bodies.tolist():
            linear, angular = self._pool.bullet.getBaseVelocity(body, physicsClientId=self._pool.client)
            if not all(abs(v) < speed for v in linear) or not all(abs(v) < turn for v in angular):
                return False
        return True
