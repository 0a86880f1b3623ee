"""Demonstration: post-training of the shipped Dimsum prior toward clutter, with a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.post_training.comparison_run import post_train_and_compare
from agents.post_training.config import PostTrainConfig
from agents.priors.base import ScenePrior

RECIPE = PostTrainConfig(
    prior="dimsum_table_continuous",
    reward="object_count",
    iterations=24,
    batch_size=32,
    num_steps=25,
    gradient_steps=8,
    min_std=0.1,
    credit="object",
    regularisation=0.5,
    regularisation_batch=32,
    learning_rate=5e-5,
    guard_every=5,
    guard_limit=1.4,
    checkpoint_every=10,
)
"""What ``make demo`` runs: two minutes of training on two cores."""


def run_demo(
    output: str | Path = "runs/demo",
    seed: int = 0,
    workers: int = 2,
    *,
    scenes: int = 256,
    num_steps: int = 50,
    recipe: PostTrainConfig | None = None,
    prior: ScenePrior | None = None,
) -> dict[str, Any]:
    """Post-train, measure both priors on fresh samples, and write the report; see ``post_train_and_compare``.

    Args:
        output: run directory; ``prior=<output>`` loads the result. An interrupted demonstration goes on there.
        seed: of training; the measured samples have a seed of their own that follows from it.
        workers: physics worker processes.
        scenes: fresh samples measured of each prior.
        num_steps: denoiser evaluations per measured sample.
        recipe: in place of :data:`RECIPE`.
        prior: in place of the recipe's.

    Returns:
        The numbers of ``metrics.json``: ``before`` and ``after`` (``objects``, ``feasible_objects`` raw,
        ``ready_objects``), ``change``, ``guard``.
    """
    config = replace(recipe or RECIPE, output=str(output), seed=seed, workers=workers)
    return post_train_and_compare(config, scenes=scenes, num_steps=num_steps, prior=prior)
