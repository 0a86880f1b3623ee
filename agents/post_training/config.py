"""Configuration of one post-training run; imports no torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

from agents.configuration.checks import at_least, one_of, positive
from agents.configuration.fields import composed, named, nested
from agents.configuration.settings import LoggerSettings, OptimizerSettings
from agents.configuration.shared_keys import RewardLimits, SamplingKeys, TrainingKeys
from agents.configuration.tree import plain_tree
from agents.post_training.algorithm_settings import AlgorithmSettings, DDPOSFSettings
from agents.post_training.algorithms import algorithm_settings, list_algorithms
from agents.post_training.regularisation_settings import RegularisationSettings
from scene_envs.envs.settings import PROMPT_SOURCES, check_claim_guidance
from scene_envs.errors import InvalidInputError

RESUMABLE = ("recipe", "iterations", "output", "workers", "logger", "reward_timeout", "reward_memory")
"""Fields that may change between a run and its continuation."""


@dataclass
class PostTrainOptimizerSettings(OptimizerSettings):
    """The optimiser of a post-training run; its steps are updates.

    Attributes:
        lr: peak learning rate; null takes the default of the algorithm.
        chunk: scenes per forward and backward pass; null takes the whole batch at once.
    """

    lr: float | None = None  # type: ignore[assignment]
    chunk: int | None = None

    def __post_init__(self) -> None:
        at_least(self, 1, "chunk")
        if self.lr is not None:
            super().__post_init__()


FEWEST_SAMPLES = 20
"""Samples that the guard's classifier needs."""


@dataclass
class GuardSettings:
    """Settings of the guard.

    Attributes:
        every: iterations between checks.
        scenes: number of held-out real scenes.
        limit: largest held-out loss of a checkpoint that may be kept, as a ratio to that of the base prior.
        action: what happens beyond a limit: ``report`` continues, ``stop`` ends the run, ``rollback`` returns to the
            weights of the best checkpoint and continues with half the learning rate.
        samples: number of scenes that a check samples, always from the same noise, for the limits below; at most as
            many as ``scenes``. With fewer than 20, a check measures the loss alone.
        samples_every: iterations between checks that sample.
        count_limit: limit of the Wasserstein-1 distance between object counts of samples and of real scenes: the number
            of objects by which it may exceed the base prior's distance; null takes the default of the algorithm.
        stack_limit: the same limit for the distance between the heights of the tallest stacks, in objects.
        category_limit: the same limit for the KL divergence of the categories, in nats.
        classifier_limit: the same limit for the accuracy of a classifier that tells samples from real scenes.
        max_invalid: number of consecutive batches without a valid reward after which the run stops.
    """

    every: int = 5
    scenes: int = 256
    limit: float = 1.5
    action: str = "report"
    samples: int = 128
    samples_every: int = 20
    count_limit: float | None = None
    stack_limit: float | None = None
    category_limit: float | None = None
    classifier_limit: float | None = None
    max_invalid: int = 3

    def __post_init__(self) -> None:
        at_least(self, 1, "every", "scenes", "max_invalid", "samples_every")
        positive(self, "limit")
        one_of(self, "action", ("report", "stop", "rollback"))
        at_least(self, 0, "samples", "count_limit", "stack_limit", "category_limit", "classifier_limit")

    @property
    def sampled(self) -> int:
        """Number of scenes that a check samples, at most that of the held-out scenes; 0 below ``FEWEST_SAMPLES``."""
        count = min(self.samples, self.scenes)
        return count if count >= FEWEST_SAMPLES else 0

    def limits(self, defaults: Mapping[str, float]) -> dict[str, float]:
        """Limits of figures of samples by name; ``defaults`` are the algorithm's."""
        own = {
            "count_distance": self.count_limit,
            "stack_distance": self.stack_limit,
            "category_kl": self.category_limit,
            "classifier_accuracy": self.classifier_limit,
        }
        return {**defaults, **{name: limit for name, limit in own.items() if limit is not None}}


@dataclass
class PostTrainLoggerSettings(LoggerSettings):
    """Settings of the progress display and the report of a post-training run.

    Attributes:
        progress: progress display: ``bar``, ``lines`` or ``none``.
        report_scenes: number of fresh samples, before and after the run, that report.html measures and shows; 0 for no
            report.
    """

    progress: str = "bar"
    report_scenes: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        one_of(self, "progress", ("bar", "lines", "none"))
        if self.report_scenes < 0:
            raise InvalidInputError(f"report_scenes={self.report_scenes} must not be negative; 0 writes no report")


@dataclass
class BatchKeys:
    """Batches of fresh scenes.

    :class:`PostTrainConfig` describes the keys.
    """

    iterations: int = 60
    batch_size: int = 48
    workers: Any = 0


