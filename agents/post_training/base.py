"""Base class of post-training algorithms: the interface that the training loop uses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

from torch import Generator
from torchrl.objectives import LossModule

from agents.post_training.gradients import BatchGradient
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import Rollout
from agents.priors.base import ScenePrior
from agents.utils.weight_average import WeightAverage

Credit = TypeVar("Credit")
"""Advantages of a batch, in the form that the algorithm's loss reads."""


class Algorithm(ABC, Generic[Credit]):
    """Rule that turns a batch of scenes into a gradient.

    Attributes:
        policy: the reverse chain of the prior in training.
        loss: what is minimised.
    """

    policy: DenoisingPolicy
    loss: LossModule

    @property
    def sampling_policy(self) -> DenoisingPolicy:
        """Policy that samples the scenes; the policy in training unless an algorithm keeps another."""
        return self.policy

    @property
    def average(self) -> WeightAverage | None:
        """Averaged weights that are evaluated and saved; None evaluates and saves the weights in training."""
        return None

    @abstractmethod
    def advantage(self, rollout: Rollout) -> Credit:
        """Advantages of the scenes of a batch, or of their objects."""

    @abstractmethod
    def accumulate(self, rollout: Rollout, advantage: Credit, generator: Generator) -> BatchGradient:
        """Add the gradient of a batch to ``.grad``; everything random is drawn from ``generator`` (CPU).

        With several processes, each process adds the gradient of its own scenes, as a part of the mean over all scenes.
        The training loop sums these parts.
        """

    def end_iteration(self) -> None:
        """Called after the last update of every batch."""
        return

    def return_to(self, prior: ScenePrior) -> None:
        """Called after the weights in training were replaced by those of ``prior``, an earlier checkpoint."""
        return

    def state(self) -> dict[str, Any]:
        """State that a resumed run needs in addition to the weights in training."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        return
