"""Base class of algorithms that sample with an average of the weights in training."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from agents.post_training.base import Algorithm
from agents.post_training.policy import DenoisingPolicy
from agents.priors.prior import ScenePrior
from agents.utils.weight_average import WeightAverage


class AveragedSampler(Algorithm):
    """An algorithm that samples with a separate copy of the prior, whose weights are also evaluated and saved.

    After each batch the copy moves towards the prior in training.

    Args:
        policy: policy that is optimised.
        sampler_decay: final decay, per batch, of the weight average that samples.
        warm_up: warm-up of the decay, see :class:`~agents.utils.weight_average.WeightAverage`.

    Attributes:
        prior: the prior in training.
        sampler: the prior that samples.
    """

    def __init__(self, policy: DenoisingPolicy, *, sampler_decay: float, warm_up: float = 10.0) -> None:
        self.policy = policy
        self.prior: ScenePrior = policy.prior  # type: ignore[assignment]
        self.sampler = deepcopy(self.prior).eval().requires_grad_(False)
        self._sampling_policy = DenoisingPolicy(
            self.sampler, len(policy), chunk=policy.chunk, guidance=policy.guidance,
            claim_guidance=policy.claim_guidance, independent=False,
        )  # fmt: skip  # it needs no log-probabilities
        self._average = WeightAverage(self.prior, sampler_decay, warm_up)

    @property
    def sampling_policy(self) -> DenoisingPolicy:
        """The reverse chain of the copy that samples."""
        return self._sampling_policy

    @property
    def average(self) -> WeightAverage:
        """The weights of the copy that samples."""
        return self._average

    def end_iteration(self) -> None:
        """Move the copy towards the prior in training."""
        self._average.update(self.prior)
        self._average.copy_to(self.sampler)

    def return_to(self, prior: ScenePrior) -> None:
        """Sample with the weights of ``prior``, and begin their average anew."""
        self._average = WeightAverage(prior, self._average.decay, self._average.warm_up)
        self._average.copy_to(self.sampler)

    def state(self) -> dict[str, Any]:
        """The weights of the copy, and the number of their updates."""
        return {"sampler": self._average.tensors, "updates": self._average.updates}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self._average.restore(state["sampler"], state["updates"])
        self._average.copy_to(self.sampler)
