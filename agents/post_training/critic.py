"""Critic of noised scenes: how good an object, or a scene, is expected to become."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from torch import Tensor, nn

from agents.networks.text import Text
from agents.priors.base import ScenePrior
from agents.priors.forward import NoisedScenes


class Critic(nn.Module):
    """Expected advantage of noised scenes, per slot: a copy of a prior's denoiser with one number read from its output.

    It begins with 0 everywhere, and learns by regression. What it foresees is no merit of the steps that are left, and
    leaves the advantage, as the baseline of a policy gradient does (Sutton et al. 1999); where the state alone says how
    a scene ends, nothing is left to reinforce.

    Args:
        prior: whose denoiser is copied.
        learning_rate: of AdamW.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> noised = prior.noised(prior.encode(prior.sample(2, num_steps=3)))
    >>> Critic(prior)(noised).abs().sum().item()
    0.0
    """

    def __init__(self, prior: ScenePrior, learning_rate: float = 3e-4) -> None:
        super().__init__()
        self.prior = deepcopy(prior).requires_grad_(True)
        self.prior.freeze_text()
        self.read = nn.Linear(prior.pose_width, 1)
        nn.init.zeros_(self.read.weight)
        nn.init.zeros_(self.read.bias)
        self.to(prior.device)
        trained = [p for p in self.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(trained, lr=learning_rate, weight_decay=0.0)

    def forward(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B, N) expected advantage of each slot."""
        output = self.prior.output(noised, text).continuous[..., : self.read.in_features]
        value: Tensor = self.read(output)[..., 0]
        return value

    def step(self, clip: float = 1.0) -> None:
        """Apply the gradient that was accumulated."""
        trained = [p for group in self.optimizer.param_groups for p in group["params"]]
        if bool(torch.isfinite(nn.utils.clip_grad_norm_(trained, clip))):
            self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"weights": self.state_dict(), "optimizer": self.optimizer.state_dict()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self.load_state_dict(state["weights"])
        self.optimizer.load_state_dict(state["optimizer"])
