"""Simulation-ready scenes: rounds of projection and settling, and the trials that a ready object passes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.physics.api import (
    ReadyResult,
    check_numbers,
    chosen_pool,
    furniture_overlap,
    poses_after,
    project,
    run_kernel,
    spent,
    stack,
    valid_rows,
)
from scene_envs.physics.correction import corrections
from scene_envs.physics.engines import CONVERGED, ITERATIONS
from scene_envs.physics.pool import PhysicsPool
from scene_envs.scene import SceneBatch

_READY_DEPTH = 1e-4
"""Deepest overlap (m) of a ready object with another one."""
_LEAN = 0.12
"""Tilt of gravity (rad) at which a ready object has to hold: an object that barely leans in one simulator creeps in
another."""
_STAYS: dict[str, Any] = {"max_displacement": 1e-3, "max_rotation": 1e-2}
_HOLDS: dict[str, Any] = {"max_displacement": 2e-3, "max_rotation": 2e-2, "duration": 0.5}
_LASTING: dict[str, Any] = {"duration": 2.0} | _STAYS
"""The longest trial: time (s) and limits of motion (m, rad). At the end it is repeated until it removes no object."""
_UPRIGHT: tuple[dict[str, Any], ...] = ({"duration": 0.1} | _STAYS, {"duration": 0.5} | _STAYS)
"""The shorter trials, made first in every round: they find most of the objects that move, at less cost."""
_LEANING: tuple[dict[str, Any], ...] = tuple(
    {"tilt": (x * _LEAN / math.sqrt(2), y * _LEAN / math.sqrt(2))} | _HOLDS for x in (-1, 1) for y in (-1, 1)
)
"""Trials with tilted gravity, in four directions. In a round they are made for scenes that pass the shorter trials, and
at the end for scenes that did not pass all trials of their round."""
_PATIENCE = 2
"""Number of rounds without more ready objects after which a scene has no further round."""
_ROUNDS_SHARE = 0.5
"""Share of a scene's work that the rounds may do; the rest is for the trials at the end."""
_UNMOVED = 1e-4
"""Motion (m) below which an object counts as independent of others that move."""
_FURNITURE, _APART = 1e-3, 5
"""Overlap (m) above which generated furniture moves apart, in up to so many rounds."""


