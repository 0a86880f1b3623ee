"""What a prior is made of, and its network inside its process."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from agents.diffusion import GaussianProcess
from agents.networks import FluxConfig


@dataclass(frozen=True)
class PriorConfig:
    """What a prior is made of.

    Attributes:
        scene_type: name of its scene type.
        slots: slots per scene that it was trained on.
        network: size of its denoiser.
        schedule: noise schedule, ``"karras"``, ``"linear"`` or ``"cosine"``.
        prediction: ``"karras"``, ``"epsilon"``, ``"x0"`` or ``"v"``.
        num_timesteps: T of the schedule.
        noise_mean: mean of ln(noise-to-signal) over training timesteps.
        noise_std: its standard deviation.
        translation_weight: weight of x, y, z in the pretraining loss, other features having 1.
    """

    scene_type: str
    slots: int
    network: FluxConfig
    schedule: str = "karras"
    prediction: str = "karras"
    num_timesteps: int = 1000
    noise_mean: float = -1.8
    noise_std: float = 2.1
    translation_weight: float = 3.0


def autocast(like: Tensor, precision: torch.dtype) -> torch.autocast:
    """The context in which a network runs in ``precision`` on the device of ``like``; does nothing for float32."""
    return torch.autocast(like.device.type, precision, enabled=precision != torch.float32)


class Denoiser(nn.Module):
    """A network inside its process: x_t (B, N, D) and t (B,) to the denoised scene x_0 (B, N, D).

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