@composed
@dataclass
class PostTrainConfig(BatchKeys, SamplingKeys, TrainingKeys, RewardLimits):
    """One post-training run.

    With DDPO-SF, the gradient that AdamW sees is that of

        - step_scale * sum over gradient steps of mean over scenes of  A * log p(x_{t-1} | x_t)
        + regularisation.weight * pretraining loss on real scenes

    where ``step_scale = steps with weight > 0 / gradient_steps``. ``algorithm.log_prob_reduction`` says how log p is
    reduced over a scene's entries. The pretraining loss is a mean over scenes and entries. The weight is meaningful
    only together with these reductions: with ``"sum"`` the same balance needs a weight larger by the number of random
    entries of a scene.

    Keys that are not listed are those of :class:`~agents.configuration.SamplingKeys`,
    :class:`~agents.configuration.TrainingKeys` and :class:`~agents.configuration.RewardLimits`.

    Attributes:
        prior: prior from which the run starts: a shipped name or a path.
        reward: a registered name, or a mapping with ``name`` and settings. In Python also a function or a reward
            object; it runs in the calling process, so its crash or hang ends or stops the run.
        iterations: number of iterations; each samples one batch of scenes.
        batch_size: scenes sampled per iteration.
        workers: physics worker processes; 0 computes physics in this process; ``ray`` uses the CPUs of a Ray cluster.
        recipe: a named set of values for the other keys: ``ours``, ``demo_clutter`` or ``demo_feasible``. Keys that are
            given as well override it.
        output: run folder; a run that was interrupted there is resumed; empty for runs/COMMAND-TIME on the command
            line, runs/post-train in Python.
        prompt: text that the scenes should match, for priors that read prompts: one text, a list such as '["A scene
            with two cups.", "A scene with 9 objects."]', ``data`` for the prompts of the real scenes, or ``grammar``
            for descriptions of grammar scenes; null for no prompt.
        guidance: weight of classifier-free guidance in the policy, 0 for none; needs a prompt.
        claim_guidance: strength with which sampled scenes are guided to the numbers and places that their prompts
            give, 0 for none; 2 is a good choice; needs a prompt, and an algorithm that learns from finished samples.
        seed: seed of the initial noise, the chain's noise, the choice of steps and the real scenes.
        algorithm: the post-training algorithm.
        optimizer: the optimiser of the weights.
        regularisation: losses that keep the prior near real scenes.
        guard: checks on held-out real scenes.
        logger: log files and progress display.
    """

    SHORT: ClassVar[Mapping[str, str]] = {"hold": "regularisation.hold"}
    """Keys that may be written without their group."""

    prior: str = "dimsum_table_continuous"
    reward: Any = named("object_count", "reward")
    prompt: str | list[str] | None = None  # type: ignore[assignment]
    num_steps: int = 25
    algorithm: AlgorithmSettings = nested(
        DDPOSFSettings, folder="algorithm", option="ddpo_sf", kinds=algorithm_settings, registered=list_algorithms
    )
    optimizer: PostTrainOptimizerSettings = nested(PostTrainOptimizerSettings, folder="optimizer", option="adamw")
    regularisation: RegularisationSettings = nested(RegularisationSettings)
    guard: GuardSettings = nested(GuardSettings)
    logger: PostTrainLoggerSettings = nested(PostTrainLoggerSettings, folder="logger", option="csv")

    def __post_init__(self) -> None:
        at_least(self, 1, "iterations", "num_steps", "slots")
        at_least(self, 0, "seed")
        at_least(self, 2, "batch_size")
        positive(self, "reward_timeout", "reward_memory")
        if not (isinstance(self.workers, int) and self.workers >= 0) and self.workers != "ray":
            raise InvalidInputError(
                f"workers={self.workers!r}: give a number of processes, 0 for none, or ray for a Ray cluster"
            )
        self.prompt = list(self.prompt) if isinstance(self.prompt, tuple) else self.prompt
        check_prompt(self.prompt, self.guidance)
        check_claim_guidance(self.prompt, self.claim_guidance)
        if self.claim_guidance and isinstance(self.algorithm, DDPOSFSettings):
            raise InvalidInputError(
                f"claim_guidance={self.claim_guidance:g} changes how scenes are drawn, and "
                f"algorithm={self.algorithm.name} learns from the probability of its own draws; take algorithm=nft or "
                "awm, or leave claim_guidance=0"
            )
        if self.optimizer.lr is None:
            self.optimizer = replace(self.optimizer, lr=self.algorithm.learning_rate)
        if self.regularisation.weight is None:
            self.regularisation = replace(self.regularisation, weight=self.algorithm.regularisation_weight)
        target = self.regularisation.target
        if target is not None and target > self.guard.limit:
            raise InvalidInputError(
                f"hold={self.regularisation.hold} lies beyond guard.limit={self.guard.limit:g}, past which no prior is "
                f"kept; raise guard.limit, or hold at most guard:{self.guard.limit:g}"
            )
        if self.regularisation.bank_size < self.guard.scenes + 1:
            raise InvalidInputError(
                f"regularisation.bank_size={self.regularisation.bank_size} must exceed guard.scenes="
                f"{self.guard.scenes}, which are held out of it"
            )

    @property
    def directory(self) -> Path:
        """The run directory."""
        return Path(self.output or "runs/post-train")

    def plain(self) -> dict[str, Any]:
        """The configuration as numbers, strings and lists; a reward given as an object becomes its name."""
        if _is_plain(self.reward):
            return plain_tree(self)
        from rewards import reward_name

        return {**plain_tree(replace(self, reward="")), "reward": reward_name(self.reward)}


def check_prompt(prompt: Any, guidance: float) -> None:
    """Refuse a prompt that is no text, list of texts, source of prompts or None; refuse guidance without a prompt."""
    texts = [prompt] if isinstance(prompt, str) else prompt
    good = prompt is None or (
        isinstance(texts, list | tuple) and texts and all(isinstance(t, str) and t for t in texts)
    )
    if not good:
        raise InvalidInputError(
            f"prompt={prompt!r} must be a text, a list of texts, one of {', '.join(PROMPT_SOURCES)}, or null"
        )
    if not math.isfinite(guidance):
        raise InvalidInputError(f"guidance={guidance} must be a finite number; 0 follows the prompt as it is")
    if guidance and prompt is None:
        raise InvalidInputError(
            f"guidance={guidance:g} strengthens a prompt, and prompt is null; give prompt=, or leave guidance=0"
        )


def _is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | int | float | bool)
