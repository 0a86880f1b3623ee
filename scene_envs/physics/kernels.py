"""Physics of a chunk of scenes in one process: numpy in, numpy out. Workers run these functions."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import TOO_MANY, corner_tests, scene_pairs
from scene_envs.physics.engines import Course
from scene_envs.physics.motion import Physics, motion, physics_of, settle_scene
from scene_envs.physics.placement import Budget, ObjectPairs, Objects, flatten, object_boxes, place, simulation_units
from scene_envs.physics.projection import TOLERANCE, heaps, project_objects
from scene_envs.scene_types import SceneType

_LOGGER = logging.getLogger(__name__)
_FALLEN = 1.0
"""Objects further than this (m) below the workspace have fallen off, and are simulated no further."""


@dataclass(frozen=True)
class Chunk:
    """Some scenes of one type, as workers receive them."""

    scene_type: SceneType  # an object, no name: types that a worker has not registered work too
    translations: Array  # (b, N, 3) float64 m
    rotations: Array  # (b, N, 3, 3) float64
    categories: Index  # (b, N) int64
    units: Array | None = None  # (b,) units of simulation that each scene may spend; None derives them from its objects
    calm: Mask | None = None  # (b, N) objects that stand still unless others reach them, for settling; None for none

    def __len__(self) -> int:
        return len(self.categories)

    def __getitem__(self, rows: slice) -> Chunk:
        units = None if self.units is None else self.units[rows]
        calm = None if self.calm is None else self.calm[rows]
        return Chunk(self.scene_type, self.translations[rows], self.rotations[rows], self.categories[rows], units, calm)


def _is_heap(physics: Physics, objects: Objects) -> bool:
    """Whether objects of one scene overlap too much to be simulated in bounded time."""
    if not heaps(physics.collider, objects).any():
        return False
    _LOGGER.warning("objects of a scene overlap too deeply to be simulated; project it first; its row is invalid")
    return True


def _start(chunk: Chunk, engine: str) -> tuple[Physics, Objects, NDArray[np.bool_]]:
    """Physics and objects of a chunk, and the validity (b,) of its scenes: so far, all are valid."""
    physics = physics_of(chunk.scene_type, engine)
    welded = np.isin(chunk.categories, np.array(chunk.scene_type.welded_categories, dtype=np.int64))
    objects = flatten(physics.library, chunk.translations, chunk.rotations, chunk.categories, welded)
    return physics, objects, np.ones(len(chunk), dtype=bool)


def _budgets(chunk: Chunk, objects: Objects, pairs: ObjectPairs) -> list[Budget]:
    """Work that the simulation of each scene may take."""
    units = simulation_units(objects, pairs, len(chunk)) if chunk.units is None else chunk.units
    return list(map(Budget, units.tolist()))


def feasibility_kernel(
    chunk: Chunk,
    *,
    engine: str,
    max_penetration: float,
    max_displacement: float,
    max_rotation: float,
    duration: float,
    tilt: tuple[float, float] = (0.0, 0.0),
) -> dict[str, Any]:
    """See :func:`scene_envs.physics.feasibility`; gravity is tilted by ``tilt`` (rad) toward the x and the y axis."""
    physics, objects, valid = _start(chunk, engine)
    pairs = physics.collider.pairs(objects)
    depth = pairs.deepest()
    deep = depth > max_penetration
    kept = np.flatnonzero(objects.fixed | ~deep)
    displacement, rotation = np.zeros(len(objects)), np.zeros(len(objects))
    budgets = _budgets(chunk, objects, pairs)
    displacement[kept], rotation[kept], lost = motion(
        physics, objects[kept], pairs.among(kept), duration, budgets, tilt
    )
    feasible = ~objects.fixed & ~deep & (displacement <= max_displacement) & (rotation <= max_rotation)
    valid[lost] = False
    return {
        "feasible": _scatter(chunk, objects, feasible),
        "depth": _scatter(chunk, objects, depth),
        "displacement": _scatter(chunk, objects, displacement),
        "rotation": _scatter(chunk, objects, rotation),
        "valid": valid,
        "spent": np.array([budget.spent for budget in budgets]),
    }


def equilibrium_kernel(chunk: Chunk, *, engine: str, duration: float) -> dict[str, Any]:
    """See :func:`scene_envs.physics.equilibrium`."""
    physics, objects, valid = _start(chunk, engine)
    valid[:] = [not _is_heap(physics, objects[objects.scene == index]) for index in range(len(chunk))]
    objects = objects[valid[objects.scene]]
    pairs = physics.collider.pairs(objects)
    displacement, rotation, lost = motion(physics, objects, pairs, duration, _budgets(chunk, objects, pairs))
    valid[lost] = False
    return {
        "displacement": _scatter(chunk, objects, displacement),
        "rotation": _scatter(chunk, objects, rotation),
        "valid": valid,
    }


def penetration_kernel(chunk: Chunk, *, engine: str) -> dict[str, Any]:
    """See :func:`scene_envs.physics.penetration`."""
    physics, objects, valid = _start(chunk, engine)
    found = physics.collider.overlaps(objects, *scene_pairs(objects))
    scene, slots = objects.scene[found.first], (objects.slot[found.first], objects.slot[found.second])
    work = corner_tests(physics.library, objects, found.first, found.second)
    valid[np.bincount(scene, weights=work, minlength=len(chunk)) > TOO_MANY] = False
    valid[found.unmeasured] = False
    if not valid.all():
        _LOGGER.warning("objects of a scene overlap too much to be measured one by one; its row is invalid")
    listed: list[list[tuple[int, int, float, float, int]]] = [[] for _ in range(len(chunk))]
    columns = (values.tolist() for values in (*slots, found.depth, found.total, found.part_count))
    for index, pair in zip(scene.tolist(), zip(*columns, strict=True), strict=True):
        listed[index].append(pair)
    deepest = np.zeros(chunk.categories.shape)
    for slot in slots:
        np.maximum.at(deepest, (scene, slot), found.depth)
    return {
        "pairs": listed,
        "depth": deepest,
        "total_per_pair": np.bincount(scene, weights=found.depth, minlength=len(chunk)),
        "total_per_geometry": np.bincount(scene, weights=found.total, minlength=len(chunk)),
        "valid": valid,
    }


def furniture_kernel(chunk: Chunk, *, engine: str) -> dict[str, Any]:
    """See :func:`scene_envs.physics.furniture_overlap`."""
    physics, objects, valid = _start(chunk, engine)
    categories = chunk.scene_type.welded_categories, chunk.scene_type.furniture_categories
    is_welded, is_furniture = (np.isin(objects.category, np.array(some, dtype=np.int64)) for some in categories)
    welded, furniture = objects[is_welded], is_furniture[is_welded]
    pairs = physics.collider.pairs(replace(welded, fixed=~furniture))  # the collider skips pairs of fixed objects
    depth = np.where(furniture, pairs.deepest(), 0.0)
    return {"depth": _scatter(chunk, welded, depth), "valid": valid}


def gaps_kernel(chunk: Chunk, *, engine: str, limit: float) -> dict[str, Any]:
    """Gap (m, at most ``limit``) of each object to the nearest one that does not carry it and that it does not carry,
    directly or through others; 0 where they touch or overlap. Pairs of fixed objects do not count.
    """
    import torch  # the other kernels run in processes without torch

    from scene_envs.assets.fcl import gap, shapes_of
    from scene_envs.supports import Contacts, Placed

    physics, objects, valid = _start(chunk, engine)
    poses = map(torch.from_numpy, (chunk.categories, chunk.translations, chunk.rotations))
    outlines, standing = Placed.of_scenes(chunk.scene_type, *poses)
    carried = standing.carried(Contacts.of(outlines, standing).holding().counted(standing.slot).support)
    ignored = carried[standing.scene[:, None], standing.slot[:, None], standing.slot].numpy()
    ignored |= objects.fixed[:, None] & objects.fixed
    ignored |= ignored.T | (objects.scene[:, None] != objects.scene)
    placed = place(physics.library, objects, "fine")
    shapes, nearest = shapes_of(chunk.scene_type.library.assets), np.full(len(objects), limit)
    apart = _box_gaps(*object_boxes(placed), *object_boxes(placed))
    first, second = np.nonzero(np.triu(~ignored & (apart < limit), 1))
    with shapes.lock:
        parts = list(chain(*shapes.place(objects.category.tolist(), objects.rotation, objects.translation)))
        for pair in np.argsort(apart[first, second], kind="stable"):
            a, b = first[pair], second[pair]
            least = max(nearest[a], nearest[b])  # only a smaller gap matters
            rows, columns = (slice(placed.start[i], placed.start[i] + placed.count[i]) for i in (a, b))
            boxes = _box_gaps(placed.low[rows], placed.high[rows], placed.low[columns], placed.high[columns])
            for index in np.argsort(boxes, axis=None, kind="stable"):
                i, j = divmod(int(index), boxes.shape[1])
                if boxes[i, j] >= least:
                    break
                least = min(least, gap(parts[rows.start + i], parts[columns.start + j]))
            nearest[[a, b]] = np.minimum(nearest[[a, b]], least)
    return {"gap": _scatter(chunk, objects, nearest), "valid": valid}


def _box_gaps(low: Array, high: Array, other_low: Array, other_high: Array) -> Array:
    """(n, m) m: distances of boxes (n, 3) to other boxes (m, 3)."""
    between = np.maximum(low[:, None] - other_high, other_low - high[:, None])
    return np.linalg.norm(np.maximum(between, 0.0), axis=-1)  # type: ignore[no-any-return]


def settle_kernel(chunk: Chunk, *, engine: str, duration: float, iterations: int) -> dict[str, Any]:
    """See :func:`scene_envs.physics.settle`."""
    translations, rotations, valid = chunk.translations.copy(), chunk.rotations.copy(), np.ones(len(chunk), dtype=bool)
    finished, spent = np.ones(len(chunk), dtype=bool), np.zeros(len(chunk))
    bottom = chunk.scene_type.workspace[0][2] - _FALLEN
    for index in range(len(chunk)):
        row = chunk[index : index + 1]
        physics, objects, _ = _start(row, engine)
        valid[index] = not _is_heap(physics, objects)
        if not valid[index]:
            continue
        pairs = physics.collider.pairs(objects)
        (budget,) = _budgets(row, objects, pairs)
        new_rotation, new_translation, valid[index] = settle_scene(
            physics,
            objects,
            pairs,
            duration,
            bottom,
            Course(budget, settling=iterations),
            None if row.calm is None else row.calm[0, objects.slot],
        )
        finished[index], spent[index] = not budget.is_spent, budget.spent
        if valid[index]:
            translations[index, objects.slot] = new_translation
            rotations[index, objects.slot] = new_rotation
    return {
        "translations": translations,
        "rotations": rotations,
        "finished": finished & valid,
        "spent": spent,
        "valid": valid,
    }


def projection_kernel(chunk: Chunk, *, engine: str) -> dict[str, Any]:
    """See :func:`scene_envs.physics.project`."""
    translations = chunk.translations.copy()
    residual, heap = np.zeros(len(chunk)), np.zeros(len(chunk), dtype=bool)
    for index in range(len(chunk)):
        physics, objects, _ = _start(chunk[index : index + 1], engine)
        result = project_objects(physics.collider, objects, chunk.scene_type.workspace)
        translations[index, objects.slot] = result.translation
        residual[index], heap[index] = result.residual_depth, result.heap
    return {
        "translations": translations,
        "residual_depth": residual,
        "converged": residual <= TOLERANCE,
        "heap": heap,
        "valid": np.ones(len(chunk), dtype=bool),
    }


def units_kernel(chunk: Chunk, *, engine: str) -> dict[str, Any]:
    """Units of simulation that each scene may spend; 0 for heaps, which are not simulated."""
    physics, objects, valid = _start(chunk, engine)
    spread = np.array([bool(heaps(physics.collider, objects[objects.scene == row]).any()) for row in range(len(chunk))])
    objects = objects[~spread[objects.scene]]
    units = simulation_units(objects, physics.collider.pairs(objects), len(chunk))
    return {"units": np.where(spread, 0.0, units), "valid": valid}


def _scatter(chunk: Chunk, objects: Objects, values: NDArray[Any]) -> NDArray[Any]:
    """Values (n,) of objects as a (b, N) array, 0 in empty slots."""
    out = np.zeros(chunk.categories.shape, dtype=values.dtype)
    out[objects.scene, objects.slot] = values
    return out


KERNELS: dict[str, Callable[..., dict[str, Any]]] = {
    "feasibility": feasibility_kernel,
    "equilibrium": equilibrium_kernel,
    "penetration": penetration_kernel,
    "furniture": furniture_kernel,
    "gaps": gaps_kernel,
    "project": projection_kernel,
    "settle": settle_kernel,
    "units": units_kernel,
}
"""Functions that workers run."""
