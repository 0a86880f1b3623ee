"""Typical places of objects in real scenes, by which learned measures standardise poses."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from agents.evaluation.scene_tokens import NEIGHBOUR_FEATURES, WAVE_FEATURES, SceneTokens
from agents.evaluation.set_network import SetNetworkConfig
from scene_envs.scene import POSE_FEATURES

_PRIOR_COUNT = 4.0
"""Weight, in objects, of the variance over all groups in the variance of one group."""
_CLIP = 8.0
_MIN_STD = 1e-4


@dataclass(frozen=True)
class Moments:
    """Mean and standard deviation (G, F) of each of G groups."""

    mean: Tensor
    std: Tensor

    @classmethod
    def of(cls, values: Tensor, groups: Tensor, count: int) -> Moments:
        """From ``values`` (M, F) of ``groups`` (M,); the variance of rare groups shrinks to that within all groups."""
        values = values.double()
        size = torch.bincount(groups, minlength=count)[:, None].double()
        mean = torch.zeros(count, values.shape[-1], dtype=torch.float64).index_add(0, groups, values)
        mean = mean / size.clamp(min=1.0)
        squares = torch.zeros_like(mean).index_add(0, groups, (values - mean[groups]) ** 2)
        overall = squares.sum(dim=0) / size.sum().clamp(min=1.0)
        variance = (squares + _PRIOR_COUNT * overall) / (size + _PRIOR_COUNT)
        return cls(mean.float(), variance.sqrt().clamp(min=_MIN_STD).float())

    def deviations(self, values: Tensor, groups: Tensor) -> Tensor:
        """(..., 2 F): values in standard deviations from the mean of their group, and log(1 + their squares)."""
        scaled = (values - self.mean[groups]) / self.std[groups]
        return torch.cat([scaled.clamp(-_CLIP, _CLIP), scaled.square().log1p()], dim=-1)


@dataclass(frozen=True)
class TypicalPlaces:
    """Places of real objects: poses per asset, offsets to neighbours per pair of assets."""

    poses: Moments
    offsets: Moments
    width: int

    @classmethod
    def of(cls, real: SceneTokens, width: int) -> TypicalPlaces:
        """From real scenes of ``width`` categories, empty included."""
        there = real.neighbours != width - 1
        pairs = _pairs(real, width)[there]
        poses = Moments.of(real.poses[real.present], real.categories[real.present], width)
        return cls(poses, Moments.of(real.offsets[there], pairs, width * width), width)

    def network_config(self, outputs: int) -> SetNetworkConfig:
        """Size of a network that reads :meth:`inputs`."""
        features, pair_features = 2 * POSE_FEATURES + WAVE_FEATURES, 2 * NEIGHBOUR_FEATURES
        return SetNetworkConfig(features, self.width, outputs=outputs, pair_features=pair_features)

    def inputs(self, tokens: SceneTokens) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Arguments of a :class:`~agents.evaluation.set_network.SetNetwork` for these scenes."""
        own, pairs = self._deviations(tokens)
        own = torch.cat([own, tokens.waves], dim=-1)
        return own, tokens.categories, pairs, tokens.neighbours, tokens.present

    def _deviations(self, tokens: SceneTokens) -> tuple[Tensor, Tensor]:
        """Deviations of the poses (B, N, 24) and of the offsets (B, N, K, 14)."""
        there = (tokens.neighbours != self.width - 1)[..., None]
        pairs = self.offsets.deviations(tokens.offsets, _pairs(tokens, self.width)) * there
        return self.poses.deviations(tokens.poses, tokens.categories), pairs


def _pairs(tokens: SceneTokens, width: int) -> Tensor:
    """(B, N, K) index of the ordered pair of assets."""
    return tokens.categories[..., None] * width + tokens.neighbours
