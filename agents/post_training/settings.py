"""Settings of post-training, registry of algorithms, and configuration of a run; imports no torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from agents.configuration.composition import (
    OPTIMIZERS,
    EngineKeys,
    GuidanceKeys,
    LoggerSettings,
    OptimizerSettings,
    ProgressKeys,
    RewardLimitKeys,
    SamplingKeys,
    Texts,
    TrainingKeys,
    composed,
    named,
    nested,
    plain_tree,
)
from agents.utils.loggers import LOGGERS
from scene_envs.envs.settings import PROMPT_SOURCES, check_guidance
from scene_envs.errors import (
    BELOW_ONE,
    WORKERS,
    Checked,
    Count,
    InvalidInputError,
    Limit,
    Natural,
    Nonnegative,
    OneOf,
    Positive,
    Unlimited,
    at_least,
)
from scene_envs.registry import Registry

CREDITS = ("auto", "scene", "object")


@dataclass
class AlgorithmSettings(Checked):
    """Settings that all algorithms share.

    Attributes:
        name: name of a registered algorithm.
        scenes_per_prompt: number of scenes of a batch that share a prompt; advantages are computed within such a group.
    """

    place = "algorithm."
    learning_rate: ClassVar[float] = 5e-5
    """Learning rate unless ``optimizer.lr`` names another."""
    regularisation_weight: ClassVar[float] = 0.5
    """Coefficient of the pretraining loss unless ``regularisation.weight`` names another."""
    sample_limits: ClassVar[Mapping[str, float]] = {"reward": 5.0}
    """Limits of the guard's figures of samples unless ``guard.limits`` names others."""

    name: str = ""
    scenes_per_prompt: Annotated[int, at_least(2)] = 8

    @property
    def optimiser_steps(self) -> int:
        """Optimiser steps per batch: the key ``updates`` of algorithms that have it."""
        return getattr(self, "updates", 1)


@dataclass
class DDPOSFSettings(AlgorithmSettings):
    """DDPO-SF: the score-function policy gradient (Black et al. 2024, Eq. 3).

    Attributes:
        gradient_steps: number of denoising steps per iteration that contribute to the gradient, drawn from the eligible
            steps.
        min_std: smallest sigma of an eligible step, in normalised units; steps with less noise are excluded from the
            gradient.
        credit: ``scene`` gives every slot the advantage of the scene, ``object`` gives it its own (for rewards with
            ``per_object``), ``auto`` uses ``object`` if the reward allows it.
    """

    name: str = "ddpo_sf"
    gradient_steps: Count = 8
    min_std: Positive = 0.03
    credit: Annotated[str, OneOf(CREDITS)] = "auto"


@dataclass
class DDPOISSettings(DDPOSFSettings):
    """DDPO-IS: DDPO with clipped importance weights, for several updates per batch (Eq. 4).

    Attributes:
        clip_epsilon: half-width of the clip of the probability ratio.
        updates: optimiser steps per batch; one step is that of DDPO-SF.
    """

    name: str = "ddpo_is"
    clip_epsilon: Annotated[float, Limit(lambda value: 0 < value < 1, "must lie between 0 and 1")] = 1e-4
    updates: Count = 4


@dataclass
class ForwardProcessSettings(AlgorithmSettings):
    """Settings that the forward-process algorithms share.

    Attributes:
        updates: optimiser steps per batch.
        draws: number of timesteps and noises of every scene per optimiser step.
        credit: credit of poses: ``scene`` gives every slot the advantage of the scene, ``object`` gives it its own (for
            rewards with ``per_object``), ``auto`` uses ``object`` if the reward allows it.
        category_credit: credit of categories: ``scene`` uses the advantage of the scene, ``none`` keeps the categories
            as they are, ``auto`` is ``none`` if poses have credit per object and the reward counts no objects, else
            ``scene``.
        sampler_decay: largest decay of the averaged weights that sample, per iteration; after k iterations it is at
            most k / (k + 10).
        advantage_clip: advantage, in standard deviations, at which a sample is fully good or bad.
        expectation_lr: learning rate of the copy of the denoiser that learns the mean of own samples; 0 takes the
            sampling policy for it.
    """

    learning_rate: ClassVar[float] = 2e-4
    regularisation_weight: ClassVar[float] = 0.2
    sample_limits: ClassVar[Mapping[str, float]] = {
        **AlgorithmSettings.sample_limits,
        "count_distance": 1.0,
        "stack_distance": 0.5,
        "category_kl": 0.05,
        "classifier_accuracy": 0.1,
    }

    updates: Count = 2
    draws: Count = 2
    credit: Annotated[str, OneOf(CREDITS)] = "auto"
    category_credit: Annotated[str, OneOf(("auto", "scene", "none"))] = "auto"
    sampler_decay: Annotated[float, BELOW_ONE] = 0.99
    advantage_clip: Unlimited = 2.0
    expectation_lr: Annotated[float, at_least(0)] = 3e-4


