"""A Flux-style transformer over the slots of a scene, without positional encoding."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux_blocks import SingleStreamBlock
from agents.networks.fourier_features import fourier_features
from scene_envs.errors import InvalidInputError


@dataclass(frozen=True)
class FluxConfig:
    """Size of a :class:`FluxDenoiser`.

    Attributes:
        features: D, numbers per slot.
        hidden: width of the token stream; a multiple of ``heads``.
        depth: number of single-stream blocks.
        heads: attention heads.
        mlp_ratio: width of the MLP branch over ``hidden``.
        frequencies: octaves of Fourier features of each translation (0: none).
    """

    features: int
    hidden: int = 192
    depth: int = 6
    heads: int = 6
    mlp_ratio: float = 4.0
    frequencies: int = 8

    def __post_init__(self) -> None:
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")


def timestep_embedding(value: Tensor, width: int, max_period: float = 10_000.0) -> Tensor:
    """Sinusoidal embedding (B, width) of ``value`` (B,), cosines first."""
    half = width // 2
    value = value if value.is_floating_point() else value.float()
    frequency = torch.exp(-math.log(max_period) * torch.arange(half, device=value.device, dtype=value.dtype) / half)
    angle = value[:, None] * frequency[None]
    return torch.cat([angle.cos(), angle.sin()], dim=-1)


class FluxDenoiser(nn.Module):
    """Scenes (B, N, D) at a noise level (B,) to a prediction (B, N, D); permutation-equivariant in N.

    Translations enter twice: linearly, and as Fourier features damped by the noise level (the expected
    feature under the noise, as in mip-NeRF's integrated encoding). So attention can compare distances
    to a millimetre where the noise is small enough.

    >>> denoiser = FluxDenoiser(FluxConfig(features=20, hidden=32, depth=2, heads=2))
    >>> x = torch.randn(2, 34, 20)
    >>> denoiser(x, x, torch.tensor([0.1, 0.2])).shape
    torch.Size([2, 34, 20])
    """

    def __init__(self, config: FluxConfig) -> None:
        super().__init__()
        self.config = config
        hidden = config.hidden
        self.scene_in = nn.Linear(config.features + 6 * config.frequencies, hidden)
        self.time_in = nn.Sequential(nn.Linear(128, hidden), nn.SiLU(), nn.Linear(hidden, hidden))
        self.blocks = nn.ModuleList(
            SingleStreamBlock(hidden, config.heads, config.mlp_ratio) for _ in range(config.depth)
        )
        self.final_modulation = nn.Linear(hidden, 2 * hidden)
        self.out = nn.Linear(hidden, config.features)
        for layer in (self.final_modulation, self.out):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        octaves = math.pi * 2.0 ** torch.arange(config.frequencies, dtype=torch.float32)
        self.octaves: Tensor
        self.register_buffer("octaves", octaves, persistent=False)

    def forward(self, x: Tensor, position: Tensor, noise_level: Tensor) -> Tensor:
        """Predict.

        Args:
            x: (B, N, D) network input, unit variance.
            position: (B, N, D) the scene in signal units, x_t / alpha_t; its first three features are read.
            noise_level: (B,) noise-to-signal ratio of ``position``.
        """
        features = x
        if self.config.frequencies:
            features = torch.cat([x, fourier_features(position, noise_level[:, None], self.octaves)], dim=-1)
        condition = self.time_in(timestep_embedding(250.0 * noise_level.log(), 128))
        tokens = self.scene_in(features)
        for block in self.blocks:
            tokens = block(tokens, condition)
        shift, scale = self.final_modulation(F.silu(condition)).unsqueeze(1).chunk(2, dim=-1)
        return self.out((1 + scale) * F.layer_norm(tokens, (self.config.hidden,), eps=1e-6) + shift)
