"""Evaluation of scenes: a flat dict of figures for model cards, reports and the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from agents.evaluation.metrics import (
    category_kl,
    count_wasserstein,
    height_errors,
    out_of_workspace_rate,
    workspace_fraction,
)
from agents.evaluation.novelty import duplicates
from agents.evaluation.physics_figures import physics_figures, ready_figures
from agents.evaluation.spacing import spacing_wasserstein
from agents.evaluation.stacks import stack_wasserstein, tallest_stacks
from scene_envs.envs.resolvers import resolve_prior
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool

FLOOR_PREFIX = "floor_"
"""Prefix of the figures of real scenes measured against other real scenes."""


class Sampler(Protocol):
    """Protocol of the priors that :func:`evaluate` takes, such as ``agents.priors.prior.ScenePrior``."""

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

    Objects include welded ones, *free* objects do not. A figure without data, such as the height of stacks in scenes
    without stacks, is left out. Scenes whose physics failed are left out of the figures of that computation; they are
    counted in ``invalid_fraction`` or ``ready_invalid_fraction``.

    Args:
        batch: scenes to measure.
        reference: real scenes of the same type.
        floor: other real scenes; each figure is also measured on them and returned as ``floor_<name>``, the figure of a
            perfect sampler.
        pool: worker processes for physics; None computes in this process.
        ready: whether to also project and settle the scenes, which takes the longest.

    Returns:
        The figures of :func:`layout_figures`, of :func:`~agents.evaluation.physics_figures.physics_figures` and, with
        ``ready``, of :func:`~agents.evaluation.physics_figures.ready_figures`; docs/evaluation.md describes each.

    Raises:
        InvalidInputError: there are no scenes, or they are of another type than the reference.
    """
    if not len(batch) or not len(reference):
        raise InvalidInputError(f"cannot measure {len(batch)} scenes against {len(reference)}: both need at least one")
    figures = {
        **layout_figures(batch, reference),
        **physics_figures(batch, pool),
        **(ready_figures(batch, pool) if ready else {}),
    }
    if floor is not None:
        real = measure_samples(floor, reference, pool=pool, ready=ready)
        figures.update({FLOOR_PREFIX + name: value for name, value in real.items()})
    return figures


def evaluate(
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
        seed: seed of the samples, and of the grammar if it is used.
        batch_size: number of scenes denoised at once.
        pool: worker processes for physics; None computes in this process.
        ready: whether to also project and settle the samples.

    Returns:
        The figures of :func:`measure_samples`, and ``num_steps``.
    """
    sampler = cast(Sampler, resolve_prior(prior))
    if reference is None:
        reference = grammar_scenes(sampler.scene_type, count, seed=seed)
    samples = sampler.sample(count, num_steps=num_steps, seed=seed, batch_size=batch_size)
    figures = measure_samples(samples, reference, floor=floor, pool=pool, ready=ready)
    return {"num_steps": float(num_steps), **figures}


def grammar_scenes(scene_type: str | SceneType, count: int, seed: int = 0) -> SceneBatch:
    """``count`` scenes of the grammar of a scene type, the same for the same seed."""
    from scene_envs.grammars import get_grammar

    return get_grammar(scene_type).sample(np.random.default_rng(seed), count)


def layout_figures(batch: SceneBatch, reference: SceneBatch) -> dict[str, float]:
    """Figures that need no simulator: counts, categories, spacing, stacks, heights, workspace and duplicates.

    Raises:
        InvalidInputError: the scenes are of another type than the reference.
    """
    counts = batch.counts
    divergence = category_kl(batch, reference)
    figures = {
        "scenes": float(len(batch)),
        "objects_mean": float(counts.double().mean()),
        "objects_min": float(counts.min()),
        "objects_max": float(counts.max()),
        "free_objects_mean": int(batch.is_free.sum()) / len(batch),
        "category_kl": divergence,
        "category_kl_e4": 1e4 * divergence,
        "count_wasserstein": count_wasserstein(batch, reference),
        "workspace_fraction": workspace_fraction(batch),
        "out_of_workspace_rate": out_of_workspace_rate(batch),
        "duplicates": duplicates(batch),
    }
    spacing = spacing_wasserstein(batch, reference)
    if spacing is not None:
        figures["spacing_wasserstein_mm"] = 1e3 * spacing
    if batch.scene_type.has_geometry:
        figures["tallest_stack_mean"] = float(tallest_stacks(batch).double().mean())
        figures["stack_wasserstein"] = stack_wasserstein(batch, reference)
    for kind, errors in height_errors(batch).items():
        if len(errors):
            figures[f"height_error_{kind}_mm"] = 1e3 * float(errors.quantile(0.5))
            figures[f"height_error_{kind}_p95_mm"] = 1e3 * float(errors.quantile(0.95))
    return figures
