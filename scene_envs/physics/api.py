"""Public functions of the physics: batches of scenes in, results per scene and object out."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.physics.batches import poses_after, run_kernel, stack, valid_rows
from scene_envs.physics.motion import ITERATIONS
from scene_envs.physics.pool import PhysicsPool
from scene_envs.physics.results import (
    EquilibriumResult,
    FeasibilityResult,
    ObjectPair,
    PenetrationResult,
    ProjectionResult,
    SettleResult,
)
from scene_envs.scene import SceneBatch


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

    Raises:
        InvalidInputError: a pose is not finite, or a matrix is not a rotation; the message names its scene and slot. A
            limit is negative or NaN, or the duration is not a positive number.
        MissingDependencyError: pybullet is not installed.
    """
    check_numbers(
        duration, max_penetration=max_penetration, max_displacement=max_displacement, max_rotation=max_rotation
    )
    options = {
        "max_penetration": max_penetration,
        "max_displacement": max_displacement,
        "max_rotation": max_rotation,
        "duration": duration,
    }
    rows = run_kernel("feasibility", batch, options, pool)
    feasible = stack(rows, batch, "feasible", torch.bool) & batch.in_workspace.cpu()
    return FeasibilityResult(
        feasible=feasible,
        depth=stack(rows, batch, "depth"),
        displacement=stack(rows, batch, "displacement"),
        rotation=stack(rows, batch, "rotation"),
        valid=valid_rows(rows),
        counts=feasible.sum(dim=-1),
    )


def penetration(batch: SceneBatch, *, pool: PhysicsPool | None = None) -> PenetrationResult:
    """Overlap of every object pair, and the total over pairs of convex parts.

    No simulator is needed. A scene with a heap of objects whose exact depths would take too long is invalid.

    Raises InvalidInputError as :func:`feasibility` does.
    """
    rows = run_kernel("penetration", batch, {}, pool)
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


def furniture_overlap(batch: SceneBatch, *, pool: PhysicsPool | None = None) -> Tensor:
    """Deepest overlap of each generated welded object with any other welded one, (B, N) m; 0 in all other slots.

    Rooms generate their tables and shelves, which are welded. :func:`feasibility` and :func:`penetration` do not judge
    pairs of welded objects. No simulator is needed.

    Raises InvalidInputError as :func:`feasibility` does.

    >>> furniture_overlap(SceneBatch.empty("dimsum_table", 1)).any()
    tensor(False)
    """
    if not bool(batch.is_furniture.any()):
        return torch.zeros(batch.tensor.shape[:2])
    return stack(run_kernel("furniture", batch, {}, pool), batch, "depth")


def equilibrium(batch: SceneBatch, *, duration: float = 0.1, pool: PhysicsPool | None = None) -> EquilibriumResult:
    """Displacement of every object under gravity in ``duration`` seconds, nothing removed.

    A heap is invalid: its objects overlap so deeply that its simulation would take too long. Project it first. A scene
    that takes more work than :func:`settle` may spend is invalid as well.

    Raises InvalidInputError and MissingDependencyError as :func:`feasibility` does.
    """
    check_numbers(duration)
    rows = run_kernel("equilibrium", batch, {"duration": duration}, pool)
    return EquilibriumResult(stack(rows, batch, "displacement"), stack(rows, batch, "rotation"), valid_rows(rows))


def settle(
    batch: SceneBatch, *, duration: float = 1.0, iterations: int = ITERATIONS, pool: PhysicsPool | None = None
) -> SettleResult:
    """Let every scene come to rest under gravity, with slight damping.

    The simulation lasts up to ``duration`` seconds and stops earlier when nothing moves any more. Objects that fall off
    their support end outside the workspace; they are stopped once they are a metre below it. A heap is invalid: its
    objects overlap so deeply that its simulation would take too long. Project it first. The work per scene has a limit,
    which is smaller if many objects overlap deeply (:mod:`scene_envs.physics.budget`). When the limit is reached,
    objects stay at the poses reached, and ``finished`` is False.

    Args:
        batch: B scenes of N slots.
        duration: Longest simulated time, s.
        iterations: Iterations of the contact solver per step; more of them leave smaller overlaps.
        pool: worker processes; None computes in this process.

    Raises InvalidInputError, also for fewer than one iteration or a duration that is not positive, and
    MissingDependencyError as :func:`feasibility` does.
    """
    if iterations < 1:
        raise InvalidInputError(f"iterations={iterations} must be at least 1")
    check_numbers(duration)
    rows = run_kernel("settle", batch, {"duration": duration, "iterations": iterations}, pool)
    settled, displacement, rotation = poses_after(rows, batch)
    finished = stack(rows, batch, "finished", torch.bool, shape=())
    return SettleResult(settled, displacement, rotation, finished, valid_rows(rows))


def project(batch: SceneBatch, *, pool: PhysicsPool | None = None) -> ProjectionResult:
    """The nearest scenes without overlap: translations change, rotations and welded objects do not.

    Objects may touch. If there is no room to separate them, the best effort is returned and ``converged`` is False.

    Raises InvalidInputError as :func:`feasibility` does.
    """
    rows = run_kernel("project", batch, {}, pool)
    projected, moved, _ = poses_after(rows, batch)
    return ProjectionResult(
        batch=projected,
        converged=stack(rows, batch, "converged", torch.bool, shape=()),
        residual_depth=stack(rows, batch, "residual_depth", shape=()),
        moved=moved,
        heap=stack(rows, batch, "heap", torch.bool, shape=()),
        valid=valid_rows(rows),
    )
