"""Chains small enough for closed forms."""

from __future__ import annotations

import torch
from torch import Generator, Tensor, nn

from agents.diffusion import GaussianStep, StepTable


class LinearChain(nn.Module):
    """x_{t-1} ~ N(theta x_t, sigma^2) in one slot of one feature; a last, deterministic step follows."""

    conditional = False

    def __init__(self, theta: float, sigmas: tuple[float, ...]) -> None:
        super().__init__()
        self.theta = nn.Parameter(torch.tensor(theta, dtype=torch.float64))
        self.sigmas = sigmas

    def step_table(self, num_steps: int) -> StepTable:
        assert num_steps == len(self.sigmas) + 1
        return StepTable.from_timesteps(list(range(num_steps, 0, -1)))

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        return torch.full((count, slots, 1), 1.5, dtype=torch.float64)

    def transition(self, x_t: Tensor, step: int, table: StepTable) -> GaussianStep:
        sigma = self.sigmas[step] if step < len(self.sigmas) else 0.0
        return GaussianStep(self.theta * x_t, torch.full(x_t.shape[1:], sigma, dtype=x_t.dtype))