@dataclass
class NFTSettings(ForwardProcessSettings):
    """NFT: good samples pull, bad samples push, both within bounds (Zheng et al. 2025).

    Attributes:
        beta: strength; smaller values step further from the sampling policy.
    """

    name: str = "nft"
    beta: Positive = 0.5


@dataclass
class AWMSettings(ForwardProcessSettings):
    """AWM: the pretraining loss of own samples times their advantage (Xue et al. 2025).

    Attributes:
        beta: strength of the pull to the sampling policy, above 1.
    """

    name: str = "awm"
    beta: Annotated[
        float, Limit(lambda beta: beta > 1, "must be above 1: below, a bad sample pushes without bound")
    ] = 2.0


@dataclass
class GuidanceDistillationSettings(AlgorithmSettings):
    """Guidance distillation: the prior learns to place objects as physics guidance does; the reward is reported only.

    Attributes:
        updates: optimiser steps per batch.
        states: number of states per optimiser step.
        memory: number of latest states, over all processes, from which they are drawn.
        strength: strength of the physics guidance that is learned, 0 to 1.
        huber: error of an entry, in standard deviations, from which on its loss is linear.
        sampler_decay: decay of the averaged weights that sample, per iteration.
    """

    learning_rate: ClassVar[float] = 2e-4
    regularisation_weight: ClassVar[float] = 0.03
    sample_limits: ClassVar[Mapping[str, float]] = ForwardProcessSettings.sample_limits

    name: str = "guidance_distillation"
    updates: Count = 4
    states: Count = 96
    memory: Count = 600
    strength: Annotated[float, Limit(lambda value: 0 < value <= 1, "must lie in (0, 1]; 1 learns whole moves")] = 1.0
    huber: Unlimited = 1.0
    sampler_decay: Annotated[float, BELOW_ONE] = 0.9


@dataclass
class RefinementSettings(GuidanceDistillationSettings):
    """Guidance distillation of a refinement: one more block corrects what the prior denoises; all else is frozen."""

    learning_rate: ClassVar[float] = 1e-3
    regularisation_weight: ClassVar[float] = 0.0

    name: str = "refinement"
    updates: Count = 40
    states: Count = 64
    memory: Count = 20_000
    sampler_decay: Annotated[float, BELOW_ONE] = 0.6


ENTRY_POINT_GROUP = "scene_envs.algorithms"
"""Entry points of installed packages: modules that call :func:`register_algorithm` when they are imported."""

AlgorithmClass = TypeVar("AlgorithmClass", bound=type)

MEAN_REWARDS = ("clearance", "discriminator", "feasible_share", "reachability", "stability")
"""Names of the package's rewards that are means over the objects of a scene (``averages_objects``)."""


_FOLDER = "agents.post_training.algorithms"
_DISTILLATION = f"{_FOLDER}.guidance_distillation"
_ALGORITHMS: Registry[tuple[type[AlgorithmSettings], Any]] = Registry(
    "algorithm",
    ENTRY_POINT_GROUP,
    {
        "ddpo_sf": (DDPOSFSettings, f"{_FOLDER}.ddpo:DDPO"),
        "ddpo_is": (DDPOISSettings, f"{_FOLDER}.ddpo:DDPO"),
        "guidance_distillation": (GuidanceDistillationSettings, f"{_DISTILLATION}:GuidanceDistillation"),
        "refinement": (RefinementSettings, f"{_DISTILLATION}:GuidanceDistillation"),
        "nft": (NFTSettings, f"{_FOLDER}.forward_process:ForwardProcess"),
        "awm": (AWMSettings, f"{_FOLDER}.forward_process:ForwardProcess"),
    },
)
"""Settings and class of each algorithm; a class as ``module:class`` is imported when it is needed."""


def register_algorithm(
    name: str, settings: type[AlgorithmSettings] = DDPOSFSettings
) -> Callable[[AlgorithmClass], AlgorithmClass]:
    """Make an algorithm available as ``algorithm=name``; the same name again replaces it.

    The decorated class takes ``(settings, policy, stds)`` and extends :class:`agents.post_training.Algorithm` or one
    of its subclasses, such as :class:`agents.post_training.DDPO`.

    ``settings`` is the dataclass of the algorithm's keys, with a sentence for each under ``Attributes:``. An
    InvalidInputError if the name is not one word of letters, digits and underscores.
    """
    _ALGORITHMS.check_name(name, "my_ddpo")
    return _ALGORITHMS.adding(name, lambda algorithm: (settings, algorithm))


