"""Demonstration: post-training of the shipped Dimsum prior toward clutter, with a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.post_training.comparison_run import post_train_and_compare
from agents.post_training.config import PostTrainConfig
from agents.priors.base import ScenePrior


def run_demo(
    output: str | Path = "runs/demo",
    seed: int = 0,
    workers: int = 2,
    *,
    scenes: int = 24,
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
        recipe: in place of that of ``configs/recipe/demo.yaml``: two minutes of training on two cores.
        prior: in place of the recipe's.

    Returns:
        The numbers of ``metrics.json``: ``before`` and ``after`` (``objects``, ``feasible_objects`` raw,
        ``ready_objects``), ``change``, ``guard``.
    """
    config = replace(recipe or PostTrainConfig(recipe="demo"), output=str(output), seed=seed, workers=workers)
    return post_train_and_compare(config, scenes=scenes, num_steps=num_steps, prior=prior)
