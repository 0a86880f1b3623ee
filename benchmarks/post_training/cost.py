"""Processor seconds of an iteration of every algorithm, and the part of each kind of work.

    python -m benchmarks.post_training.cost [prior=dimsum_table] [reward=feasible_share] [iterations=3] [KEY=VALUE ...]

Every algorithm starts from the same prior and runs the same number of iterations at its defaults; further keys are
those of `post-train`. Seconds are of this process, so other work on the machine changes them little. The first
iteration, in which modules and data are loaded, is left out.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import yaml

from agents.configuration.composition import changed
from agents.post_training import PostTrainConfig, PostTrainer, regularisation
from agents.post_training.settings import list_algorithms
from agents.priors.prior import ScenePrior
from scene_envs.envs.scoring import RewardScorer

DEFAULTS = {"prior": "dimsum_table", "reward": "feasible_share", "iterations": "3"}
COUNTED = ("reward", "rollout", "policy gradient", "regularisation", "iteration")


class Clock:
    """Processor seconds by part; a part inside another counts in both."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    def timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function`` with its seconds added up under ``part``."""

        def call(*arguments: Any, **named: Any) -> Any:
            begun = time.process_time()
            try:
                return function(*arguments, **named)
            finally:
                self.seconds[part] += time.process_time() - begun

        return call


def iteration_seconds(config: PostTrainConfig, prior: ScenePrior) -> dict[str, float]:
    """Mean processor seconds of an iteration, by part."""
    clock = Clock()
    with patch.object(RewardScorer, "__call__", clock.timed("reward", RewardScorer.__call__)):
        trainer = PostTrainer(config, prior=prior)
        try:
            trainer.prepare()
            gradient = clock.timed("policy gradient", trainer.learner.algorithm.accumulate)
            rollout = clock.timed("rollout", trainer.learner.rollout)
            real = clock.timed("regularisation", regularisation.add_regularisation_gradient)
            with (
                patch.object(trainer.learner.algorithm, "accumulate", gradient),
                patch.object(trainer.learner, "rollout", rollout),
                patch.object(regularisation, "add_regularisation_gradient", real),
            ):
                trainer.step()
                clock.seconds.clear()
                step = clock.timed("iteration", trainer.step)
                for _ in range(config.iterations):
                    step()
        finally:
            trainer.close()
    return {part: clock.seconds[part] / config.iterations for part in COUNTED}


def main(words: list[str]) -> None:
    """Print a row for every algorithm."""
    given = DEFAULTS | dict(word.split("=", 1) for word in words)
    prior = ScenePrior.load(given["prior"])
    print("| algorithm | denoising | reward | policy gradient | regularisation | the rest | seconds per iteration "
          "| scenes per second |\n|---|---|---|---|---|---|---|---|")  # fmt: skip
    for seed, name in enumerate(list_algorithms()):  # another seed for each: verdicts of physics are kept by scene
        with tempfile.TemporaryDirectory() as folder:
            config = PostTrainConfig(algorithm={"name": name}, seed=seed, output=f"{folder}/run")
            config = changed(config, {key: yaml.safe_load(value) for key, value in given.items()})
            seconds = iteration_seconds(config, prior)
        denoising = seconds["rollout"] - seconds["reward"]
        whole = seconds["iteration"]
        known = [denoising, *(seconds[part] for part in ("reward", "policy gradient", "regularisation"))]
        shares = [f"{100 * part / whole:.0f} %" for part in (*known, whole - sum(known))]
        print(f"| `{name}` | {' | '.join(shares)} | {whole:.2f} | {config.batch_size / whole:.1f} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
