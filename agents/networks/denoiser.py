"""The denoiser of a continuous prior: a network together with its diffusion process."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from agents.diffusion import GaussianProcess


def autocast(like: Tensor, precision: torch.dtype) -> torch.autocast:
    """The context in which a network runs in ``precision`` on the device of ``like``; does nothing for float32."""
    return torch.autocast(like.device.type, precision, enabled=precision != torch.float32)


class Denoiser(nn.Module):
    """A network together with its process: x_t (B, N, D) and t (B,) to the denoised scene x_0 (B, N, D).

    Attributes:
        precision: number format of the network alone (``torch.bfloat16`` for autocast); the chain is always float32.
    """

    def __init__(self, network: nn.Module, process: GaussianProcess) -> None:
        super().__init__()
        self.network = network
        self.process = process
        self.precision = torch.float32

    def output(self, x_t: Tensor, t: Tensor) -> Tensor:
        """The raw network output (B, N, D), in the units of ``process.target``."""
        process = self.process
        alpha, _ = process.rates(t, x_t)
        level = (process.sigma[t.cpu()] / process.alpha[t.cpu()]).to(x_t.device)
        with autocast(x_t, self.precision):
            result: Tensor = self.network(process.network_input(x_t, t), x_t / alpha, level)
        return result.to(x_t.dtype)

    def forward(self, x_t: Tensor, t: Tensor) -> Tensor:
        """The denoised scene x_0 (B, N, D), normalised."""
        return self.process.x0_from_output(x_t, t, self.output(x_t, t))
