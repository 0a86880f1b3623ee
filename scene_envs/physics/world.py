"""Simulation of one scene in PyBullet, with bodies of a pool."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.rigid import angle_between, apply, matrices, quaternions, times
from scene_envs.physics.bodies import SCALE, BodyKey, BodyPool
from scene_envs.physics.budget import Budget
from scene_envs.physics.constants import GRAVITY
from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.placement import Objects

_LOOK = 12
"""Number of steps between checks for clusters at rest."""
_USUAL_ITERATIONS = 35
"""Solver iterations of a step that costs one unit of work per free object."""
_STILL_WAY, _STILL_ANGLE = 1e-4, 1e-3
"""An object is at rest when its present speed would take it less far than this (m, rad) in the whole duration."""


@dataclass(frozen=True)
class SolverSettings:
    """Settings of the integration of motion."""

    time_step: float = 1.0 / 240.0  # length of a step, s
    iterations: int = 50  # iterations of the sequential-impulse solver per step
    linear_damping: float = 0.0  # fraction of velocity lost per second
    angular_damping: float = 0.0  # fraction of angular velocity lost per second
    tilt: tuple[float, float] = (0.0, 0.0)  # (x, y) angles by which gravity is tilted toward the x and the y axis, rad


class World:
    """PyBullet for one asset library; the motion of a scene depends on that scene alone, bit for bit.

    The order in which bodies are sorted, placed and parked does not depend on the slot order, and bodies never sleep.
    Threads take turns. A call that is interrupted leaves no bodies behind.

    Raises:
        MissingDependencyError: pybullet is not installed.
    """

    def __init__(self, library: LibraryGeometry) -> None:
        self._library = library
        self._pool = BodyPool(library)
        self._lock = threading.Lock()

    def simulate(
        self, objects: Objects, fine: Mask, group: Index, duration: float, settings: SolverSettings, budget: Budget
    ) -> tuple[Array, Array, Array, Mask]:
        """Move the objects of one scene for ``duration`` seconds under gravity.

        Args:
            objects: The n objects.
            fine: (n,) bool; True for objects that collide with their fine parts.
            group: (n,) number of the cluster of each free object; a cluster leaves the simulation when it is at rest.
            duration: Simulated time, s.
            settings: Settings of the integration.
            budget: Units of simulation; when they are spent, all objects stay at the poses reached.

        Returns:
            rotation (n, 3, 3) and translation (n, 3) m afterwards, the angle turned (n,) in radians, and the objects
            (n,) that left before the end: those at rest, or all when the budget was spent. Objects that Bullet lost to
            a numerical failure come back as NaN.
        """
        with self._lock:
            try:
                return self._simulate(objects, fine, group, duration, settings, budget)
            except BaseException:  # an interrupt too: bodies that are not parked would meet those of later scenes
                self._pool.clear()
                raise

    def _simulate(
        self, objects: Objects, fine: Mask, group: Index, duration: float, settings: SolverSettings, budget: Budget
    ) -> tuple[Array, Array, Array, Mask]:
        bullet, client = self._pool.bullet, self._pool.client
        category, fixed, count = objects.category, objects.fixed, len(objects)
        axes = np.array([self._pool.principal(c)[1] for c in category.tolist()])
        center = self._library.center_of_mass[category]
        start_quaternion = quaternions(times(objects.rotation, axes))
        start_position = SCALE * (objects.translation + apply(objects.rotation, center))

        bodies, order = self._bodies(objects, fine)
        damping = settings.linear_damping, settings.angular_damping
        for row in order:
            turn = start_quaternion[row].tolist()
            self._pool.wake(int(bodies[row]), int(category[row]), turn, fixed=bool(fixed[row]), damping=damping)
        # After waking: Bullet sets the gravity of active bodies only.
        down = SCALE * GRAVITY * np.array([*np.sin(settings.tilt), -np.cos(np.hypot(*settings.tilt))])
        bullet.setGravity(*down.tolist(), physicsClientId=client)
        # Bullet refreshes a body's world inertia only when it integrates. Some steps out of contact do that.
        steps = max(1, round(duration / settings.time_step))
        for _ in range(2 + steps % 2):
            bullet.stepSimulation(physicsClientId=client)
        for row in order:
            self._pool.place(int(bodies[row]), start_position[row].tolist(), start_quaternion[row].tolist())
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=settings.time_step, numSolverIterations=settings.iterations, physicsClientId=client
        )
        end_position, end_quaternion = np.empty((count, 3)), np.empty((count, 4))
        running = {int(label): np.flatnonzero(group == label) for label in np.unique(group[~fixed])}
        left = np.zeros(count, dtype=bool)
        done = 0
        while done < steps:
            ahead = min(_LOOK, steps - done)
            for _ in range(ahead if running else ahead % 2):  # the number of all steps is always even
                bullet.stepSimulation(physicsClientId=client)
            done += ahead
            budget.spend(ahead * sum(map(len, running.values())) * settings.iterations / _USUAL_ITERATIONS)
            leaving = np.zeros(count, dtype=bool)
            for label, rows in list(running.items()):
                if done < steps and (budget.is_spent or self._is_still(bodies[rows], duration)):
                    leaving[rows] = True
                    del running[label]
            self._leave(bodies, category, order[leaving[order]], end_position, end_quaternion)
            left |= leaving
        self._leave(bodies, category, order[~left[order]], end_position, end_quaternion)

        end_rotation = matrices(end_quaternion)
        new_rotation = times(end_rotation, axes.swapaxes(-1, -2))
        new_translation = end_position / SCALE - apply(new_rotation, center)
        angle = angle_between(start_quaternion, end_quaternion)
        if not (np.isfinite(end_position).all() and np.isfinite(end_quaternion).all()):
            self._pool.clear()
        return new_rotation, new_translation, angle, left

    def close(self) -> None:
        """Disconnect from PyBullet."""
        self._pool.close()

    def _bodies(self, objects: Objects, fine: Mask) -> tuple[Index, Index]:
        """A body (n,) for each object, and the order (n,) in which to treat them."""
        x, y, z = objects.translation.T
        order = np.lexsort((x, y, z, fine, objects.category))
        keys: list[BodyKey] = [
            (int(category), "fine" if is_fine else "coarse")
            for category, is_fine in zip(objects.category, fine, strict=True)
        ]
        needed: dict[BodyKey, int] = {}
        for key in keys:
            needed[key] = needed.get(key, 0) + 1
        parked = {key: iter(bodies) for key, bodies in self._pool.take(needed).items()}
        bodies = np.empty(len(objects), dtype=np.int64)
        for row in order:
            bodies[row] = next(parked[keys[row]])
        return bodies, order

    def _is_still(self, bodies: Index, duration: float) -> bool:
        """Whether all of these bodies are slower than the limits of rest."""
        speed, turn = _STILL_WAY * SCALE / duration, _STILL_ANGLE / duration
        for body in bodies.tolist():
            linear, angular = self._pool.bullet.getBaseVelocity(body, physicsClientId=self._pool.client)
            if not all(abs(v) < speed for v in linear) or not all(abs(v) < turn for v in angular):
                return False
        return True

    def _leave(self, bodies: Index, category: Index, rows: Index, position: Array, quaternion: Array) -> None:
        """Write the poses of bodies (Bullet units) into ``position`` and ``quaternion``, and park the bodies."""
        for row in rows.tolist():
            body = int(bodies[row])
            position[row], quaternion[row] = self._pool.bullet.getBasePositionAndOrientation(
                body, physicsClientId=self._pool.client
            )
        for row in rows.tolist():
            self._pool.park(int(bodies[row]), int(category[row]))
