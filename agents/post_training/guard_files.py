"""Guard of a run and its files: the best prior, and the samples that the report shows."""

from __future__ import annotations

import math
from typing import Any

from agents.configuration.prior_names import short_name
from agents.post_training.config import PostTrainConfig
from agents.post_training.guard import Guard, GuardReading
from agents.post_training.learner import Learner
from agents.post_training.rollouts import stream_seed
from agents.post_training.run_files import writing
from agents.post_training.sample_check import SampleCheck
from agents.post_training.scene_bank import SceneBank
from agents.priors.base import ScenePrior
from agents.utils.process_group import ProcessGroup

_PICTURED = 6
"""Samples of the guard that are kept for the report."""


def make_guard(config: PostTrainConfig, learner: Learner, scenes: SceneBank) -> Guard:
    """The guard of a run; it samples if the configuration says so."""
    asked, count, check = scenes.heldout_prompts(), config.guard.sampled, None
    if count:
        check = SampleCheck(
            learner.prior.decode(scenes.heldout[:count]).to("cpu"),
            learner.scorer,
            count,
            config.num_steps,
            stream_seed(config.seed, "samples"),
            learner.slots,
            None if config.prompt is None else scenes.heldout_prompts(count, learner.slots, learner.prior.scene_type),
            config.guidance,
            config.claim_guidance,
        )
    limits = config.guard.limits(config.algorithm.sample_limits)
    held = config.regularisation.target
    target = math.inf if held is None else held
    seed, learns = stream_seed(config.seed, "guard"), bool(learner.learned)
    return Guard(scenes.heldout, config.guard.limit, seed, asked, check, limits, target, learns)


class GuardFiles:
    """Files of the guard in a run's folder; only the first process writes.

    Args:
        config: of the run.
        base: name of the base prior; empty for a prior that was not loaded by name.
    """

    def __init__(self, config: PostTrainConfig, base: str) -> None:
        self.directory = config.directory
        self._facts: dict[str, Any] = {
            "algorithm": config.algorithm.name,
            **({"base": short_name(base)} if base else {}),
            "reward": config.plain()["reward"],
        }
        self._processes = ProcessGroup.current()

    def keep(self, prior: ScenePrior, guard: Guard, iteration: int) -> None:
        """Write the evaluated weights to ``prior/``, with a card that says how they were made."""
        # figures of the base prior are not those of other weights
        unknown = ("measures", "limits") if iteration else ()
        prior.card = {
            **{key: value for key, value in prior.card.items() if key not in unknown},
            "post_training": {
                **self._facts,
                "iteration": iteration,
                "mean_reward": guard.best_reward if iteration else None,
                "guard_ratio": guard.ratio,
            },
        }
        path = self.directory / "prior"
        if self._processes.is_first:
            writing(f"the prior {str(path)!r}", lambda: prior.save(path))

    def best(self) -> ScenePrior:
        """The prior that was kept last."""
        self._processes.wait()  # until it is written
        return ScenePrior.load(self.directory / "prior")

    def picture(self, guard: Guard, reading: GuardReading) -> None:
        """Keep the samples of the best checkpoint, and of the first check beyond a limit, for the report."""
        batch = guard.last_samples
        name = "guard_within" if reading.kept else "guard_beyond"
        first = reading.beyond and guard.over_limit_at == reading.iteration
        if batch is None or not reading.samples or not (reading.kept or first) or not self._processes.is_first:
            return
        path = self.directory / f"{name}.safetensors"
        writing(f"the guard's samples {str(path)!r}", lambda: batch[:_PICTURED].save(path))
