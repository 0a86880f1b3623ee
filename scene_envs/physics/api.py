"""The public functions of the physics: batches of scenes in, results per scene and object out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.physics.kernels import Chunk
from scene_envs.physics.motion import CONVERGED, ITERATIONS
from scene_envs.physics.pool import PhysicsPool, run_in_process
from scene_envs.physics.results import (
    EquilibriumResult,
    FeasibilityResult,
    ObjectPair,
    PenetrationResult,
    ProjectionResult,
    ReadyResult,
    SettleResult,
)
from scene_envs.rotations import geodesic_angle, project_to_so3
from scene_envs.scene import SceneBatch

_READY_DEPTH = 1e-4
"""How deep a ready object may overlap another one (m)."""
_READY_DURATIONS = (0.1, 0.5, 2.0, 2.0)
"""Times (s) for which it stays where it is, judged one after the other."""
_PATIENCE = 2
"""Rounds without more ready objects after which a scene is left as it is."""
_UNMOVED = 1e-4
"""Motion (m) below which an object is believed not to depend on others that move."""
_CHUNK = 8
"""Scenes per message to a worker."""
_ORTHOGONAL = 1e-3
"""Largest entry of R^T R - I that still passes for a rotation."""


def feasibility(
    batch: SceneBatch,
    *,
    max_penetration: float = 1e-3,
    max_displacement: float = 1e-3,
    max_rotation: float = 1e-2,
    duration: float = 0.1,
    pool: PhysicsPool | None = None,
) -> FeasibilityResult:
    """Judge every object: does it overlap another, and does it stay where it is.

    A free object is feasible when its frame is in the workspace, it is in no object pair that overlaps deeper than
    ``max_penetration`` and, with all such objects removed, moves and turns no further than the limits in ``duration``
    seconds of simulation under gravity. Welded objects hold others but are not judged.

    Args:
        batch: B scenes of N slots.
        max_penetration: m.
        max_displacement: m, of the object frame.
        max_rotation: rad, geodesic.
        duration: s.
        pool: worker processes; None computes in this process.

    Raises:
        InvalidInputError: a pose is not finite, or a rotation is not one; its scene and slot are named.
        MissingDependencyError: pybullet is not installed.
    """
    options = {
        "max_penetration": max_penetration,
        "max_displacement": max_displacement,
        "max_rotation": max_rotation,
        "duration": duration,
    }
    rows = _run("feasibility", batch, options, pool)
    feasible = _stack(rows, batch, "feasible", torch.bool) & batch.in_workspace.cpu()
    return FeasibilityResult(
        feasible=feasible,
        depth=_stack(rows, batch, "depth"),
        displacement=_stack(rows, batch, "displacement"),
        rotation=_stack(rows, batch, "rotation"),
        valid=_valid(rows),
        counts=feasible.sum(dim=-1),
    )


def penetration(batch: SceneBatch, *, pool: PhysicsPool | None = None) -> PenetrationResult:
    """Overlap of every object pair, and in total over pairs of convex parts.

    Needs no simulator. Raises InvalidInputError as :func:`feasibility` does.
    """
    rows = _run("penetration", batch, {}, pool)
    pairs = tuple(
        tuple(ObjectPair((a, b), depth, total, parts) for a, b, depth, total, parts in (row["pairs"] if row else ()))
        for row in rows
    )
    return PenetrationResult(
        pairs=pairs,
        depth=_stack(rows, batch, "depth"),
        total_per_pair=_stack(rows, batch, "total_per_pair", shape=()),
        total_per_geometry=_stack(rows, batch, "total_per_geometry", shape=()),
        valid=_valid(rows),
    )


def equilibrium(batch: SceneBatch, *, duration: float = 0.1, pool: PhysicsPool | None = None) -> EquilibriumResult:
    """Displacement of every object under gravity in ``duration`` seconds, nothing removed.

    A heap of objects so deep in each other that its simulation would take long is invalid: project it first.

    Raises InvalidInputError and MissingDependencyError as :func:`feasibility` does.
    """
    rows = _run("equilibrium", batch, {"duration": duration}, pool)
    return EquilibriumResult(_stack(rows, batch, "displacement"), _stack(rows, batch, "rotation"), _valid(rows))


def settle(
    batch: SceneBatch, *, duration: float = 1.0, iterations: int = ITERATIONS, pool: PhysicsPool | None = None
) -> SettleResult:
    """Let every scene come to rest under gravity, with slight damping.

    Simulates up to ``duration`` seconds, and stops earlier when nothing moves any more. Objects that fall off
    their support are where they fell to, outside the workspace; those more than a metre below it stay there. A heap
    of objects so deep in each other that its simulation would take long is invalid: project it first.

    Args:
        batch: B scenes of N slots.
        duration: s.
        iterations: of the contact solver per step; more of them leave smaller overlaps.
        pool: worker processes; None computes in this process.

    Raises InvalidInputError, also for fewer than one iteration, and MissingDependencyError as :func:`feasibility`
    does.
    """
    if iterations < 1:
        raise InvalidInputError(f"iterations={iterations} must be at least 1")
    rows = _run("settle", batch, {"duration": duration, "iterations": iterations}, pool)
    settled, displacement, rotation = _moved(rows, batch)
    return SettleResult(settled, displacement, rotation, _valid(rows))


def project(batch: SceneBatch, *, pool: PhysicsPool | None = None) -> ProjectionResult:
    """The nearest scenes without overlap: translations change, rotations and welded objects do not.

    Touching is allowed. Where objects cannot be separated (more of them than room), the best effort is
    returned and ``converged`` is False.

    Raises InvalidInputError as :func:`feasibility` does.
    """
    rows = _run("project", batch, {}, pool)
    projected, moved, _ = _moved(rows, batch)
    return ProjectionResult(
        batch=projected,
        converged=_stack(rows, batch, "converged", torch.bool, shape=()),
        residual_depth=_stack(rows, batch, "residual_depth", shape=()),
        moved=moved,
        heap=_stack(rows, batch, "heap", torch.bool, shape=()),
        valid=_valid(rows),
    )


def make_ready(
    batch: SceneBatch, *, duration: float = 1.5, rounds: int = 5, pool: PhysicsPool | None = None
) -> ReadyResult:
    """Project, settle, then count the simulation-ready objects.

    A free object is ready when it is inside the workspace, overlaps nothing deeper than 0.1 mm, and stays within 1 mm
    and 0.01 rad of where it is for 2 s of simulation, also without the objects that are not ready. Scenes with objects
    in the workspace that are not ready go through projection and settling again, with more solver iterations, up to
    ``rounds`` times in all, until two in a row have made no more of them ready. The round with most ready objects is
    kept, the earliest of equal ones. A heap, whose objects are so deep in each other that projection has to spread
    them, is invalid.

    Args:
        batch: B scenes of N slots.
        duration: longest time to settle in each round, s.
        rounds: most rounds per scene, at least 1.
        pool: worker processes; None computes in this process.

    Raises InvalidInputError, also for ``rounds`` below 1, and MissingDependencyError as :func:`feasibility` does.
    """
    if rounds < 1:
        raise InvalidInputError(f"rounds={rounds} must be at least 1: each projects and settles once")
    best = last = _make_ready_once(batch, duration, ITERATIONS, pool)
    tensor, ready, counts = best.batch.tensor.clone(), best.ready.clone(), best.counts.clone()
    scenes = torch.arange(len(batch))  # that went through the last round
    without_gain = torch.zeros(len(batch), dtype=torch.int64)  # rounds in a row
    for _ in range(rounds - 1):
        unready = last.batch.is_free & last.batch.in_workspace & ~last.ready
        again = (last.valid & (without_gain[scenes] < _PATIENCE) & unready.any(dim=-1)).nonzero()[:, 0]
        if not len(again):
            break
        scenes = scenes[again]
        last = _make_ready_once(last.batch[again], duration, CONVERGED, pool)
        better = last.counts > counts[scenes]
        without_gain[scenes] = (without_gain[scenes] + 1) * ~better
        improved = scenes[better]
        tensor[improved], ready[improved] = last.batch.tensor[better], last.ready[better]
        counts[improved] = last.counts[better]
    return ReadyResult(SceneBatch(tensor, best.batch.scene_type), ready, counts, best.valid)


def _keep(batch: SceneBatch, kept: Tensor) -> SceneBatch:
    """The scenes with all free objects but ``kept`` (B, N) removed."""
    categories = batch.categories.masked_fill(batch.is_free & ~kept, batch.scene_type.num_assets)
    return SceneBatch.from_parts(batch.translations, batch.rotations, categories, batch.scene_type)


def _make_ready_once(batch: SceneBatch, duration: float, iterations: int, pool: PhysicsPool | None) -> ReadyResult:
    """One round of :func:`make_ready`."""
    projected = project(batch, pool=pool)
    rows = (projected.valid & ~projected.heap).nonzero()[:, 0]
    settled = settle(projected.batch[rows], duration=duration, iterations=iterations, pool=pool)
    tensor, ready = projected.batch.tensor.clone(), torch.zeros_like(projected.batch.is_empty)
    tensor[rows], ready[rows] = settled.batch.tensor, _judge_ready(settled.batch, pool) & settled.valid[:, None]
    valid = torch.zeros(len(batch), dtype=torch.bool)
    valid[rows] = settled.valid
    return ReadyResult(SceneBatch(tensor, batch.scene_type), ready, ready.sum(dim=-1), valid)


def _judge_ready(batch: SceneBatch, pool: PhysicsPool | None) -> Tensor:
    """(B, N) free objects that are simulation-ready; see :func:`make_ready`.

    What moves at once is struck first, then what moves later or without what was struck. Where the last judgement
    still strikes something, everything that moved is struck with it.
    """
    ready = batch.is_free & batch.in_workspace
    scenes = ready.any(dim=-1).nonzero()[:, 0]
    for duration in _READY_DURATIONS:
        if not len(scenes):
            break
        kept = _keep(batch[scenes], ready[scenes])
        judged = feasibility(kept, max_penetration=_READY_DEPTH, duration=duration, pool=pool)
        feasible = judged.feasible & judged.valid[:, None]
        struck = (ready[scenes] & ~feasible).any(dim=-1)
        ready[scenes] &= feasible
        still = judged.displacement < _UNMOVED
        if duration == _READY_DURATIONS[-1]:
            scenes, still = scenes[struck], still[struck]
    if len(scenes):
        ready[scenes] &= still
    return ready


# -- from and to tensors ------------------------------------------------------------------------


def _run(
    kernel: str, batch: SceneBatch, options: dict[str, Any], pool: PhysicsPool | None
) -> list[dict[str, Any] | None]:
    _check(batch)
    translations = batch.translations.double().cpu().numpy()
    rotations = batch.rotations.double().cpu().numpy()
    categories = batch.categories.cpu().numpy()
    workers = max(1, pool.workers) if pool else 1
    size = max(1, min(_CHUNK, -(-len(batch) // workers)))
    chunks = [
        Chunk(batch.scene_type, translations[i : i + size], rotations[i : i + size], categories[i : i + size])
        for i in range(0, len(batch), size)
    ]
    run: Callable[..., list[dict[str, Any] | None]] = pool.run if pool else run_in_process
    return run(kernel, chunks, options)


def _check(batch: SceneBatch) -> None:
    present = ~batch.is_empty
    finite = torch.isfinite(batch.tensor[..., :12]).all(dim=-1)
    product = batch.rotations.transpose(-1, -2) @ batch.rotations - torch.eye(3, device=batch.tensor.device)
    rotation = (product.abs().amax(dim=(-1, -2)) < _ORTHOGONAL) & (torch.linalg.det(batch.rotations) > 0)
    for good, what in ((finite, "a pose that is not finite"), (rotation, "a matrix that is not a rotation")):
        bad = torch.nonzero(present & ~good)
        if len(bad):
            scene, slot = bad[0].tolist()
            raise InvalidInputError(
                f"scene {scene}, slot {slot} holds {what}: {batch.tensor[scene, slot, :12].tolist()}; "
                "SceneBatch.from_tensor makes valid poses of a sampler's output"
            )


def _valid(rows: list[dict[str, Any] | None]) -> Tensor:
    return torch.tensor([row is not None and bool(row["valid"]) for row in rows], dtype=torch.bool)


def _stack(
    rows: list[dict[str, Any] | None],
    batch: SceneBatch,
    name: str,
    dtype: torch.dtype = torch.float32,
    shape: tuple[int, ...] | None = None,
) -> Tensor:
    """(B, N) tensor of a named result (or (B, *shape)), zeros where a row is invalid."""
    shape = (batch.tensor.shape[1],) if shape is None else shape
    out = torch.zeros(len(rows), *shape, dtype=dtype)
    for index, row in enumerate(rows):
        if row is not None and row["valid"]:
            out[index] = torch.as_tensor(np.asarray(row[name]), dtype=dtype)
    return out


def _moved(rows: list[dict[str, Any] | None], batch: SceneBatch) -> tuple[SceneBatch, Tensor, Tensor]:
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
    before = torch.where(present[..., None, None], batch.rotations, identity)
    after = torch.where(present[..., None, None], project_to_so3(rotations), identity)
    return batch.with_poses(translations, after), displacement, geodesic_angle(before, after) * present
