"""Guard against over-optimisation: pretraining loss and realism on held-out real scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Generator, Tensor

from agents.post_training.gradients import prompted_loss
from agents.priors.base import ScenePrior
from scene_envs.scene import SceneBatch

_CHUNK = 256


@dataclass(frozen=True)
class GuardReading:
    """One check.

    Attributes:
        iteration: when.
        loss: pretraining loss on the held-out real scenes, noise and timesteps fixed.
        ratio: over the base prior's.
        reward: mean valid reward since the check before.
        realism: figures of the last rollout's scenes, such as ``workspace_fraction``.
        kept: whether this became the best checkpoint.
    """

    iteration: int
    loss: float
    ratio: float
    reward: float
    realism: dict[str, float] = field(default_factory=dict)
    kept: bool = False


class Guard:
    """Watches the held-out pretraining loss and keeps the best checkpoint under a limit.

    The best is the one with the largest reward among checks whose ratio is within the limit; the reward of a
    check is the mean over all batches since the one before, which single batches are too noisy for.

    Args:
        heldout: (K, N, D) normalised real scenes that the regularisation never sees.
        limit: largest ratio of a checkpoint worth keeping.
        seed: of the fixed timesteps and noise.
        prompts: one of each held-out scene; None measures without.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior()
    >>> guard = Guard(prior.sample_tensor(4, num_steps=2), limit=1.5, seed=0)
    >>> guard.start(prior)
    >>> guard.check(prior, 10, reward=1.0).ratio
    1.0
    """

    def __init__(self, heldout: Tensor, limit: float, seed: int, prompts: Sequence[str] | None = None) -> None:
        self.heldout = heldout
        self.prompts = prompts
        self.limit = limit
        self.seed = seed
        self.base_loss = float("nan")
        self.readings: list[GuardReading] = []
        self.best_reward = float("-inf")
        self.best_iteration = 0

    def start(self, base: ScenePrior) -> None:
        """Measure the base prior."""
        self.base_loss = self.loss(base)

    @torch.no_grad()
    def loss(self, prior: ScenePrior) -> float:
        """Pretraining loss on the held-out scenes; the same timesteps and noise at every call."""
        from agents.pretraining.trainer import heldout_loss

        device = next(prior.parameters()).device
        if self.prompts is not None:
            generator = Generator().manual_seed(self.seed)
            losses = [
                prompted_loss(prior, x0.to(device), self.prompts[start : start + _CHUNK], generator)
                for start, x0 in zip(range(0, len(self.heldout), _CHUNK), self.heldout.split(_CHUNK), strict=True)
            ]
            return float(torch.cat(losses).mean())
        return heldout_loss(prior, self.heldout.to(device), seed=self.seed)

    def check(
        self, prior: ScenePrior, iteration: int, reward: float, realism: dict[str, float] | None = None
    ) -> GuardReading:
        """Measure ``prior``; the reading says whether it is the best so far."""
        loss = self.loss(prior)
        ratio = loss / self.base_loss
        kept = ratio <= self.limit and reward > self.best_reward  # False for NaN
        reading = GuardReading(iteration, loss, ratio, reward, realism or {}, kept)
        self.readings.append(reading)
        if kept:
            self.best_reward, self.best_iteration = reward, iteration
        return reading

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
        """First iteration whose ratio passed the limit, or None: from there on the reward is over-optimised."""
        return next((r.iteration for r in self.readings if not r.ratio <= self.limit), None)

    def summary(self) -> dict[str, Any]:
        """JSON-able: the ratio of what was kept, and where the limit was passed."""
        return {
            "ratio": self.best_ratio,
            "last_ratio": self.ratio,
            "limit": self.limit,
            "base_loss": self.base_loss,
            "best_iteration": self.best_iteration,
            "over_optimised_from": self.over_limit_at,
            "checks": [vars(reading) for reading in self.readings],
        }

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "base_loss": self.base_loss,
            "readings": [dict(vars(reading)) for reading in self.readings],
            "best_reward": self.best_reward,
            "best_iteration": self.best_iteration,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self.base_loss = state["base_loss"]
        self.readings = [GuardReading(**reading) for reading in state["readings"]]
        self.best_reward, self.best_iteration = state["best_reward"], state["best_iteration"]


def realism(batch: SceneBatch) -> dict[str, float]:
    """Cheap figures of finished scenes: share of objects in the workspace, median height error (mm) per support."""
    from agents.evaluation.metrics import height_errors, workspace_fraction

    figures = {"workspace_fraction": workspace_fraction(batch)} if int(batch.counts.sum()) else {}
    for kind, errors in height_errors(batch).items():
        if len(errors):
            figures[f"height_error_{kind}_mm"] = 1e3 * float(errors.quantile(0.5))
    return figures
