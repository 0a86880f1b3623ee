"""One persistent PyBullet world per asset library: bodies are built once and reused for every scene."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from scene_envs.errors import MissingDependencyError, PhysicsError
from scene_envs.physics import rigid
from scene_envs.physics.geometry import LevelGeometry, LibraryGeometry, inset_hull
from scene_envs.physics.placement import Objects

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

BULLET_MARGIN = 1e-3
"""Bullet grows each convex mesh by this much (m)."""
_REACH = 50.0
"""Half the width (m) of the space in which objects of one scene are held together as one island."""
_PARKING = 1000.0
"""Height (m) of the first unused body; the next ones are 10 m apart above it."""


@dataclass(frozen=True)
class SolverSettings:
    """How the motion is integrated.

    Attributes:
        time_step: s.
        iterations: of the sequential-impulse solver per step.
        linear_damping: fraction of velocity lost per second.
        angular_damping: fraction of angular velocity lost per second.
    """

    time_step: float = 1.0 / 240.0
    iterations: int = 50
    linear_damping: float = 0.0
    angular_damping: float = 0.0


_LOOK = 12
"""Steps after which to see whether everything is at rest."""
_STILL_SPEED, _STILL_TURN = 1e-3, 1e-2
"""Speeds (m/s, rad/s) below which an object that began at rest cannot get far in a tenth of a second."""


class World:
    """PyBullet with a pool of bodies; the motion of a scene never depends on the scenes before it.

    Each scene's bodies get fresh broadphase proxies in a canonical order (which drops all contacts that
    earlier scenes left), are sorted the same way whatever the slot order, and never sleep.

    Args:
        library: geometry of the assets.

    Raises:
        MissingDependencyError: pybullet is not installed.
    """

    def __init__(self, library: LibraryGeometry) -> None:
        try:
            with _silence():
                import pybullet
        except ImportError as error:
            raise MissingDependencyError(
                "settling and equilibrium need pybullet, whose wheels exist for Python 3.10 and 3.11; "
                "install it there with: pip install pybullet"
            ) from error
        self._bullet: Any = pybullet
        self._library = library
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise PhysicsError("PyBullet has no free client slot; close clients that are no longer used")
        self._pool_sizes: dict[tuple[int, str], int] = {}
        self._pool: dict[tuple[int, str], list[int]] = {}
        self._frames: dict[int, tuple[Array, Array]] = {}  # category -> principal axes, inertia
        self._inset: dict[tuple[int, str], str] = {}
        self._parking: dict[int, tuple[float, float, float]] = {}
        self._binder = -1

    # -- bodies ---------------------------------------------------------------------------------

    def _require(self, needed: dict[tuple[int, str], int]) -> None:
        """Make the pool hold at least ``needed`` bodies per (category, level); a larger pool is built anew."""
        if all(len(self._pool.get(key, ())) >= count for key, count in needed.items()):
            return
        for key, count in needed.items():
            have = self._pool_sizes.get(key, 0)
            if count > have:
                self._pool_sizes[key] = max(count, 2 * have, 1 if self._library.static[key[0]] else 4)
        bullet, client = self._bullet, self._client
        bullet.resetSimulation(physicsClientId=client)
        bullet.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            numSubSteps=0,
            contactBreakingThreshold=2e-3,
            deterministicOverlappingPairs=1,
            enableFileCaching=0,
            solverResidualThreshold=0.0,
            contactERP=0.2,  # overlaps within the limits close in 10 ms; 0.4 makes objects hop
            physicsClientId=client,
        )
        # A shared small visual: without one PyBullet would read the collision mesh again for every body.
        visual = bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=(1e-3, 1e-3, 1e-3), physicsClientId=client)
        self._pool, self._parking = {}, {}
        for key in sorted(self._pool_sizes):  # one order in every process, whatever was asked for first
            shape = self._shape(*key)
            self._pool[key] = []
            for _ in range(self._pool_sizes[key]):
                place = (0.0, 0.0, _PARKING + 10.0 * len(self._parking))
                body = self._body(key[0], shape, visual, place)
                self._parking[body] = place
                self._pool[key].append(body)

        self._binder = self._make_binder(visual)

    def _make_binder(self, visual: int) -> int:
        """A body of two specks in opposite corners of space, whose box overlaps all others.

        Bullet solves objects with overlapping boxes as one island, and numbers islands by the history of its
        broadphase; that order decides between contacts of compound shapes. With one island there is no choice.
        """
        speck = 0.01 * np.array([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]])
        shape = self._compound(_wavefront([speck - _REACH, speck + _REACH]))
        place = (0.0, 0.0, -_PARKING)
        binder = self._bullet.createMultiBody(
            1.0, shape, visual, basePosition=place, useMaximalCoordinates=True, physicsClientId=self._client
        )
        self._bullet.changeDynamics(
            binder,
            -1,
            activationState=self._bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=self._client,
        )
        self._parking[binder] = place
        return int(binder)

    def _shape(self, category: int, level: str) -> int:
        geometry: LevelGeometry = getattr(self._library.assets[category], level)
        if (category, level) not in self._inset:
            axes, _ = self._principal(category)
            center = self._library.center_of_mass[category]
            hulls = [(inset_hull(part, BULLET_MARGIN) - center) @ axes for part in geometry.parts]
            self._inset[category, level] = _wavefront(hulls)
        shape = self._compound(self._inset[category, level])
        if shape < 0:
            name = self._library.assets[category].asset.name
            raise PhysicsError(f"PyBullet refused the collision shape of asset {name!r} ({level} parts)")
        return shape

    def _compound(self, wavefront: str) -> int:
        """A collision shape from a Wavefront text, one convex child per group; negative on failure."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "hulls.obj"
            path.write_text(wavefront)
            return int(
                self._bullet.createCollisionShape(
                    self._bullet.GEOM_MESH, fileName=str(path), physicsClientId=self._client
                )
            )

    def _principal(self, category: int) -> tuple[Array, Array]:
        """Principal axes (3, 3, columns) and moments (3,) of an asset's inertia."""
        if category not in self._frames:
            moments, axes = np.linalg.eigh(np.asarray(self._library.assets[category].asset.inertia))
            if np.linalg.det(axes) < 0:
                axes[:, 0] *= -1.0
            self._frames[category] = axes, moments
        return self._frames[category]

    def _body(self, category: int, shape: int, visual: int, place: tuple[float, float, float]) -> int:
        static = bool(self._library.static[category])
        mass = 0.0 if static else float(self._library.assets[category].asset.mass)
        body = self._bullet.createMultiBody(
            mass,
            shape,
            visual,
            basePosition=place,
            useMaximalCoordinates=True,
            physicsClientId=self._client,
        )
        if body < 0:
            raise PhysicsError(f"PyBullet could not create a body for asset category {category}")
        settings: dict[str, Any] = {"lateralFriction": 0.6, "restitution": 0.0}
        if not static:
            # The mass goes in with the inertia: alone, the inertia call would reset the mass.
            settings |= {"mass": mass, "localInertiaDiagonal": self._principal(category)[1].tolist()}
            settings["activationState"] = self._bullet.ACTIVATION_STATE_SLEEP
        self._bullet.changeDynamics(body, -1, physicsClientId=self._client, **settings)
        return int(body)

    # -- motion ---------------------------------------------------------------------------------

    def simulate(
        self, objects: Objects, fine: Mask, group: Index, duration: float, settings: SolverSettings
    ) -> tuple[Array, Array, Array, Mask]:
        """Move the objects of one scene for ``duration`` seconds under gravity.

        Args:
            objects: the n objects.
            fine: (n,) whether each object collides with its fine parts.
            group: (n,) number of the cluster of each free object; a cluster leaves when all of it is at rest.
            duration: s.
            settings: integration.

        Returns:
            rotation (n, 3, 3) and translation (n, 3) m afterwards, the angle turned (n,) in radians, and which
            objects (n,) came to rest and left before the end. Objects that Bullet lost to a numerical failure
            come back as NaN.
        """
        bullet, client = self._bullet, self._client
        category, fixed, count = objects.category, objects.fixed, len(objects)
        rotation, translation = objects.rotation, objects.translation
        order = np.lexsort((translation[:, 0], translation[:, 1], translation[:, 2], fine, category))
        levels = np.where(fine, "fine", "coarse")
        needed: dict[tuple[int, str], int] = {}
        keys = [(int(category[i]), str(levels[i])) for i in range(count)]
        for key in keys:
            needed[key] = needed.get(key, 0) + 1
        self._require(needed)

        axes = np.array([self._principal(c)[0] for c in category.tolist()])
        center = self._library.center_of_mass[category]
        start_rotation = rigid.times(rotation, axes)
        start_quaternion = rigid.quaternions(start_rotation)
        start_position = translation + rigid.apply(rotation, center)

        taken = dict.fromkeys(needed, 0)
        bodies = np.empty(count, dtype=np.int64)
        for row in order:
            key = keys[row]
            bodies[row] = body = self._pool[key][taken[key]]
            taken[key] += 1
            self._prepare(body, key[0], bool(fixed[row]), start_quaternion[row].tolist(), settings)
        # Bullet refreshes a body's world inertia only when it integrates: one step out of contact does that.
        steps = max(1, round(duration / settings.time_step))
        for _ in range(2 + steps % 2):
            bullet.stepSimulation(physicsClientId=client)
        self._place(self._binder, _ZERO, _UPRIGHT)
        for row in order:
            self._place(int(bodies[row]), start_position[row].tolist(), start_quaternion[row].tolist())
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=settings.time_step, numSolverIterations=settings.iterations, physicsClientId=client
        )
        end_position, end_quaternion = np.empty((count, 3)), np.empty((count, 4))
        running = {int(label): np.flatnonzero(group == label) for label in np.unique(group[~fixed])}
        left = np.zeros(count, dtype=bool)
        done = 0
        while done < steps:
            ahead = min(_LOOK, steps - done)
            for _ in range(ahead if running else ahead % 2):  # always an even number in all
                bullet.stepSimulation(physicsClientId=client)
            done += ahead
            for label, rows in list(running.items()):
                if done < steps and self._is_still(bodies[rows]):
                    self._read(bodies, rows, end_position, end_quaternion)
                    self._park(bodies[rows], category[rows])
                    left[rows] = True
                    del running[label]
        for rows in (np.flatnonzero(fixed), *running.values()):
            self._read(bodies, rows, end_position, end_quaternion)
            self._park(bodies[rows], category[rows])
        self._place(self._binder, self._parking[self._binder], _UPRIGHT)

        end_rotation = rigid.matrices(end_quaternion)
        new_rotation = rigid.times(end_rotation, axes.swapaxes(-1, -2))
        new_translation = end_position - rigid.apply(new_rotation, center)
        angle = rigid.angle_between(start_quaternion, end_quaternion)
        lost = ~np.isfinite(end_position).all(axis=1) | ~np.isfinite(end_quaternion).all(axis=1)
        if lost.any():
            self.reset()
        return new_rotation, new_translation, angle, left

    def _read(self, bodies: Index, rows: Index, position: Array, quaternion: Array) -> None:
        for row in rows.tolist():
            position[row], quaternion[row] = self._bullet.getBasePositionAndOrientation(
                int(bodies[row]), physicsClientId=self._client
            )

    def _is_still(self, bodies: Index) -> bool:
        """Whether nothing moves or starts to: what is at rest stays at rest."""
        for body in bodies.tolist():
            linear, angular = self._bullet.getBaseVelocity(body, physicsClientId=self._client)
            if not all(abs(v) < _STILL_SPEED for v in linear) or not all(abs(v) < _STILL_TURN for v in angular):
                return False
        return True

    def _prepare(
        self, body: int, category: int, fixed: bool, quaternion: list[float], settings: SolverSettings
    ) -> None:
        """Turn a parked body to its orientation and wake it."""
        bullet, client = self._bullet, self._client
        bullet.resetBasePositionAndOrientation(body, self._parking[body], quaternion, physicsClientId=client)
        if self._library.static[category]:
            return
        bullet.resetBaseVelocity(body, _ZERO, _ZERO, physicsClientId=client)
        bullet.changeDynamics(
            body,
            -1,
            mass=0.0 if fixed else float(self._library.assets[category].asset.mass),
            localInertiaDiagonal=_ZERO if fixed else self._principal(category)[1].tolist(),
            linearDamping=settings.linear_damping,
            angularDamping=settings.angular_damping,
            activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )

    def _place(self, body: int, position: Sequence[float], quaternion: Sequence[float]) -> None:
        """Put a body somewhere, at rest, with nothing remembered of where it was.

        Changing the filter makes a fresh broadphase proxy, which drops the body's pairs, contacts and warm starts.
        """
        bullet, client = self._bullet, self._client
        bullet.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)
        bullet.resetBaseVelocity(body, _ZERO, _ZERO, physicsClientId=client)
        bullet.setCollisionFilterGroupMask(body, -1, 1, 1, physicsClientId=client)

    def _park(self, bodies: Index, category: Index) -> None:
        for row, body in enumerate(bodies.tolist()):
            self._place(body, self._parking[body], _UPRIGHT)
            if not self._library.static[category[row]]:
                self._bullet.changeDynamics(
                    body, -1, activationState=self._bullet.ACTIVATION_STATE_SLEEP, physicsClientId=self._client
                )

    def reset(self) -> None:
        """Throw all bodies away; they are built again when needed."""
        self._pool = {}

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if self._client >= 0:
            self._bullet.disconnect(self._client)
            self._client = -1


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep the greeting that PyBullet prints on import out of the user's terminal."""
    sys.stdout.flush()
    sys.stderr.flush()
    with open(os.devnull, "w") as sink:
        kept = os.dup(1), os.dup(2)
        try:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
            yield
        finally:
            for copy, descriptor in zip(kept, (1, 2), strict=True):
                os.dup2(copy, descriptor)
                os.close(copy)


_ZERO = (0.0, 0.0, 0.0)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


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
