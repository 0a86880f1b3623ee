"""Copy of a denoiser that learns the mean target of own samples."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from agents.networks.text import Text
from agents.priors.base import ScenePrior
from agents.priors.forward import NoisedScenes
from agents.utils.process_group import ProcessGroup


class Expectation(nn.Module):
    """Mean target of a denoiser at a noised scene, over the scenes that the sampling policy makes.

    A forward-process loss attracts the output to the targets of good samples, repels it from the targets of bad
    samples, and takes the output of the sampling policy as the mean target. This output is not the mean, because a
    policy in training is not an exact denoiser of its own samples. Where all samples are bad, the difference repels the
    output, the sampling policy follows, and the difference grows. This copy of the denoiser learns the mean. Only the
    covariance of target and advantage is then left, as in a policy gradient with an exact baseline.

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

    def return_to(self, prior: ScenePrior) -> None:
        """Take the weights of ``prior``, and forget the optimiser's state."""
        self.prior.load_state_dict(prior.state_dict())
        self.optimizer.state.clear()

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"weights": self.prior.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self.prior.load_state_dict(state["weights"])
        self.optimizer.load_state_dict(state["optimizer"])
