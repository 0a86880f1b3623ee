"""Public functions of the physics: batches of scenes in, results per scene and object out."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.physics.engines import ITERATIONS, engine_name
from scene_envs.physics.kernels import Chunk
from scene_envs.physics.pool import PhysicsPool
from scene_envs.rotations import geodesic_angle, project_to_so3
from scene_envs.scene import SceneBatch, require_rigid_poses

_LOGGER = logging.getLogger(__name__)
_CHUNK, _OWN_CHUNK = 8, 32
"""Scenes per message to a worker, and scenes that this process computes together."""

Rows = list[dict[str, Any] | None]
"""Results of a kernel, one per scene."""


def chosen_pool(pool: PhysicsPool | None, physics: str | None) -> PhysicsPool:
    """``pool``, else one that computes in this process with the engine ``physics``, or with that of ``auto``.

    Raises InvalidInputError for a pool of another engine, and errors as
    :func:`~scene_envs.physics.engines.engine_name`.
    """
    if pool is None:
        return PhysicsPool(workers=0, physics=physics or "auto")
    if physics is not None and engine_name(physics) != pool.engine:
        raise InvalidInputError(f"physics={physics!r}, but the pool computes with {pool.engine!r}: name one engine")
    return pool


def run_kernel(
    kernel: str,
    batch: SceneBatch,
    options: dict[str, Any],
    pool: PhysicsPool,
    units: Tensor | None = None,
    calm: Tensor | None = None,
) -> Rows:
    """Run a kernel of :data:`~scene_envs.physics.kernels.KERNELS`: results of each scene, None where it failed twice.
    ``units`` (B,) float64 may be spent by the simulation of each scene; None derives them from its objects.
    ``calm`` (B, N) objects stand still while scenes settle, unless others reach them.
    InvalidInputError names scene and slot of a pose that is not finite or a matrix that is no rotation.
    """
    require_rigid_poses(batch)
    translations = batch.translations.double().cpu().numpy()
    rotations = batch.rotations.double().cpu().numpy()
    categories = batch.categories.cpu().numpy()
    size = max(1, min(_CHUNK, -(-len(batch) // pool.workers))) if pool.workers else _OWN_CHUNK
    limits = None if units is None else units.double().cpu().numpy()
    whole = Chunk(
        batch.scene_type, translations, rotations, categories, limits, None if calm is None else calm.cpu().numpy()
    )
    chunks = [whole[start : start + size] for start in range(0, len(batch), size)]
    results = pool.run(kernel, chunks, options)
    if lost := [number for number, row in enumerate(results) if row is not None and not row["valid"]]:
        _LOGGER.debug(
            "%s: %d of %d scenes of the batch are invalid (%s): too deep in each other to be simulated or measured, or "
            "the simulation diverged or took more work than a scene may, and was ended; figures leave them out",
            kernel, len(lost), len(results), ", ".join(map(str, lost[:10])) + ", ..." * (len(lost) > 10),
        )  # fmt: skip
    return results


def valid_rows(rows: Rows) -> Tensor:
    """(B,) bool, scenes that were judged."""
    return torch.tensor([row is not None and bool(row["valid"]) for row in rows], dtype=torch.bool)


def spent(rows: Rows) -> Tensor:
    """(B,) float64, units of simulation that each scene took; infinite if the scene failed twice."""
    return torch.tensor([np.inf if row is None else float(row["spent"]) for row in rows], dtype=torch.float64)


def stack(
    rows: Rows, batch: SceneBatch, name: str, dtype: torch.dtype = torch.float32, shape: tuple[int, ...] | None = None
) -> Tensor:
    """(B, N) tensor of a named result (or (B, *shape)), zeros where a row is invalid."""
    shape = (batch.tensor.shape[1],) if shape is None else shape
    out = torch.zeros(len(rows), *shape, dtype=dtype)
    good = {index: row[name] for index, row in enumerate(rows) if row is not None and row["valid"]}
    if good:
        out[list(good)] = torch.from_numpy(np.array(list(good.values()))).to(dtype)
    return out


def poses_after(rows: Rows, batch: SceneBatch) -> tuple[SceneBatch, Tensor, Tensor]:
    """The batch at its new poses, with displacement (B, N) m and rotation (B, N) rad of each object; all on the CPU."""
    batch = batch.to("cpu")
    translations, rotations = batch.translations.clone(), batch.rotations.clone()
    for index, row in enumerate(rows):
        if row is not None and row["valid"]:
            translations[index] = torch.from_numpy(row["translations"]).float()
            if "rotations" in row:
                rotations[index] = torch.from_numpy(row["rotations"]).float()
    present = ~batch.is_empty
    displacement = (translations - batch.translations).norm(dim=-1) * present
    identity = torch.eye(3).expand_as(rotations)
    turned = (rotations != batch.rotations).any(dim=-1, keepdim=True).any(dim=-2, keepdim=True)
    before = torch.where(present[..., None, None], batch.rotations, identity)
    after = torch.where(present[..., None, None], torch.where(turned, project_to_so3(rotations), rotations), identity)
    return batch.with_poses(translations, after), displacement, geodesic_angle(before, after) * present


@dataclass(frozen=True)
class FeasibilityResult:
    """The verdict per object.

    Attributes:
        feasible: (B, N) bool; True for free objects that pass, False for welded and empty slots.
        depth: (B, N) m, deepest overlap of each object with any other, welded ones included.
        displacement: (B, N) m, motion of the object frame; 0 where the object was not simulated.
        rotation: (B, N) rad, angle that the object turned.
        valid: (B,) bool; False where physics could not judge the scene. All other fields are 0 there.
        counts: (B,) int64, feasible objects per scene.
    """

    feasible: Tensor
    depth: Tensor
    displacement: Tensor
    rotation: Tensor
    valid: Tensor
    counts: Tensor


@dataclass(frozen=True)
class ObjectPair:
    """Two overlapping objects of one scene.

    Attributes:
        slots: Slots of the two objects.
        depth: Deepest overlap of any two of their convex parts, m.
        total: Sum of the overlaps of all pairs of their convex parts, m.
        part_pairs: Number of overlapping pairs of convex parts.
    """

    slots: tuple[int, int]
    depth: float
    total: float
    part_pairs: int


@dataclass(frozen=True)
class PenetrationResult:
    """Overlap between objects; pairs of welded objects do not count.

    Attributes:
        pairs: Overlapping object pairs of each scene, in slot order.
        depth: (B, N) m, deepest overlap of each object.
        total_per_pair: (B,) m, the sum over object pairs of their depth.
        total_per_geometry: (B,) m, the sum over all pairs of convex parts (the literature's measure).
        valid: (B,) bool.
    """

    pairs: tuple[tuple[ObjectPair, ...], ...]
    depth: Tensor
    total_per_pair: Tensor
    total_per_geometry: Tensor
    valid: Tensor


@dataclass(frozen=True)
class EquilibriumResult:
    """Motion under gravity.

    Attributes:
        displacement: (B, N) m.
        rotation: (B, N) rad.
        valid: (B,) bool.
    """

    displacement: Tensor
    rotation: Tensor
    valid: Tensor


@dataclass(frozen=True)
class SettleResult:
    """Scenes after they came to rest.

    Attributes:
        batch: Scenes at their new poses; invalid rows are unchanged.
        displacement: (B, N) m, distance from the given poses.
        rotation: (B, N) rad.
        finished: (B,) bool; False where the scene's work budget was spent first: objects are at the poses reached, and
            may be moving. False also where ``valid`` is False.
        valid: (B,) bool.
    """

    batch: SceneBatch
    displacement: Tensor
    rotation: Tensor
    finished: Tensor
    valid: Tensor


@dataclass(frozen=True)
class ProjectionResult:
    """Scenes moved to the nearest translations without overlap.

    Attributes:
        batch: Projected scenes; rotations and welded objects are unchanged.
        converged: (B,) bool; True where no overlap deeper than the tolerance is left.
        residual_depth: (B,) m, deepest overlap left.
        moved: (B, N) m, distance that each object was moved.
        heap: (B,) bool; True where objects overlapped so deeply that they were spread to free places.
        valid: (B,) bool.
    """

    batch: SceneBatch
    converged: Tensor
    residual_depth: Tensor
    moved: Tensor
    heap: Tensor
    valid: Tensor


@dataclass(frozen=True)
class ReadyResult:
    """Scenes made ready for a simulator.

    Attributes:
        batch: Projected and settled scenes, each of its best round.
        ready: (B, N) bool; free objects that are simulation-ready there (see :func:`make_ready`).
        counts: (B,) int64, ready objects per scene.
        finished: (B,) bool; False where the scene's work budget was spent first: the batch is the best effort, and
            objects that were not judged are not ready. False also where ``valid`` is False.
        valid: (B,) bool; False where the first round could not judge the scene.
        furniture_depth: (B, N) m, :func:`furniture_overlap` of ``batch``; no object is ready where it is above 1 mm.
    """

    batch: SceneBatch
    ready: Tensor
    counts: Tensor
    finished: Tensor
    valid: Tensor
    furniture_depth: Tensor


def check_numbers(duration: float, **limits: float) -> None:
    """Raise InvalidInputError for a duration that is not a positive number, and for limits that are negative or NaN.

    >>> check_numbers(0.1, max_rotation=float("inf"))
    """
    if not 0 < duration < math.inf:
        raise InvalidInputError(f"duration={duration} must be a positive number of seconds")
    for name, limit in limits.items():
        if not limit >= 0:
            raise InvalidInputError(f"{name}={limit} must be at least 0")


def feasibility(
    batch: SceneBatch,
    *,
    max_penetration: float = 1e-3,
    max_displacement: float = 1e-3,
    max_rotation: float = 1e-2,
    duration: float = 0.1,
    pool: PhysicsPool | None = None,
    physics: str | None = None,
) -> FeasibilityResult:
    """Feasibility of every object: whether it overlaps another one, and whether it stays where it is.

    A free object is feasible when its frame is in the workspace, when it is in no object pair that overlaps deeper than
    ``max_penetration``, and when it moves and turns no further than the limits in ``duration`` seconds of simulation
    under gravity, after all overlapping objects are removed. Welded objects support others but are not judged. A scene
    whose simulation takes more work than :func:`settle` may spend is invalid. In a heap whose exact
    depths would take too long, ``depth`` is that of the enclosing coarse parts.

    Args:
        batch: B scenes of N slots.
        max_penetration: Largest overlap with another object, m.
        max_displacement: Largest motion of the object frame, m.
        max_rotation: Largest geodesic angle of rotation, rad.
        duration: Simulated time, s.
        pool: worker processes; None computes in this process.
        physics: engine; None takes that of the pool, else ``auto``.

    Raises:
        InvalidInputError: a pose is not finite, or a matrix is not a rotation; the message names its scene and slot. A
            limit is negative or NaN, or the duration is not a positive number.
        MissingDependencyError: the engine is not installed.
    """
    limits = {"max_penetration": max_penetration, "max_displacement": max_displacement, "max_rotation": max_rotation}
    check_numbers(duration, **limits)
    pool = chosen_pool(pool, physics)
    if pool.engine == "warp":
        return _feasibility_on_device(batch, duration, **limits)
    rows = run_kernel("feasibility", batch, limits | {"duration": duration}, pool)
    feasible = stack(rows, batch, "feasible", torch.bool) & batch.in_workspace.cpu()
    return FeasibilityResult(
        feasible=feasible,
        depth=stack(rows, batch, "depth"),
        displacement=stack(rows, batch, "displacement"),
        rotation=stack(rows, batch, "rotation"),
        valid=valid_rows(rows),
        counts=feasible.sum(dim=-1),
    )


def _feasibility_on_device(
    batch: SceneBatch, duration: float, *, max_penetration: float, max_displacement: float, max_rotation: float
) -> FeasibilityResult:
    """:func:`feasibility` by MuJoCo Warp; all tensors stay on the device of the batch."""
    from scene_envs.physics.warp import warp_engine

    require_rigid_poses(batch)
    engine, free = warp_engine(batch.scene_type, batch.tensor.device), batch.is_free
    found = engine.overlaps(batch)
    depth = torch.zeros_like(batch.translations[..., 0])
    for slot in (found.first, found.second):
        depth.view(-1).scatter_reduce_(0, found.scene * depth.shape[1] + slot, found.depth.float(), "amax")
    kept = free & (depth <= max_penetration)
    displacement, rotation, valid = _motion_on_device(batch.keeping(kept), duration)
    valid = valid & found.valid
    feasible = kept & (displacement <= max_displacement) & (rotation <= max_rotation) & batch.in_workspace
    judged = valid[:, None]
    feasible = feasible & judged
    motion = displacement * judged, rotation * judged
    return FeasibilityResult(feasible, depth * judged, *motion, valid, feasible.sum(dim=-1))


def _motion_on_device(batch: SceneBatch, duration: float) -> tuple[Tensor, Tensor, Tensor]:
    """Displacement (B, N) m and rotation (B, N) rad of free objects by MuJoCo Warp, and valid rows (B,)."""
    from scene_envs.physics.warp import warp_engine

    free = batch.is_free
    translations, rotations, valid = warp_engine(batch.scene_type, batch.tensor.device).simulate(batch, duration)
    still = torch.eye(3, device=free.device)
    before, after = (torch.where(free[..., None, None], turn, still) for turn in (batch.rotations, rotations))
    return (translations - batch.translations).norm(dim=-1) * free, geodesic_angle(before, after), valid


def penetration(batch: SceneBatch, *, pool: PhysicsPool | None = None, physics: str | None = None) -> PenetrationResult:
    """Overlap of every object pair, and the total over pairs of convex parts.

    No simulator is needed. A scene with a heap of objects whose exact depths would take too long is invalid.

    Raises InvalidInputError as :func:`feasibility` does.
    """
    rows = run_kernel("penetration", batch, {}, chosen_pool(pool, physics))
    pairs = tuple(
        tuple(ObjectPair((a, b), depth, total, parts) for a, b, depth, total, parts in (row["pairs"] if row else ()))
        for row in rows
    )
    return PenetrationResult(
        pairs=pairs,
        depth=stack(rows, batch, "depth"),
        total_per_pair=stack(rows, batch, "total_per_pair", shape=()),
        total_per_geometry=stack(rows, batch, "total_per_geometry", shape=()),
        valid=valid_rows(rows),
    )


def furniture_overlap(batch: SceneBatch, *, pool: PhysicsPool | None = None, physics: str | None = None) -> Tensor:
    """Deepest overlap of each generated welded object with any other welded one, (B, N) m; 0 in all other slots.

    Rooms generate their tables and shelves, which are welded. :func:`feasibility` and :func:`penetration` do not judge
    pairs of welded objects. No simulator is needed.

    Raises InvalidInputError as :func:`feasibility` does.

    >>> furniture_overlap(SceneBatch.empty("dimsum_table", 1)).any()
    tensor(False)
    """
    if not bool(batch.is_furniture.any()):
        return torch.zeros(batch.tensor.shape[:2])
    return stack(run_kernel("furniture", batch, {}, chosen_pool(pool, physics)), batch, "depth")


def equilibrium(
    batch: SceneBatch, *, duration: float = 0.1, pool: PhysicsPool | None = None, physics: str | None = None
) -> EquilibriumResult:
    """Displacement of every object under gravity in ``duration`` seconds, nothing removed.

    A heap is invalid: its objects overlap so deeply that its simulation would take too long. Project it first. A scene
    that takes more work than :func:`settle` may spend is invalid as well.

    Raises InvalidInputError and MissingDependencyError as :func:`feasibility` does.
    """
    check_numbers(duration)
    pool = chosen_pool(pool, physics)
    if pool.engine == "warp":
        require_rigid_poses(batch)
        return EquilibriumResult(*_motion_on_device(batch, duration))
    rows = run_kernel("equilibrium", batch, {"duration": duration}, pool)
    return EquilibriumResult(stack(rows, batch, "displacement"), stack(rows, batch, "rotation"), valid_rows(rows))


def settle(
    batch: SceneBatch,
    *,
    duration: float = 1.0,
    iterations: int = ITERATIONS,
    pool: PhysicsPool | None = None,
    physics: str | None = None,
) -> SettleResult:
    """Let every scene come to rest under gravity, with slight damping.

    The simulation lasts up to ``duration`` seconds and stops earlier when nothing moves any more. Objects that fall off
    their support end outside the workspace; they are stopped once they are a metre below it. A heap is invalid: its
    objects overlap so deeply that its simulation would take too long. Project it first. The work per scene has a limit,
    which is smaller if many objects overlap deeply (:mod:`scene_envs.physics.placement`). When the limit is reached,
    objects stay at the poses reached, and ``finished`` is False.

    Args:
        batch: B scenes of N slots.
        duration: Longest simulated time, s.
        iterations: Iterations of the contact solver per step; more of them leave smaller overlaps.
        pool: worker processes; None computes in this process.
        physics: engine; None takes that of the pool, else ``auto``.

    Raises InvalidInputError, also for fewer than one iteration or a duration that is not positive, and
    MissingDependencyError as :func:`feasibility` does.
    """
    if iterations < 1:
        raise InvalidInputError(f"iterations={iterations} must be at least 1")
    check_numbers(duration)
    rows = run_kernel("settle", batch, {"duration": duration, "iterations": iterations}, chosen_pool(pool, physics))
    settled, displacement, rotation = poses_after(rows, batch)
    finished = stack(rows, batch, "finished", torch.bool, shape=())
    return SettleResult(settled, displacement, rotation, finished, valid_rows(rows))


def project(batch: SceneBatch, *, pool: PhysicsPool | None = None, physics: str | None = None) -> ProjectionResult:
    """The nearest scenes without overlap: translations change, rotations and welded objects do not.

    Objects may touch. If there is no room to separate them, the best effort is returned and ``converged`` is False.

    Raises InvalidInputError as :func:`feasibility` does.
    """
    rows = run_kernel("project", batch, {}, chosen_pool(pool, physics))
    projected, moved, _ = poses_after(rows, batch)
    return ProjectionResult(
        batch=projected,
        converged=stack(rows, batch, "converged", torch.bool, shape=()),
        residual_depth=stack(rows, batch, "residual_depth", shape=()),
        moved=moved,
        heap=stack(rows, batch, "heap", torch.bool, shape=()),
        valid=valid_rows(rows),
    )
