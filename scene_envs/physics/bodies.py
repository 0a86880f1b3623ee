"""Body pool: the PyBullet bodies of one asset library, built once and parked between scenes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.spatial import ConvexHull

from scene_envs.arrays import Array
from scene_envs.errors import PhysicsError
from scene_envs.physics.constants import FRICTION
from scene_envs.physics.geometry import LevelGeometry, LibraryGeometry, inset_hull
from scene_envs.physics.rigid import principal_inertia
from scene_envs.silence import quiet_pybullet

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
_SPARE_BODIES = 64
_SPARE_FACTOR = 3
"""A pool is built again when it has more bodies than this many times the bodies that a scene needs, plus
``_SPARE_BODIES``: in every step Bullet compares the boxes of all bodies, including parked ones."""
_ZERO = (0.0, 0.0, 0.0)
_UPRIGHT = (0.0, 0.0, 0.0, 1.0)


class BodyPool:
    """Bodies of one asset library in a PyBullet client of their own.

    Two properties keep the motion of a scene independent of the scenes before it. The broadphase is Bullet's simple
    one: it keeps no tree, and lists pairs in the order of the bodies. And a body that is placed or parked gets a
    fresh broadphase proxy, which drops its pairs, contacts and warm starts.

    Raises:
        MissingDependencyError: pybullet is not installed.
        PhysicsError: PyBullet has no free client slot.
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
        self._frames: dict[int, tuple[Array, Array]] = {}  # category -> principal moments, axes
        self._wavefronts: dict[BodyKey, str] = {}

    def principal(self, category: int) -> tuple[Array, Array]:
        """Principal moments (3,) kg m^2 and axes (3, 3, columns) of an asset's inertia."""
        if category not in self._frames:
            self._frames[category] = principal_inertia(self._library.assets[category].asset.inertia)
        return self._frames[category]

    def take(self, needed: Mapping[BodyKey, int]) -> dict[BodyKey, list[int]]:
        """The first ``needed[key]`` parked bodies of each key, independently of earlier calls.

        Raises:
            PhysicsError: PyBullet refuses a shape or a body.
        """
        have = sum(len(bodies) for bodies in self._bodies.values())
        missing = any(len(self._bodies.get(key, ())) < count for key, count in needed.items())
        if missing or have > _SPARE_FACTOR * sum(needed.values()) + _SPARE_BODIES:
            sizes = {key: len(bodies) for key, bodies in self._bodies.items()} if missing else {}
            spare = {key: count + count // 2 + 1 for key, count in needed.items()}
            self._build({key: max(sizes.get(key, 0), spare.get(key, 0)) for key in {*sizes, *spare}})
        return {key: self._bodies[key][:count] for key, count in needed.items()}

    def place(self, body: int, position: Sequence[float], quaternion: Sequence[float]) -> None:
        """Put a body at a position (Bullet units) and orientation, at rest, with a fresh broadphase proxy."""
        bullet, client = self.bullet, self.client
        bullet.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)
        bullet.resetBaseVelocity(body, _ZERO, _ZERO, physicsClientId=client)
        bullet.setCollisionFilterGroupMask(body, -1, 1, 1, physicsClientId=client)

    def wake(
        self, body: int, category: int, quaternion: Sequence[float], *, fixed: bool, damping: tuple[float, float]
    ) -> None:
        """Turn a parked body to its orientation and give it the dynamics of the coming simulation."""
        bullet, client = self.bullet, self.client
        bullet.resetBasePositionAndOrientation(body, self._parking[body], quaternion, physicsClientId=client)
        if self._library.static[category]:
            return
        bullet.resetBaseVelocity(body, _ZERO, _ZERO, physicsClientId=client)
        bullet.changeDynamics(
            body,
            -1,
            mass=0.0 if fixed else float(self._library.assets[category].asset.mass),
            localInertiaDiagonal=_ZERO if fixed else self._inertia(category),
            linearDamping=damping[0],
            angularDamping=damping[1],
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

    def close(self) -> None:
        """Disconnect from PyBullet."""
        if self.client >= 0:
            self.bullet.disconnect(self.client)
            self.client = -1

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
            axes, center = self.principal(category)[1], self._library.center_of_mass[category]
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
        return (SCALE**2 * self.principal(category)[0]).tolist()  # type: ignore[no-any-return]

    def _body(self, category: int, shape: int, visual: int, place: tuple[float, float, float]) -> int:
        static = bool(self._library.static[category])
        mass = 0.0 if static else float(self._library.assets[category].asset.mass)
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
