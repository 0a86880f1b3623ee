"""Guard against over-optimisation, by the held-out pretraining loss and by measures of samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from agents.priors.prior import ScenePrior
from agents.utils.checkpoints import derived_seed
from agents.utils.process_group import ProcessGroup
from scene_envs.envs.scoring import RewardScorer
from scene_envs.scene import SceneBatch

_AT_ONCE = 32
"""Number of scenes sampled together."""
_CLASSIFIERS = 3
"""Number of classifiers over which the accuracy is averaged."""
_STATE = ("base_loss", "base_samples", "best_reward", "best_error", "best_score", "best_iteration")
"""Attributes of a guard that are kept in a checkpoint, beside its readings."""


class Guard:
    """Monitor of the held-out pretraining loss and of samples, which selects the best checkpoint within all limits.

    The best checkpoint has the largest reward among the checks within all limits. If the guard samples, the reward of a
    check is that of the samples, which start from the same noise at every check. Checks of the loss alone then keep no
    checkpoint. Otherwise the reward of a check is the mean over all batches since the previous check, because single
    batches are too noisy. If the reward learns, its network differs from check to check, so its values cannot be
    compared. The best checkpoint is then the one at which the classifier, trained anew at each check, is least accurate
    in telling samples from real scenes.

    Args:
        heldout: (K, N, D) normalised real scenes that are not used by the regularisation.
        limit: largest ratio before the run counts as over-optimised; no checkpoint above it is kept.
        seed: seed of the fixed timesteps and noise.
        prompts: gives one prompt of each held-out scene; the loss is measured without prompts where it gives None.
        samples: settings for sampling and measuring; None measures the loss alone.
        limits: largest excess of each figure of samples over that of the base prior, by name; that of ``reward`` is
            the largest fall of the mean reward below the best checkpoint's, in standard errors of their difference,
            and is left out if the reward learns.
        target: largest ratio of a checkpoint that is kept, if the run holds the ratio.
        learns: whether the reward learns during the run.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior()
    >>> guard = Guard(prior.encode(prior.sample(4, num_steps=2)), limit=1.5, seed=0)
    >>> guard.start(prior)
    >>> guard.check(prior, 10, reward=1.0).ratio
    1.0
    """

    def __init__(
        self,
        heldout: Tensor,
        limit: float,
        seed: int,
        prompts: Callable[[], Sequence[str] | None] = lambda: None,
        samples: SampleCheck | None = None,
        limits: Mapping[str, float] | None = None,
        target: float = math.inf,
        learns: bool = False,
    ) -> None:
        self.heldout, self.prompts, self.samples = heldout, prompts, samples
        self.limit, self.target, self.learns, self.seed = limit, target, learns, seed
        self.limits = {name: most for name, most in (limits or {}).items() if not (learns and name == "reward")}
        self.base_loss = float("nan")
        self.base_samples: dict[str, float] = {}
        self.last_samples: SceneBatch | None = None
        self.readings: list[GuardReading] = []
        self.best_reward = self.best_score = float("-inf")
        self.best_error = float("nan")  # standard error of ``best_reward`` over samples
        self.best_iteration = 0

    def start(self, base: ScenePrior) -> None:
        """Measure the base prior."""
        self.base_loss, self.base_samples = self._measure(base, sample=True)
        if self.base_samples:
            reward = self.base_samples["sample_reward"]
            self.best_reward = float("-inf") if math.isnan(reward) else reward  # so that every reward is larger
            self.best_error = self.base_samples["sample_reward_error"]
            self.best_score = self._score(self.best_reward, self.base_samples)

    def _score(self, reward: float, figures: Mapping[str, float]) -> float:
        """Score by which checkpoints are compared; larger is better."""
        return -figures["classifier_accuracy"] if self.learns and figures else reward

    def _measure(self, prior: ScenePrior, sample: bool) -> tuple[float, dict[str, float]]:
        """The loss, and figures of samples if the guard samples; all processes get the values of the first process."""
        batch, check = None, self.samples
        if sample and check is not None:
            batch = self.last_samples = check.sample(prior)
        return ProcessGroup.current().from_first(
            lambda: (self.loss(prior), {} if check is None or batch is None else check.figures(batch))
        )

    @torch.no_grad()
    def loss(self, prior: ScenePrior) -> float:
        """Pretraining loss on the held-out scenes; the same timesteps and noise at every call."""
        from agents.pretraining.trainer import heldout_loss

        return heldout_loss(prior, self.heldout.to(prior.device), self.prompts(), self.seed)

    def check(
        self,
        prior: ScenePrior,
        iteration: int,
        reward: float,
        realism: dict[str, float] | None = None,
        *,
        sample: bool = True,
    ) -> GuardReading:
        """Measure ``prior``, which has the weights that are evaluated and saved, after ``iteration`` iterations; the
        reading says whether it is the best so far. ``reward`` is the mean over the batches since the check before,
        ``realism`` has further figures for the reading, and ``sample`` says whether a guard that samples does so now.
        """
        loss, figures = self._measure(prior, sample)
        ratio = loss / self.base_loss
        over = [] if ratio <= self.limit else ["loss"]
        if figures:
            reward = figures["sample_reward"]
            over += beyond(figures, self.base_samples, self.limits)
            over += ["reward"] if self._fell(figures) else []
        counts = self.samples is None or sample
        score = self._score(reward, figures)
        kept = counts and not over and ratio <= self.target and score > self.best_score  # False for NaN
        reading = GuardReading(iteration, loss, ratio, reward, realism or {}, kept, figures, tuple(over))
        self.readings.append(reading)
        if kept:
            self.best_reward, self.best_score, self.best_iteration = reward, score, iteration
            self.best_error = figures.get("sample_reward_error", float("nan"))
        return reading

    def _fell(self, figures: Mapping[str, float]) -> bool:
        """Whether the mean reward of samples is below the best checkpoint's by more than its limit, in standard errors
        of their difference; False for NaN.
        """
        error = math.hypot(self.best_error, figures["sample_reward_error"])
        fall = self.best_reward - figures["sample_reward"]
        return fall > self.limits.get("reward", math.inf) * error

    @property
    def ratio(self) -> float:
        """Ratio at the last check; 1 before the first."""
        return self.readings[-1].ratio if self.readings else 1.0

    @property
    def best_ratio(self) -> float:
        """Ratio of the best checkpoint; 1 when that is still the base prior."""
        return next((r.ratio for r in self.readings if r.iteration == self.best_iteration), 1.0)

    @property
    def over_limit_at(self) -> int | None:
        """Iteration of the first check beyond a limit, where the run has collapsed or is over-optimised; or None."""
        return next((r.iteration for r in self.readings if r.beyond), None)

    def summary(self) -> dict[str, Any]:
        """Summary as JSON values: ratio of the kept checkpoint, first check beyond a limit, limits, and all checks."""
        return {
            "ratio": self.best_ratio,
            "last_ratio": self.ratio,
            "limit": self.limit,
            "base_loss": self.base_loss,
            "base_samples": self.base_samples,
            "sample_limits": self.limits,
            "best_iteration": self.best_iteration,
            "over_optimised_from": self.over_limit_at,
            "checks": [vars(reading) for reading in self.readings],
        }

    def state(self) -> dict[str, Any]:
        """State for a checkpoint."""
        readings = [dict(vars(reading)) for reading in self.readings]
        return {**{name: getattr(self, name) for name in _STATE}, "readings": readings}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        for name in _STATE:
            setattr(self, name, state[name])
        self.readings = [GuardReading(**reading) for reading in state["readings"]]


@dataclass(frozen=True)
class SampleCheck:
    """Check that samples a prior from the same noise at every call, and measures the samples.

    >>> from agents.priors.testing import tiny_prior
    >>> scorer = RewardScorer("object_count")
    >>> prior = tiny_prior()
    >>> check = SampleCheck(prior.sample(20, num_steps=2, seed=1), scorer, 20, num_steps=2, seed=0)
    >>> sorted(check.figures(check.sample(prior)))
    ['category_kl', 'classifier_accuracy', 'count_distance', 'sample_reward', 'sample_reward_error', 'stack_distance']
    """

    real: SceneBatch  # scenes that are not used in training
    scorer: RewardScorer  # of the run's reward
    count: int  # number of samples
    num_steps: int  # denoising steps per sample
    seed: int
    slots: int | None = None  # per sample
    prompts: Sequence[str] | None = None  # one per sample
    guidance: float = 0.0  # weight of classifier-free guidance

    @torch.no_grad()
    def sample(self, prior: ScenePrior) -> SceneBatch:
        """``count`` scenes, from the same noise for every prior; each process of a run samples a share of them."""
        processes = ProcessGroup.current()
        starts = range(0, self.count, _AT_ONCE)
        own = {start: self._chunk(prior, start) for start in starts[processes.rank :: processes.size]}
        parts = {start: tensor for found in processes.gather(own) for start, tensor in found.items()}
        return SceneBatch(torch.cat([parts[start] for start in starts]), self.real.scene_type)

    def _chunk(self, prior: ScenePrior, start: int) -> Tensor:
        """Scenes (b, N, D) from number ``start`` on, whose noise depends on that number."""
        count = min(_AT_ONCE, self.count - start)
        prompts = None if self.prompts is None else list(self.prompts[start : start + count])
        guided = prompts is not None and any(prompts)
        batch = prior.sample(
            count,
            prompt=prompts,
            guidance=self.guidance if guided else 0.0,
            physics_guidance=0.0,
            num_steps=self.num_steps,
            slots=self.slots,
            seed=derived_seed(self.seed, start),
        )
        return batch.tensor.cpu()

    def figures(self, batch: SceneBatch) -> dict[str, float]:
        """Mean reward and its standard error, and differences from the real scenes: distances of object counts and of
        tallest stacks (objects), KL divergence of categories (nats), and accuracy of a classifier (share of scenes). A
        figure that has no meaning, such as the categories of empty scenes, is NaN. Assets without geometry have no
        stacks.
        """
        from agents.evaluation.classifier import classifier_accuracy
        from agents.evaluation.layouts import category_kl, count_wasserstein, stack_wasserstein

        batch = batch.to("cpu")
        score = self.scorer(batch, self.prompts)
        rewards = score.value.cpu()[score.valid.cpu()]
        empty = not int(batch.counts.sum())
        return {
            "sample_reward": float(rewards.mean()) if len(rewards) else float("nan"),
            "sample_reward_error": float(rewards.std() / len(rewards) ** 0.5) if len(rewards) > 1 else float("nan"),
            "count_distance": count_wasserstein(batch, self.real),
            **({"stack_distance": stack_wasserstein(batch, self.real)} if batch.scene_type.has_geometry else {}),
            "category_kl": float("nan") if empty else category_kl(batch, self.real),
            "classifier_accuracy": classifier_accuracy(self.real, batch, seeds=_CLASSIFIERS, seed=self.seed).mean,
        }


def beyond(figures: Mapping[str, float], base: Mapping[str, float], limits: Mapping[str, float]) -> list[str]:
    """Names of the figures that exceed the base prior's by more than their limit. Figures without a limit, and limits
    of figures that were not measured, do not count.

    >>> beyond({"category_kl": 0.3}, {"category_kl": 0.1}, {"category_kl": 0.1, "stack_distance": 0.5})
    ['category_kl']
    """
    measured = [name for name in limits if name in figures and name in base]
    return [name for name in measured if not figures[name] <= base[name] + limits[name]]


@dataclass(frozen=True)
class GuardReading:
    """Result of one check."""

    iteration: int
    loss: float  # pretraining loss on the held-out real scenes, noise and timesteps fixed
    ratio: float  # ``loss`` divided by that of the base prior
    reward: float  # mean of the samples; without samples, mean valid reward since the check before
    realism: dict[str, float] = field(default_factory=dict)  # of the last rollout, such as ``workspace_fraction``
    kept: bool = False  # whether this became the best checkpoint
    samples: dict[str, float] = field(default_factory=dict)  # figures of samples; empty at a check of the loss alone
    beyond: tuple[str, ...] = ()  # names of the figures beyond their limit


def realism(batch: SceneBatch) -> dict[str, float]:
    """Cheap figures of finished scenes: share of objects in the workspace, median height error (mm) per support."""
    from agents.evaluation.layouts import height_errors, workspace_fraction

    figures = {"workspace_fraction": workspace_fraction(batch)} if int(batch.counts.sum()) else {}
    for kind, errors in height_errors(batch).items():
        if len(errors):
            figures[f"height_error_{kind}_mm"] = 1e3 * float(errors.quantile(0.5))
    return figures
