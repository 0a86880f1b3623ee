"""Fourier features of translations, damped by the noise on them (integrated encoding of mip-NeRF)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene


@dataclass(frozen=True)
class FourierFeaturesConfig(ModuleConfig):
    """Fourier features of each translation.

    Attributes:
        octaves: F, waves per axis; the longest has half a period per normalised unit.
    """

    octaves: int = 8

    name = "fourier_features"
    place = "slots"
    reads_geometry = True

    @property
    def pose_width(self) -> int:
        return 6 * self.octaves

    def build(self, core: FluxSizes) -> FourierFeatures:
        return FourierFeatures(self.octaves)


class FourierFeatures(FluxModule):
    """Sines and cosines (B, N, 6 F) of translations, each damped to its mean under the noise.

    Under Gaussian noise of standard deviation s, E sin(w x) is sin(w x) exp(-w^2 s^2 / 2).
    """

    def __init__(self, octaves: int) -> None:
        super().__init__()
        self.octaves: Tensor
        values = math.pi * 2.0 ** torch.arange(octaves, dtype=torch.float32)
        self.register_buffer("octaves", values, persistent=False)

    def pose_features(self, scene: Scene) -> Tensor | None:
        if scene.position is None or scene.noise_level is None:
            return None
        return fourier_features(scene.position, scene.noise_level, self.octaves)


def fourier_features(position: Tensor, noise_level: Tensor, octaves: Tensor) -> Tensor:
    """(B, N, 6 F) features of translations under noise (B, N).

    The translations are the first three features of ``position`` (B, N, D).
    """
    angle = position[..., :3, None] * octaves  # (B, N, 3, F)
    damping = torch.exp(-0.5 * (octaves * noise_level[..., None]) ** 2).unsqueeze(-2)  # (B, N, 1, F)
    return torch.cat([(angle.sin() * damping).flatten(-2), (angle.cos() * damping).flatten(-2)], dim=-1)