def default_algorithm(reward: Any) -> str:
    """The algorithm of a run that names none: ``nft`` for a reward that is a mean over the objects of a scene, and for
    sums and clips of such rewards, which it raises most from equal numbers of scenes; ``ddpo_sf`` for others.

    >>> default_algorithm("feasible_share"), default_algorithm({"name": "object_count"})
    ('nft', 'ddpo_sf')
    """

    def is_mean(part: Any) -> bool:
        name = part.get("name") if isinstance(part, Mapping) else part
        if isinstance(part, Mapping) and name in ("weighted_sum", "clip"):
            parts = part.get("rewards", [part.get("reward")])
            return isinstance(parts, list | tuple) and bool(parts) and all(map(is_mean, parts))
        return name in MEAN_REWARDS if isinstance(name, str) else bool(getattr(name, "averages_objects", False))

    return "nft" if is_mean(reward) else "ddpo_sf"


def list_algorithms() -> list[str]:
    """Names of all algorithms, those of installed packages included, sorted."""
    return _ALGORITHMS.names()


def algorithm_settings(name: str) -> type[AlgorithmSettings]:
    """The dataclass of an algorithm's keys; an UnknownNameError offers the nearest known name."""
    return _ALGORITHMS[name][0]


def make_algorithm(settings: AlgorithmSettings, policy: Any, stds: Any) -> Any:
    """The algorithm of these settings for a policy, whose steps have the standard deviations ``stds`` (S,)."""
    code = _ALGORITHMS[settings.name][1]
    if isinstance(code, str):
        module, _, attribute = code.partition(":")
        code = getattr(import_module(module), attribute)
    return code(settings, policy, stds)


@dataclass
class RegularisationSettings(Checked):
    """Settings of the regularisation: pretraining loss on real scenes.

    Attributes:
        objective: ``pretraining`` is the pretraining loss on real scenes. ``discriminative`` raises the likelihood of
            real scenes relative to the base prior and lowers that of samples of the base prior.
        weight: coefficient of this loss; null takes the default of the algorithm.
        base_samples: number of samples of the base prior in the discriminative loss; they are drawn once.
        hold: held-out loss, as a ratio to the base prior's, that the run holds by adjusting the coefficient, such as
            1.05; null keeps the coefficient constant.
        batch_size: real scenes per update.
        scenes: source of the real scenes: ``grammar``, or a dataset folder.
        bank_size: number of real scenes that are drawn from the grammar or read from the dataset, including the
            held-out scenes.
    """

    place = "regularisation."

    objective: Annotated[str, OneOf(("pretraining", "discriminative"))] = "pretraining"
    weight: Annotated[float, at_least(0)] | None = None
    base_samples: Count = 1024
    hold: Annotated[float, Limit(lambda ratio: ratio > 1, "must be a ratio above 1")] | None = None
    batch_size: Count = 48
    scenes: str = "grammar"
    bank_size: int = 4096

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.hold is not None and self.weight == 0:
            raise InvalidInputError(f"hold={self.hold:g} adjusts regularisation.weight, which is 0; give a weight")


RESUMABLE = ("recipe", "iterations", "output", "workers", "logger", "progress", "reward_limits")
"""Fields that may change between a run and its continuation."""


@dataclass
class PostTrainOptimizerSettings(OptimizerSettings):
    """The optimiser of a post-training run; its steps are updates.

    Attributes:
        lr: peak learning rate; null takes the default of the algorithm.
        chunk: scenes per forward and backward pass; null takes the whole batch at once.
    """

    lr: Positive | None = None  # type: ignore[assignment]
    chunk: Count | None = None


MIN_SAMPLES = 20
"""Samples that the guard's classifier needs."""


@dataclass
class GuardLimits(Checked):
    """Limits of figures of samples; null takes the default of the algorithm.

    Attributes:
        count: number of objects by which the Wasserstein-1 distance between object counts of samples and of real scenes
            may exceed the base prior's.
        stack: the same for the distance between the heights of the tallest stacks, in objects.
        category: the same for the KL divergence of the categories, in nats.
        classifier: the same for the accuracy of a classifier that tells samples from real scenes.
        reward: number of standard errors by which the mean reward of samples may lie below the best checkpoint's; no
            limit with a reward that learns.
    """

    place = "guard.limits."
    count: Nonnegative | None = None
    stack: Nonnegative | None = None
    category: Nonnegative | None = None
    classifier: Nonnegative | None = None
    reward: Nonnegative | None = None