def make_ready(
    batch: SceneBatch,
    *,
    duration: float = 1.5,
    rounds: int = 5,
    pool: PhysicsPool | None = None,
    physics: str | None = None,
) -> ReadyResult:
    """Project, settle, then count the simulation-ready objects.

    A free object is ready when it is inside the workspace, overlaps nothing deeper than 0.1 mm, and stays within 1 mm
    and 0.01 rad of its pose for 2 s of simulation, also after the objects that are not ready are removed. It also has
    to stay within 2 mm and 0.02 rad for half a second when gravity is tilted by 0.12 rad, in each of four directions.
    This test rejects leaning stacks that barely hold. Objects whose rest has a closed form need no simulation.

    Scenes with generated furniture that overlaps by more than 1 mm are first corrected as in guidance, in which pieces
    move apart with what stands on them. No object is ready in a scene in which some still overlap.

    Scenes with unready objects in the workspace go through projection and settling again, with more solver iterations,
    up to ``rounds`` times in all. They stop after two rounds in a row without more ready objects. The round with most
    ready objects is kept, the earliest of equal ones. A heap is invalid: its objects overlap so deeply that projection
    has to spread them. All rounds of a scene together may spend half of the work that :func:`settle` may spend, and the
    last trials the rest. If this does not suffice, the result is the best finished round, objects that were not judged
    are not ready, and ``finished`` is False.

    Args:
        batch: B scenes of N slots.
        duration: Longest time to settle in each round, s.
        rounds: Largest number of rounds per scene, at least 1.
        pool: worker processes; None computes in this process.
        physics: engine; None takes that of the pool, else ``auto``.

    Raises InvalidInputError, also for ``rounds`` below 1, and MissingDependencyError as :func:`feasibility` does.
    """
    if rounds < 1:
        raise InvalidInputError(f"rounds={rounds} must be at least 1: each projects and settles once")
    check_numbers(duration)
    pool = chosen_pool(pool, physics)
    batch, furniture = _furniture_apart(batch, pool)
    units = stack(run_kernel("units", batch, {}, pool), batch, "units", torch.float64, shape=())
    reserve = (1.0 - _ROUNDS_SHARE) * units
    units = units - reserve
    best = last = _make_ready_once(batch, duration, ITERATIONS, units, pool)
    tensor, ready, counts = best.batch.tensor.clone(), best.ready.clone(), best.counts.clone()
    lasting = best.lasting.clone()
    scenes = torch.arange(len(batch))  # scenes of the last round
    without_gain = torch.zeros(len(batch), dtype=torch.int64)  # rounds in a row
    for _ in range(rounds - 1):
        unready = last.batch.is_free & last.batch.in_workspace & ~last.ready
        again = last.finished & (without_gain[scenes] < _PATIENCE) & unready.any(dim=-1)
        if not again.any():
            break
        scenes = scenes[again]
        left = units[scenes]
        last = _make_ready_once(last.batch[again.nonzero()[:, 0]], duration, CONVERGED, left, pool, last.ready[again])
        units[scenes] = left
        better = last.counts > counts[scenes]
        without_gain[scenes] = (without_gain[scenes] + 1) * ~better
        improved = scenes[better]
        tensor[improved], ready[improved] = last.batch.tensor[better], last.ready[better]
        counts[improved], lasting[improved] = last.counts[better], last.lasting[better]
    final = SceneBatch(tensor, best.batch.scene_type)
    finished = best.valid & (units > 0)
    due = (~lasting).nonzero()[:, 0]
    left = (units + reserve)[due]
    ready[due] = _strike(final[due], ready[due], _LEANING, left, pool)
    ready[due] = _strike_until_still(final[due], ready[due], left, pool)
    finished[due] &= left > 0
    ready &= (furniture <= _FURNITURE).all(dim=-1, keepdim=True)
    return ReadyResult(final, ready, ready.sum(dim=-1), finished, best.valid, furniture)


def _furniture_apart(batch: SceneBatch, pool: PhysicsPool) -> tuple[SceneBatch, Tensor]:
    """The scenes after overlapping furniture moved apart, and the overlap (B, N) m of each piece that is left."""
    depth = furniture_overlap(batch, pool=pool)
    for _ in range(_APART):
        rows = (depth > _FURNITURE).any(dim=-1)
        if rows.any():
            translations = batch.translations.clone()
            translations[rows] += corrections(batch[rows], torch.ones(3))
            batch = batch.with_poses(translations, batch.rotations)
            depth[rows] = furniture_overlap(batch[rows], pool=pool)
    return batch, depth


@dataclass(frozen=True, eq=False)
class _Round:
    """Scenes after one round of :func:`make_ready`."""

    batch: SceneBatch  # settled scenes
    ready: Tensor  # (B, N) free objects that passed the trials of a round
    valid: Tensor  # (B,) whether projection and settling gave an answer
    finished: Tensor  # (B,) whether the round ended before its work was spent
    lasting: Tensor  # (B,) whether all trials of the round were made, the longest included, and no object moved in them

    @property
    def counts(self) -> Tensor:
        """(B,) ready objects."""
        return self.ready.sum(dim=-1)


