"""The physics of a chunk of scenes in one process: numpy in, numpy out. Workers run these."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_envs.errors import MissingDependencyError
from scene_envs.physics.collision import Collider
from scene_envs.physics.geometry import LibraryGeometry, library_geometry
from scene_envs.physics.placement import Objects, flatten, object_boxes, place
from scene_envs.physics.projection import TOLERANCE, project_objects
from scene_envs.physics.support import Support
from scene_envs.physics.world import SolverSettings, World
from scene_envs.scene_types import SceneType

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Chunk:
    """Some scenes of one type, as workers receive them.

    Attributes:
        scene_type: the scene type itself, so that types registered elsewhere work in workers.
        translations: (b, N, 3) float64 m.
        rotations: (b, N, 3, 3) float64.
        categories: (b, N) int64.
    """

    scene_type: SceneType
    translations: Array
    rotations: Array
    categories: Index

    def __len__(self) -> int:
        return len(self.categories)

    def row(self, index: int) -> Chunk:
        """One scene as a chunk."""
        rows = slice(index, index + 1)
        return Chunk(self.scene_type, self.translations[rows], self.rotations[rows], self.categories[rows])


Kernel = Callable[..., dict[str, Any]]


class Physics:
    """Everything this process keeps for one asset library."""

    def __init__(self, library: LibraryGeometry) -> None:
        self.library = library
        self.collider = Collider(library)
        self.support = Support(library)
        self._world: World | None = None

    @property
    def world(self) -> World:
        """The PyBullet world, made on first use."""
        if self._world is None:
            self._world = World(self.library)
        return self._world

    def flatten(self, chunk: Chunk) -> Objects:
        """The objects of a chunk."""
        welded = np.isin(chunk.categories, np.array(chunk.scene_type.welded_categories, dtype=np.int64))
        return flatten(self.library, chunk.translations, chunk.rotations, chunk.categories, welded)


_PHYSICS: dict[int, Physics] = {}


def physics_of(scene_type: SceneType) -> Physics:
    """The physics of a scene type's assets, shared within this process."""
    library = library_geometry(scene_type.library.assets)
    if id(library) not in _PHYSICS:
        _PHYSICS[id(library)] = Physics(library)
    return _PHYSICS[id(library)]


def feasibility_kernel(
    chunk: Chunk, *, max_penetration: float, max_displacement: float, max_rotation: float, duration: float
) -> dict[str, Any]:
    """See :func:`scene_envs.physics.feasibility`."""
    physics = physics_of(chunk.scene_type)
    objects = physics.flatten(chunk)
    pairs = physics.collider.pairs(objects)
    depth = np.zeros(len(objects))
    np.maximum.at(depth, pairs.first, pairs.depth)
    np.maximum.at(depth, pairs.second, pairs.depth)
    deep = depth > max_penetration
    kept = np.flatnonzero(objects.fixed | ~deep)
    displacement, rotation = np.zeros(len(objects)), np.zeros(len(objects))
    displacement[kept], rotation[kept], lost = motion(physics, objects[kept], duration)
    feasible = ~objects.fixed & ~deep & (displacement <= max_displacement) & (rotation <= max_rotation)
    valid = np.ones(len(chunk), dtype=bool)
    valid[lost] = False
    return {
        "feasible": _scatter(chunk, objects, feasible),
        "depth": _scatter(chunk, objects, depth),
        "displacement": _scatter(chunk, objects, displacement),
        "rotation": _scatter(chunk, objects, rotation),
        "valid": valid,
    }


def equilibrium_kernel(chunk: Chunk, *, duration: float) -> dict[str, Any]:
    """See :func:`scene_envs.physics.equilibrium`."""
    physics = physics_of(chunk.scene_type)
    objects = physics.flatten(chunk)
    displacement, rotation, lost = motion(physics, objects, duration)
    valid = np.ones(len(chunk), dtype=bool)
    valid[lost] = False
    return {
        "displacement": _scatter(chunk, objects, displacement),
        "rotation": _scatter(chunk, objects, rotation),
        "valid": valid,
    }


def penetration_kernel(chunk: Chunk) -> dict[str, Any]:
    """See :func:`scene_envs.physics.penetration`."""
    physics = physics_of(chunk.scene_type)
    objects = physics.flatten(chunk)
    pairs = physics.collider.pairs(objects, totals=True)
    depth = np.zeros(len(objects))
    np.maximum.at(depth, pairs.first, pairs.depth)
    np.maximum.at(depth, pairs.second, pairs.depth)
    listed: list[list[tuple[int, int, float, float, int]]] = [[] for _ in range(len(chunk))]
    for row in np.flatnonzero(pairs.depth > 0):
        a, b = pairs.first[row], pairs.second[row]
        entry = (int(objects.slot[a]), int(objects.slot[b]), float(pairs.depth[row]), float(pairs.total[row]))
        listed[objects.scene[a]].append((*entry, int(pairs.part_count[row])))
    return {
        "pairs": listed,
        "depth": _scatter(chunk, objects, depth),
        "total_per_pair": np.array([sum(entry[2] for entry in scene) for scene in listed]),
        "total_per_geometry": np.array([sum(entry[3] for entry in scene) for scene in listed]),
        "valid": np.ones(len(chunk), dtype=bool),
    }


