"""Post-training run with measures before and after, and a report."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from typing import Any

from torch import Generator

from agents.post_training.comparison import Measured, measure_prior, write_comparison
from agents.post_training.config import PostTrainConfig
from agents.post_training.learned_rewards import LearnedRewards
from agents.post_training.prompts import PromptDeck, prompts_beside
from agents.post_training.rollouts import stream_seed
from agents.post_training.run_files import CHECKPOINT_NAME, SCENES_NAME
from agents.post_training.trainer import post_train
from agents.priors.prior import ScenePrior
from agents.utils.checkpoints import load_checkpoint
from agents.utils.process_group import ProcessGroup
from rewards import reward_label
from rewards.process import close_reward, run_reward
from scene_envs.scene import SceneBatch

SAMPLE_SEED = 100_000
"""Number added to the run's seed for the measured samples, so that their noise differs from that of training."""

PHYSICS_TIMEOUT = 300.0
"""Seconds for a chunk of scenes; long, so that a slow scene on a busy machine does not become invalid."""


def post_train_and_compare(
    config: PostTrainConfig, *, scenes: int = 256, num_steps: int = 50, prior: ScenePrior | None = None
) -> dict[str, Any]:
    """Post-train, measure the base and the post-trained prior on fresh samples, and write the report.

    Both priors start from the same noise, and every sample is measured. Physics decides which objects are
    simulation-ready.

    Args:
        config: the run; ``config.output`` gets ``report.html``, ``curve.png``, ``before.png``, ``after.png``,
            ``metrics.json`` and the prior. An interrupted run found there is resumed.
        scenes: number of fresh samples of each prior.
        num_steps: denoiser evaluations per measured sample.
        prior: prior to start from, in place of the one that ``config.prior`` names.

    Returns:
        The numbers of ``metrics.json``: ``before`` and ``after`` (``reward``, ``objects``, ``feasible_objects`` raw,
        ``ready_objects``, and ``prompt_match`` with prompts), ``change``, ``guard``, ``stage_seconds``, and the run's
        own metrics. With several processes, only the first one measures; the others return the run's own metrics.
    """
    from scene_envs.physics import make_pool

    started = time.perf_counter()
    base = ScenePrior.load(config.prior if prior is None else prior)
    result = post_train(config, prior=base)
    if not ProcessGroup.current().is_first:
        return result.metrics
    trained = time.perf_counter()
    seed = config.seed + SAMPLE_SEED
    prompts = _measured_prompts(config, base, scenes)
    workers = 0 if config.workers == "ray" else config.workers
    reward = run_reward(
        config.reward, seed=config.seed, timeout=config.reward_timeout, memory=config.reward_memory, workers=workers
    )
    with make_pool(config.workers, PHYSICS_TIMEOUT) as pool, ExitStack() as stack:
        stack.callback(close_reward, reward)
        load_learned_rewards(reward, config)

        def measure(prior: ScenePrior) -> Measured:
            return measure_prior(
                prior, scenes, num_steps=num_steps, seed=seed, pool=pool, prompts=prompts, guidance=config.guidance,
                claim_guidance=config.claim_guidance, slots=config.slots, reward=reward,
            )  # fmt: skip

        say_stage(config, f"measuring {scenes} samples of the base prior")
        before = measure(base)
        say_stage(config, f"measuring {scenes} samples of the post-trained prior")
        after = measure(result.prior)
    seconds = {"training": round(trained - started, 1), "measuring": round(time.perf_counter() - trained, 1)}
    say_stage(config, "drawing the report")
    title = f"Steering {base.scene_type.name.replace('_', ' ')} toward {reward_label(config.reward)}"
    extra = {"stage_seconds": seconds, "num_steps": num_steps}
    return write_comparison(result, before, after, title=title, extra=extra)


def load_learned_rewards(reward: Any, config: PostTrainConfig) -> None:
    """Give the parts of ``reward`` that learn their state at the end of a run."""
    learned = LearnedRewards(reward, config)
    if learned:
        real = SceneBatch.load(config.directory / SCENES_NAME)
        learned.begin(real[: len(real) - config.guard.scenes])
        learned.restore(load_checkpoint(config.directory / CHECKPOINT_NAME)["learner"])


def _measured_prompts(config: PostTrainConfig, prior: ScenePrior, count: int) -> list[str] | None:
    """One prompt per measured sample, from the source of the run's prompts; None for a run without prompts."""
    if config.prompt is None:
        return None
    directory = config.directory
    batch = SceneBatch.load(directory / SCENES_NAME)
    real = prompts_beside(directory, batch, stream_seed(config.seed, "bank"))
    slots = prior.config.slots if config.slots is None else config.slots
    deck = PromptDeck.of(prior, config.prompt, 1, slots, real, len(batch))
    return deck.deal(count, Generator().manual_seed(config.seed + SAMPLE_SEED))


def say_stage(config: PostTrainConfig, text: str) -> None:
    """Tell on stderr what is done next, unless the run shows no progress."""
    if config.progress != "none":
        print(text, file=sys.stderr, flush=True)
