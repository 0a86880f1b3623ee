"""The demonstration: steer the shipped Dimsum prior toward clutter, and show what it cost and gained."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.post_training.comparison import measure_prior, write_comparison
from agents.post_training.config import PostTrainConfig
from agents.post_training.trainer import post_train
from agents.prior import ScenePrior
from rewards import reward_name

SAMPLE_SEED = 100_000
"""Added to the run's seed for the samples that are measured, so that training never saw their noise."""

RECIPE = PostTrainConfig(
    prior="dimsum_table",
    reward="object_count",
    iterations=40,
    batch_size=32,
    num_steps=25,
    gradient_steps=8,
    credit="scene",
    regularisation=100.0,
    regularisation_batch=32,
    learning_rate=5e-5,
    guard_every=5,
    guard_limit=1.4,
    checkpoint_every=10,
)
"""What `make demo` runs: found by hand for two cores and four minutes."""


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
    """Post-train, measure both priors on fresh samples, and write the report.

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
        ``ready_objects``), ``change``, ``guard``, ``seconds`` of each part.
    """
    from scene_envs.physics import PhysicsPool

    config = replace(recipe or RECIPE, output=str(output), seed=seed, workers=workers)
    started = time.perf_counter()
    base = ScenePrior.load(config.prior if prior is None else prior)
    result = post_train(config, prior=base)
    trained = time.perf_counter()
    with PhysicsPool(workers=workers) as pool:
        _say(config, f"measuring {scenes} samples of the base prior")
        before = measure_prior(base, scenes, num_steps=num_steps, seed=seed + SAMPLE_SEED, pool=pool)
        _say(config, f"measuring {scenes} samples of the post-trained prior")
        after = measure_prior(result.prior, scenes, num_steps=num_steps, seed=seed + SAMPLE_SEED, pool=pool)
    measured = time.perf_counter()
    _say(config, "drawing the report")
    seconds = {"training": round(trained - started, 1), "measuring": round(measured - trained, 1)}
    reward = reward_name(config.reward).replace("_", " ")
    title = f"Steering {base.scene_type.name.replace('_', ' ')} toward {reward}"
    return write_comparison(result, before, after, title=title, extra={"seconds": seconds, "scenes": scenes})


def _say(config: PostTrainConfig, text: str) -> None:
    if config.progress != "none":
        print(text, file=sys.stderr, flush=True)