@dataclass
class GuardSettings(Checked):
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
        limits: limits of the figures of samples.
    """

    place = "guard."
    every: Count = 5
    scenes: Count = 256
    limit: Unlimited = 1.5
    action: Annotated[str, OneOf(("report", "stop", "rollback"))] = "report"
    samples: Natural = 128
    samples_every: Count = 20
    limits: GuardLimits = nested(GuardLimits)

    @property
    def sampled(self) -> int:
        """Number of scenes that a check samples, at most that of the held-out scenes; 0 below ``MIN_SAMPLES``."""
        count = min(self.samples, self.scenes)
        return count if count >= MIN_SAMPLES else 0

    def sample_limits(self, defaults: Mapping[str, float]) -> dict[str, float]:
        """Limits of figures of samples by name; ``defaults`` are the algorithm's."""
        own = {
            "count_distance": self.limits.count,
            "stack_distance": self.limits.stack,
            "category_kl": self.limits.category,
            "classifier_accuracy": self.limits.classifier,
            "reward": self.limits.reward,
        }
        return {**defaults, **{name: limit for name, limit in own.items() if limit is not None}}


@dataclass
class PostTrainLoggerSettings(LoggerSettings):
    """Files and report of a post-training run.

    Attributes:
        report_scenes: number of fresh samples, before and after the run, that report.html measures and shows; 0 for no
            report.
    """

    report_scenes: Natural = 256


@composed
@dataclass
class PostTrainConfig(GuidanceKeys, SamplingKeys, EngineKeys, TrainingKeys, ProgressKeys, RewardLimitKeys):
    """One post-training run.

    With DDPO-SF, the gradient that AdamW sees is that of

        - step_scale * sum over gradient steps of mean over scenes of  A * log p(x_{t-1} | x_t)
        + regularisation.weight * pretraining loss on real scenes

    where ``step_scale = steps with weight > 0 / gradient_steps``. log p is a mean over the random entries of a scene,
    and the pretraining loss is a mean over scenes and entries. The weight is meaningful only with these reductions.

    Keys that are not listed are those of :class:`~agents.configuration.composition.SamplingKeys`,
    :class:`~agents.configuration.composition.TrainingKeys` and the other bases.

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
        seed: seed of the initial noise, the chain's noise, the choice of steps and the real scenes.
        algorithm: the post-training algorithm; by default that of :func:`default_algorithm`.
        optimizer: the optimiser of the weights.
        regularisation: losses that keep the prior near real scenes.
        guard: checks on held-out real scenes.
        logger: log files and report.
    """

    iterations: Count = 60
    batch_size: Annotated[int, at_least(2)] = 48
    workers: Any = 0
    prior: str = "dimsum_table"
    reward: Any = named("object_count", "reward")
    prompt: Texts = None
    num_steps: Count = 25
    algorithm: AlgorithmSettings = nested(
        DDPOSFSettings, folder="algorithm", option="ddpo_sf", kinds=algorithm_settings, registered=list_algorithms
    )
    optimizer: PostTrainOptimizerSettings = nested(
        PostTrainOptimizerSettings, folder="optimizer", option="adamw", registered=lambda: OPTIMIZERS
    )
    regularisation: RegularisationSettings = nested(RegularisationSettings)
    guard: GuardSettings = nested(GuardSettings)
    logger: PostTrainLoggerSettings = nested(
        PostTrainLoggerSettings, folder="logger", option="csv", registered=lambda: LOGGERS
    )

    @classmethod
    def implied_options(cls, values: Mapping[str, Any]) -> dict[str, str]:
        """Options of the groups for which ``values`` choose none."""
        return {"algorithm": default_algorithm(values.get("reward", cls.reward))}

    def __post_init__(self) -> None:
        super().__post_init__()
        WORKERS.check("", "workers", self.workers, False)
        self.prompt = list(self.prompt) if isinstance(self.prompt, tuple) else self.prompt
        check_prompt(self.prompt)
        check_guidance(self.prompt, self.guidance)
        if self.optimizer.lr is None:
            self.optimizer = replace(self.optimizer, lr=self.algorithm.learning_rate)
        if self.regularisation.weight is None:
            self.regularisation = replace(self.regularisation, weight=self.algorithm.regularisation_weight)
        hold, limit = self.regularisation.hold, self.guard.limit
        if hold is not None and hold > limit:
            raise InvalidInputError(
                f"hold={hold:g} lies beyond guard.limit={limit:g}, past which no prior is kept; raise guard.limit, or "
                f"hold at most {limit:g}"
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


def check_prompt(prompt: Any) -> None:
    """Refuse a prompt that is no text, list of texts, source of prompts or None."""
    texts = [prompt] if isinstance(prompt, str) else prompt
    good = prompt is None or (
        isinstance(texts, list | tuple) and texts and all(isinstance(t, str) and t for t in texts)
    )
    if not good:
        raise InvalidInputError(
            f"prompt={prompt!r} must be a text, a list of texts, one of {', '.join(PROMPT_SOURCES)}, or null"
        )


def _is_plain(value: Any) -> bool:
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, str | int | float | bool)