def _make_ready_once(
    batch: SceneBatch, duration: float, iterations: int, units: Tensor, pool: PhysicsPool, calm: Tensor | None = None
) -> _Round:
    """One round of :func:`make_ready`, in which the ``calm`` (B, N) objects stand still unless others reach them; the
    work done is subtracted from ``units`` (B,), in place.
    """
    projected = project(batch, pool=pool)
    rows = (projected.valid & ~projected.heap).nonzero()[:, 0]
    options = {"duration": duration, "iterations": iterations}
    settling = run_kernel(
        "settle", projected.batch[rows], options, pool, units[rows], None if calm is None else calm[rows]
    )
    settled, settled_valid = poses_after(settling, projected.batch[rows])[0], valid_rows(settling)
    left = units[rows] - spent(settling)
    tensor, ready = projected.batch.tensor.clone(), torch.zeros_like(projected.batch.is_empty)
    valid, lasting = torch.zeros(len(batch), dtype=torch.bool), torch.zeros(len(batch), dtype=torch.bool)
    still, lasting[rows] = _judge_round(settled, left, pool)
    tensor[rows], ready[rows] = settled.tensor, still & settled_valid[:, None]
    units[rows], valid[rows] = left, settled_valid
    return _Round(SceneBatch(tensor, batch.scene_type), ready, valid, valid & (units > 0), lasting)


def _judge_round(batch: SceneBatch, units: Tensor, pool: PhysicsPool) -> tuple[Tensor, Tensor]:
    """(B, N) free objects that stay in the trials of a round, and (B,) whether all objects stayed in all trials. Only
    scenes in which every free object in the workspace stays in the shorter trials go on to tilted gravity, then the
    longest trial; others have another round. The work done is subtracted from ``units`` (B,), in place.
    """
    candidates = batch.is_free & batch.in_workspace
    ready = _strike(batch, candidates & (units > 0)[:, None], _UPRIGHT, units, pool)
    complete = ((ready == candidates).all(dim=-1) & (units > 0)).nonzero()[:, 0]
    lasting = torch.zeros(len(batch), dtype=torch.bool)
    for trials in (_LEANING, (_LASTING,)):
        left = units[complete]
        stays = _strike(batch[complete], ready[complete], trials, left, pool)
        unmoved = (stays == ready[complete]).all(dim=-1)
        ready[complete], units[complete] = stays, left
        complete = complete[unmoved]
    lasting[complete] = True
    return ready, lasting


def _strike(
    batch: SceneBatch, ready: Tensor, trials: Sequence[dict[str, Any]], units: Tensor, pool: PhysicsPool
) -> Tensor:
    """``ready`` (B, N) without the objects that move in a trial; each trial is made without those removed before."""
    ready = ready.clone()
    scenes = ready.any(dim=-1).nonzero()[:, 0]
    for trial in trials if len(scenes) else ():
        ready[scenes] &= _judge(batch[scenes].keeping(ready[scenes]), scenes, trial, units, pool)[0]
    return ready


def _strike_until_still(batch: SceneBatch, ready: Tensor, units: Tensor, pool: PhysicsPool) -> Tensor:
    """``ready`` (B, N) without the objects that move in the longest trial, which is repeated where it removed objects,
    until it removes none. Repetitions that remove objects remove all that moved in them by ``_UNMOVED`` or more.
    """
    ready = ready.clone()
    scenes, repeated = ready.any(dim=-1).nonzero()[:, 0], False
    while len(scenes):
        feasible, displacement = _judge(batch[scenes].keeping(ready[scenes]), scenes, _LASTING, units, pool)
        struck = (ready[scenes] & ~feasible).any(dim=-1)
        ready[scenes] &= feasible & ((displacement < _UNMOVED) | ~struck[:, None] | (not repeated))
        scenes, repeated = scenes[struck & ready[scenes].any(dim=-1)], True
    return ready


def _judge(
    kept: SceneBatch, scenes: Tensor, trial: dict[str, Any], units: Tensor, pool: PhysicsPool
) -> tuple[Tensor, Tensor]:
    """Objects (b, N) that keep their pose, none in invalid scenes, and the displacement (b, N) m of all objects."""
    options = {"max_penetration": _READY_DEPTH} | trial
    rows = run_kernel("feasibility", kept, options, pool, units[scenes])
    units[scenes] -= spent(rows)
    return stack(rows, kept, "feasible", torch.bool), stack(rows, kept, "displacement")
