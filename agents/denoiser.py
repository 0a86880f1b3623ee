"""What a prior is made of, and its network inside its process."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from agents.diffusion import GaussianProcess
from agents.networks.registry import ContinuousNetworkConfig


@dataclass(frozen=True)
class PriorConfig:
    """What a prior is made of.

    Attributes:
        scene_type: name of its scene type.
        slots: slots per scene that it was trained on.
        network: kind and size of its denoiser, any configuration of a continuous network.
        schedule: noise schedule, ``"karras"``, ``"linear"`` or ``"cosine"``.
        prediction: ``"karras"``, ``"epsilon"``, ``"x0"`` or ``"v"``.
        num_timesteps: T of the schedule.
        noise_mean: mean of ln(noise-to-signal) over training timesteps.
        noise_std: its standard deviation.
        translation_weight: weight of x, y, z in the pretraining loss, other features having 1.
        rotation: what is diffused as rotation, ``"matrix"``, ``"quaternion"`` or ``"axis_angle"``.
        timesteps: law of training timesteps, ``"lognormal"`` (of the noise-to-signal ratio), ``"uniform"`` or
            ``"both"`` in equal parts; None is what was published with the prediction, lognormal for ``"karras"`` and
            uniform for the others.
        loss_weighting: of the loss by timestep, ``"none"`` or ``"min_snr"``.
        noise_floor: lowest noise-to-signal ratio of the ``"karras"`` schedule, in normalised units.
        noise_ceiling: highest.
        clip: bound on denoised scenes while sampling, normalised units; 0 for none (1 is that of Ho et al. 2020).
    """

    scene_type: str
    slots: int
    network: ContinuousNetworkConfig
    schedule: str = "karras"
    prediction: str = "karras"
    num_timesteps: int = 1000
    noise_mean: float = -1.8
    noise_std: float = 2.1
    translation_weight: float = 3.0
    rotation: str = "matrix"
    timesteps: str | None = None
    loss_weighting: str = "none"
    noise_floor: float = 0.002
    noise_ceiling: float = 80.0
    clip: float = 0.0


def timestep_law(timesteps: str | None, prediction: str) -> str:
    """The law of training timesteps: the given one, or that which was published with ``prediction``.

    >>> timestep_law(None, "epsilon"), timestep_law(None, "karras"), timestep_law("lognormal", "v")
    ('uniform', 'lognormal', 'lognormal')
    """
    return timesteps or ("lognormal" if prediction == "karras" else "uniform")


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