SEGMENT = 0.25
"""Seconds after which settling looks again at which shapes it needs, and whether anything still moves."""
_STILL = 2e-5
"""An object that moved less than this (m, or rad) in a segment has come to rest."""


def settle_kernel(chunk: Chunk, *, duration: float) -> dict[str, Any]:
    """See :func:`scene_envs.physics.settle`."""
    physics = physics_of(chunk.scene_type)
    translations, rotations = chunk.translations.copy(), chunk.rotations.copy()
    valid = np.ones(len(chunk), dtype=bool)
    for index in range(len(chunk)):
        objects = physics.flatten(chunk.row(index))
        new_rotation, new_translation, valid[index] = _settle_one(physics, objects, duration)
        if valid[index]:
            translations[index, objects.slot] = new_translation
            rotations[index, objects.slot] = new_rotation
    return {"translations": translations, "rotations": rotations, "valid": valid}


def projection_kernel(chunk: Chunk) -> dict[str, Any]:
    """See :func:`scene_envs.physics.project`."""
    physics = physics_of(chunk.scene_type)
    translations = chunk.translations.copy()
    residual = np.zeros(len(chunk))
    for index in range(len(chunk)):
        objects = physics.flatten(chunk.row(index))
        result = project_objects(physics.library, physics.collider, objects)
        translations[index, objects.slot] = result.translation
        residual[index] = result.residual_depth
    return {
        "translations": translations,
        "residual_depth": residual,
        "converged": residual <= TOLERANCE,
        "valid": np.ones(len(chunk), dtype=bool),
    }


def _settle_one(physics: Physics, objects: Objects, duration: float) -> tuple[Array, Array, bool]:
    rotation, translation = objects.rotation, objects.translation
    remaining = duration
    while remaining > 1e-9 and not objects.fixed.all():
        span = min(SEGMENT, remaining)
        remaining -= span
        current = Objects(objects.scene, objects.slot, objects.category, rotation, translation, objects.fixed)
        pairs = physics.collider.pairs(current)
        low, high = object_boxes(place(physics.library, current, "coarse"))
        fine = physics.support.needs_fine(current, pairs, low, high)
        settings = _settings(int(physics.support.tallest(current, pairs).max(initial=0)), damping=0.3)
        end = physics.world.simulate(current.category, fine, current.fixed, rotation, translation, span, settings)
        if not (np.isfinite(end[0]).all() and np.isfinite(end[1]).all()):
            return objects.rotation, objects.translation, False
        moved = np.linalg.norm(end[1] - translation, axis=1).max(initial=0.0)
        rotation = np.where(objects.fixed[:, None, None], rotation, end[0])
        translation = np.where(objects.fixed[:, None], translation, end[1])
        if moved < _STILL and end[2].max(initial=0.0) < _STILL:
            break
    return rotation, translation, True


def motion(physics: Physics, objects: Objects, duration: float) -> tuple[Array, Array, Index]:
    """Displacement (n,) m and rotation (n,) rad in ``duration`` s of simulation, and the scenes that failed."""
    low, high = object_boxes(place(physics.library, objects, "coarse"))
    resting, displacement, rotation = physics.support.at_rest(objects, low, high, duration)
    active = np.flatnonzero(~resting)
    moving = objects[active]
    pairs = physics.collider.pairs(moving)
    fine = physics.support.needs_fine(moving, pairs, low[active], high[active])
    height = physics.support.tallest(moving, pairs)
    lost: list[int] = []
    for scene in np.unique(moving.scene):
        rows = np.flatnonzero(moving.scene == scene)
        if moving.fixed[rows].all():
            continue
        try:
            end_rotation, end_translation, angle = physics.world.simulate(
                moving.category[rows],
                fine[rows],
                moving.fixed[rows],
                moving.rotation[rows],
                moving.translation[rows],
                duration,
                _settings(int(height[rows].max())),
            )
        except MissingDependencyError:
            raise
        moved = np.linalg.norm(end_translation - moving.translation[rows], axis=1)
        if not (np.isfinite(moved).all() and np.isfinite(end_rotation).all()):
            _LOGGER.warning("the simulation of a scene diverged; its row is invalid")
            lost.append(int(scene))
            continue
        displacement[active[rows]] = moved
        rotation[active[rows]] = angle
    displacement[objects.fixed] = 0.0
    rotation[objects.fixed] = 0.0
    return displacement, rotation, np.array(sorted(set(lost)), dtype=np.int64)


def _settings(height: int, damping: float = 0.0) -> SolverSettings:
    """Taller stacks need a finer integration to stand as still as they do in reality."""
    if height <= 2:
        return SolverSettings(1.0 / 240.0, 30, damping, damping)
    if height <= 4:
        return SolverSettings(1.0 / 240.0, 50, damping, damping)
    return SolverSettings(1.0 / 480.0, 50, damping, damping)


def _scatter(chunk: Chunk, objects: Objects, values: NDArray[Any]) -> NDArray[Any]:
    """Values (n,) of objects as a (b, N) array, 0 in empty slots."""
    out = np.zeros(chunk.categories.shape, dtype=values.dtype)
    out[objects.scene, objects.slot] = values
    return out


KERNELS: dict[str, Kernel] = {
    "feasibility": feasibility_kernel,
    "equilibrium": equilibrium_kernel,
    "penetration": penetration_kernel,
    "project": projection_kernel,
    "settle": settle_kernel,
}
"""What workers can be asked to run."""
