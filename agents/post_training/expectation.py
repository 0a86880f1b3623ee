"""Expectation of the own samples: a copy of the denoiser that is trained on them, as in pretraining."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from agents.networks.low_rank import LowRank
from agents.networks.text import Text
from agents.priors.base import ScenePrior
from agents.priors.forward import NoisedScenes
from agents.utils.process_group import ProcessGroup


class Expectation(nn.Module):
    """What the target of a denoiser is on average at a noised scene, over the scenes that the sampling policy makes.

    A forward-process loss pulls toward the targets of good samples and away from those of bad ones, and takes the
    sampling policy's output as their mean. It is not: a policy in training is no denoiser of its own samples. Where all
    samples are bad, the difference pushes the policy on, the policy follows, and the difference grows. This copy of the
    denoiser learns the mean, so that only the covariance of target and advantage is left, as in a policy gradient whose
    baseline is exact.

    Args:
        prior: whose denoiser is copied.
        learning_rate: of AdamW.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> noised = prior.noised(prior.encode(prior.sample(2, num_steps=3)))
    >>> expectation = Expectation(prior)
    >>> bool((expectation(noised) == prior.output(noised).continuous).all())
    True
    """

    def __init__(self, prior: ScenePrior, learning_rate: float = 3e-4) -> None:
        super().__init__()
        self.prior = deepcopy(prior).requires_grad_(True)
        for update in (module for module in self.prior.modules() if isinstance(module, LowRank)):
            update.requires_grad_(False)  # the copy learns with all weights
        self.prior.freeze_text()
        self.trained = [p for p in self.prior.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(self.trained, lr=learning_rate, weight_decay=0.0)

    def forward(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B, N, F) expected targets."""
        return self.prior.output(noised, text).continuous

    def step(self, clip: float = 1.0) -> None:
        """Apply the gradient that all processes accumulated; one that is not finite is dropped."""
        ProcessGroup.current().sum_gradients(self.trained)
        if bool(torch.isfinite(nn.utils.clip_grad_norm_(self.trained, clip))):
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"weights": self.prior.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self.prior.load_state_dict(state["weights"])
        self.optimizer.load_state_dict(state["optimizer"])
