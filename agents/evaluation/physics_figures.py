"""Overlap and stability figures of scenes, computed from physics."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.physics import ObjectPair, PenetrationResult, PhysicsPool

logger = logging.getLogger(__name__)

CONTACT = 1e-5
"""Largest overlap (m) of hulls in contact; float32 poses are not more precise."""
COLLISION = 1e-3
"""Overlap (m) above which a pair collides."""
DEEP = 1e-2
"""Overlap (m) above which objects are not simulated, because a simulator would throw them apart."""
STABLE_SCENES, STABLE_TIME, STABLE_WAY, STABLE_ANGLE = 200, 2.0, 1e-2, 0.1
"""Stability as the literature counts it: number of scenes that are simulated, how long (s), and the displacement (m)
and rotation (rad) that a stable object stays below."""


@contextlib.contextmanager
def leaving_out(name: str, left_out: dict[str, str]) -> Iterator[None]:
    """Context of figures ``name`` that are left out where a package for them is not installed: the message of the
    MissingDependencyError is logged and kept in ``left_out``.

    >>> left_out: dict[str, str] = {}
    >>> with leaving_out("feasible", left_out):
    ...     raise MissingDependencyError("no simulator is installed")
    >>> left_out
    {'feasible': 'no simulator is installed'}
    """
    try:
        yield
    except MissingDependencyError as error:
        left_out[name] = str(error)
        logger.warning("%s left out: %s", name, error)


def physics_figures(
    batch: SceneBatch, pool: PhysicsPool | None = None, left_out: dict[str, str] | None = None
) -> dict[str, float]:
    """Overlap, stability and feasibility of scenes as they are; docs/evaluation.md describes each figure.

    Scenes whose physics failed are left out of the figures of that computation.

    Args:
        batch: scenes to measure.
        pool: worker processes; None computes in this process.
        left_out: gets the reason under ``"feasible"`` where no simulator is installed, and stability and feasibility
            are left out then; with None this raises a MissingDependencyError.
    """
    figures = {**_overlap(batch, pool), **_furniture(batch, pool)}
    with contextlib.nullcontext() if left_out is None else leaving_out("feasible", left_out):
        figures |= _feasibility(batch, pool)
    return figures


def ready_figures(batch: SceneBatch, pool: PhysicsPool | None = None) -> dict[str, float]:
    """Objects that are simulation-ready after projection and settling."""
    from scene_envs.physics import make_ready

    result = make_ready(batch, pool=pool)
    figures = {"ready_invalid_fraction": 1.0 - float(result.valid.double().mean())}
    return {**figures, **per_scene_and_fraction("ready", batch, result.counts, result.valid)}


def stability_figures(batch: SceneBatch, pool: PhysicsPool | None = None) -> dict[str, float]:
    """Free objects that move less than 1 cm and turn less than 0.1 rad in 2 s of simulation, with nothing removed, in
    the first 200 scenes. These are the thresholds of SceneEval and SceneSmith. Scenes whose physics failed, heaps
    among them, are counted, and left out of the share.
    """
    from scene_envs.physics import equilibrium

    batch = batch[:STABLE_SCENES]
    result = equilibrium(batch, duration=STABLE_TIME, pool=pool)
    figures = {"stable_2s_invalid_fraction": 1.0 - float(result.valid.double().mean())}
    free = batch.is_free.cpu() & result.valid.unsqueeze(-1)
    if bool(free.any()):
        stable = (result.displacement < STABLE_WAY) & (result.rotation < STABLE_ANGLE)
        figures["stable_2s_fraction"] = float(stable[free].double().mean())
    return figures


def stable_fraction(batch: SceneBatch, *, pool: PhysicsPool | None = None) -> float:
    """Share of free objects that move at most 1 mm and turn at most 0.01 rad in 0.1 s of simulation.

    Overlaps up to 1 cm are allowed. Objects with deeper overlaps count as not stable, and are removed before the others
    are simulated.

    Raises:
        InvalidInputError: no scene that the physics could judge holds a free object.
        MissingDependencyError: no simulator is installed.
    """
    from scene_envs.physics import feasibility

    result = feasibility(batch, max_penetration=DEEP, pool=pool)
    free = batch.is_free.cpu() & result.valid.unsqueeze(-1)
    if not bool(free.any()):
        raise InvalidInputError("no free object was simulated, so there is no stable fraction")
    return float(result.feasible[free].double().mean())


def _overlap(batch: SceneBatch, pool: PhysicsPool | None) -> dict[str, float]:
    from scene_envs.physics import penetration

    result = penetration(batch, pool=pool)
    scenes = _valid_pairs(result)
    if not scenes:
        return {}
    of_parts = [sum(pair.total for pair in pairs) for pairs in scenes]  # the literature's: more parts, more overlap
    of_objects = [sum(pair.depth for pair in pairs) for pairs in scenes]
    figures = {
        "median_total_penetration_cm": 100 * float(np.median(of_parts)),
        "median_total_pair_penetration_cm": 100 * float(np.median(of_objects)),
        "collision_rate": float(np.mean([any(pair.depth > COLLISION for pair in pairs) for pairs in scenes])),
    }
    depths = [pair.depth for pairs in scenes for pair in pairs]
    figures["overlapping_pairs"] = len(depths) / len(scenes)
    if depths:
        figures["overlap_median_mm"] = 1e3 * float(np.quantile(depths, 0.5))
        figures["overlap_p95_mm"] = 1e3 * float(np.quantile(depths, 0.95))
    free = batch.is_free.cpu() & result.valid.unsqueeze(-1)
    if bool(free.any()):
        figures["deeper_than_1mm_fraction"] = float((result.depth[free] > COLLISION).double().mean())
        figures["deeper_than_1cm_fraction"] = float((result.depth[free] > DEEP).double().mean())
    return figures


def _furniture(batch: SceneBatch, pool: PhysicsPool | None) -> dict[str, float]:
    from scene_envs.physics import furniture_overlap

    if not batch.scene_type.furniture_categories:
        return {}
    collides = furniture_overlap(batch, pool=pool) > COLLISION
    return {"furniture_collision_rate": float(collides.any(dim=1).double().mean())}


def _feasibility(batch: SceneBatch, pool: PhysicsPool | None) -> dict[str, float]:
    from scene_envs.physics import feasibility

    result = feasibility(batch, pool=pool)
    figures = {"invalid_fraction": 1.0 - float(result.valid.double().mean())}
    with contextlib.suppress(InvalidInputError):
        figures["stable_fraction"] = stable_fraction(batch, pool=pool)
    return {**figures, **per_scene_and_fraction("feasible", batch, result.counts, result.valid)}


def per_scene_and_fraction(name: str, batch: SceneBatch, counts: Tensor, valid: Tensor) -> dict[str, float]:
    """Mean of ``counts`` (B,) over valid scenes, and their sum as a share of the free objects there."""
    figures = {}
    if bool(valid.any()):
        figures[f"{name}_objects"] = float(counts[valid].double().mean())
        free = int(batch.is_free.cpu()[valid].sum())
        if free:
            figures[f"{name}_fraction"] = int(counts[valid].sum()) / free
    return figures


def _valid_pairs(result: PenetrationResult) -> list[list[ObjectPair]]:
    """The penetrating pairs of each valid scene."""
    return [
        [pair for pair in pairs if pair.depth > CONTACT]
        for pairs, valid in zip(result.pairs, result.valid.tolist(), strict=True)
        if valid
    ]
