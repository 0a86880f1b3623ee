"""One flat dict of numbers that says how good scenes are: for model cards, reports and the command line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import numpy as np
from torch import Tensor

from agents.evaluation.metrics import category_kl, count_wasserstein, height_errors, workspace_fraction
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool

FLOOR_PREFIX = "floor_"
"""Prefix of the figures of real scenes measured against other real scenes."""

CONTACT = 1e-5
"""Pairs whose hulls overlap by less than this (m) are in contact, not penetrating: float32 poses are no finer."""


class Sampler(Protocol):
    """What :func:`evaluate_prior` needs of a prior; ``agents.prior.ScenePrior`` has it."""

    @property
    def scene_type(self) -> SceneType: ...

    def sample(
        self, count: int, *, num_steps: int = ..., slots: int | None = ..., seed: int = ..., batch_size: int = ...
    ) -> SceneBatch: ...


def measure_samples(
    batch: SceneBatch,
    reference: SceneBatch,
    *,
    floor: SceneBatch | None = None,
    pool: PhysicsPool | None = None,
    ready: bool = True,
) -> dict[str, float]:
    """Measure scenes against reference scenes.

    Objects include welded ones, *free* objects do not. A figure without data (no stack in any scene, say) is left
    out. Scenes whose physics failed leave the figures of that computation and are counted in
    ``invalid_fraction`` or ``ready_invalid_fraction``.

    Args:
        batch: the scenes to measure.
        reference: real scenes of the same type.
        floor: other real scenes; each figure is measured on them too, under ``floor_<name>``: what a perfect sampler
            would score.
        pool: worker processes for physics; None computes in this process.
        ready: whether to project and settle as well, the slowest part.

    Returns:
        ``scenes``; ``objects_mean``, ``objects_min``, ``objects_max``, ``free_objects_mean``; ``category_kl`` (nats,
        KL(reference ‖ samples)); ``count_wasserstein`` (objects); ``workspace_fraction`` of objects;
        ``height_error_<kind>_mm`` and ``height_error_<kind>_p95_mm`` (median and 95 % quantile of
        :func:`~agents.evaluation.metrics.height_errors`); ``overlap_median_mm`` and ``overlap_p95_mm`` over
        penetrating object pairs, and ``overlapping_pairs`` of them per scene; ``deeper_than_1mm_fraction`` and
        ``deeper_than_1cm_fraction`` of free objects; ``feasible_objects`` per scene and ``feasible_fraction`` of free
        objects, both raw; with ``ready``, ``ready_objects`` per scene and ``ready_fraction`` of free objects, both
        after projection and settling; ``invalid_fraction`` of scenes whose feasibility could not be computed, and
        ``ready_invalid_fraction``.
    """
    if not len(batch) or not len(reference):
        raise InvalidInputError(f"cannot measure {len(batch)} scenes against {len(reference)}: both need at least one")
    figures = {
        **_layout_figures(batch, reference),
        **_overlap_figures(batch, pool),
        **_feasibility_figures(batch, pool),
        **(_ready_figures(batch, pool) if ready else {}),
    }
    if floor is not None:
        real = measure_samples(floor, reference, pool=pool, ready=ready)
        figures.update({FLOOR_PREFIX + name: value for name, value in real.items()})
    return figures


def evaluate_prior(
    prior: Sampler | str,
    count: int = 500,
    reference: SceneBatch | None = None,
    *,
    floor: SceneBatch | None = None,
    num_steps: int = 50,
    seed: int = 0,
    batch_size: int = 64,
    pool: PhysicsPool | None = None,
    ready: bool = True,
) -> dict[str, float]:
    """Sample a prior and measure its raw samples.

    Args:
        prior: a prior, or the name or path of one.
        count: number of samples.
        reference: real scenes; None draws ``count`` scenes from the grammar of the prior's scene type.
        floor: other real scenes, see :func:`measure_samples`.
        num_steps: denoiser evaluations per sample.
        seed: of the samples, and of the grammar when it is used.
        batch_size: scenes denoised at once.
        pool: worker processes for physics.
        ready: whether to project and settle as well.

    Returns:
        The figures of :func:`measure_samples`, and ``num_steps``.
    """
    sampler = _load(prior)
    if reference is None:
        reference = grammar_scenes(sampler.scene_type, count, seed=seed)
    samples = sampler.sample(count, num_steps=num_steps, seed=seed, batch_size=batch_size)
    figures = measure_samples(samples, reference, floor=floor, pool=pool, ready=ready)
    return {"num_steps": float(num_steps), **figures}


def grammar_scenes(scene_type: str | SceneType, count: int, seed: int = 0) -> SceneBatch:
    """``count`` scenes straight from the grammar of a scene type, the same ones for the same seed."""
    from scene_envs.grammars import get_grammar

    return get_grammar(scene_type).sample(np.random.default_rng(seed), count)


def figure_table(figures: Mapping[str, float]) -> str:
    """The figures as a Markdown table: name, samples, and the real-against-real floor when it was measured.

    >>> print(figure_table({"objects_mean": 18.0, "floor_objects_mean": 18.25}))
    | figure | samples | real |
    |---|---|---|
    | objects_mean | 18 | 18.25 |
    """
    names = [name for name in figures if not name.startswith(FLOOR_PREFIX)]
    has_floor = any(name.startswith(FLOOR_PREFIX) for name in figures)
    head = ["figure", "samples", *(["real"] if has_floor else [])]
    rows = [[name, f"{figures[name]:.4g}"] for name in names]
    if has_floor:
        for row in rows:
            real = figures.get(FLOOR_PREFIX + row[0])
            row.append("" if real is None else f"{real:.4g}")
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" if line[0] != "---" else "|---" * len(line) + "|" for line in lines)


def _layout_figures(batch: SceneBatch, reference: SceneBatch) -> dict[str, float]:
    counts = batch.counts
    figures = {
        "scenes": float(len(batch)),
        "objects_mean": float(counts.double().mean()),
        "objects_min": float(counts.min()),
        "objects_max": float(counts.max()),
        "free_objects_mean": int(batch.is_free.sum()) / len(batch),
        "category_kl": category_kl(batch, reference),
        "count_wasserstein": count_wasserstein(batch, reference),
        "workspace_fraction": workspace_fraction(batch),
    }
    for kind, errors in height_errors(batch).items():
        if len(errors):
            figures[f"height_error_{kind}_mm"] = 1e3 * float(errors.quantile(0.5))
            figures[f"height_error_{kind}_p95_mm"] = 1e3 * float(errors.quantile(0.95))
    return figures


def _overlap_figures(batch: SceneBatch, pool: PhysicsPool | None) -> dict[str, float]:
    from scene_envs.physics import penetration

    result = penetration(batch, pool=pool)
    scenes = int(result.valid.sum())
    if not scenes:
        return {}
    depths = [pair.depth for pairs in result.pairs for pair in pairs if pair.depth > CONTACT]
    figures = {"overlapping_pairs": len(depths) / scenes}
    if depths:
        figures["overlap_median_mm"] = 1e3 * float(np.quantile(depths, 0.5))
        figures["overlap_p95_mm"] = 1e3 * float(np.quantile(depths, 0.95))
    free = batch.is_free & result.valid.unsqueeze(-1)
    if bool(free.any()):
        figures["deeper_than_1mm_fraction"] = float((result.depth[free] > 1e-3).double().mean())
        figures["deeper_than_1cm_fraction"] = float((result.depth[free] > 1e-2).double().mean())
    return figures


def _feasibility_figures(batch: SceneBatch, pool: PhysicsPool | None) -> dict[str, float]:
    from scene_envs.physics import feasibility

    result = feasibility(batch, pool=pool)
    figures = {"invalid_fraction": 1.0 - float(result.valid.double().mean())}
    return {**figures, **_per_scene_and_fraction("feasible", batch, result.counts, result.valid)}


def _ready_figures(batch: SceneBatch, pool: PhysicsPool | None) -> dict[str, float]:
    from scene_envs.physics import make_ready

    result = make_ready(batch, pool=pool)
    figures = {"ready_invalid_fraction": 1.0 - float(result.valid.double().mean())}
    return {**figures, **_per_scene_and_fraction("ready", batch, result.counts, result.valid)}


def _per_scene_and_fraction(name: str, batch: SceneBatch, counts: Tensor, valid: Tensor) -> dict[str, float]:
    """Mean of ``counts`` (B,) over valid scenes, and their sum as a share of the free objects there."""
    figures = {}
    if bool(valid.any()):
        figures[f"{name}_objects"] = float(counts[valid].double().mean())
        free = int(batch.is_free[valid].sum())
        if free:
            figures[f"{name}_fraction"] = int(counts[valid].sum()) / free
    return figures


def _load(prior: Sampler | str) -> Sampler:
    if not isinstance(prior, str):
        return prior
    from agents.prior import ScenePrior

    return ScenePrior.load(prior)
