"""Common part of the baseline networks: inputs for slots, time and text, and outputs for slots.

The *trunk* between inputs and outputs differs from baseline to baseline. It maps tokens (B, N, H), a time embedding
(B, H) and text (B, L, H) with its mask (B, 1, 1, L), both None without text, to tokens (B, N, H).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux import timestep_embedding
from agents.networks.fourier_features import fourier_features
from scene_envs.errors import InvalidInputError
from scene_envs.scene import POSE_FEATURES

_TIME_WIDTH = 256


@dataclass(frozen=True, kw_only=True)
class BaselineConfig:
    """Common part of the sizes of all baselines.

    Attributes:
        hidden: width of the tokens; a multiple of ``heads``.
        heads: attention heads.
        text_width: width of the text tokens; 0 for none.
        frequencies: octaves of Fourier features of each translation, damped by the noise; 0 for none, as published.
    """

    hidden: int = 128
    heads: int = 4
    text_width: int = 0
    frequencies: int = 0

    def __post_init__(self) -> None:
        for name in ("hidden", "heads"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name}={getattr(self, name)} is not positive")
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")

    @property
    def time_input(self) -> str:
        """The number that is embedded as time; see :class:`~agents.networks.MixedFluxConfig`."""
        return "log_noise" if self.frequencies else "timestep"


@dataclass(frozen=True, kw_only=True)
class MixedBaselineConfig(BaselineConfig):
    """Common part of the sizes of all baselines of mixed scenes.

    Attributes:
        categories: K = C + 1, assets and *empty*; the mask token is one more.
        time_scale: what timesteps are multiplied by before they are embedded.
        flags: 1 to tell the network which poses and categories are observed (inpainting), 0 as published.
    """

    categories: int
    time_scale: float = 1.0
    flags: int = 1


class Attention(nn.Module):
    """Multi-head attention of tokens (B, N, H) to ``source`` (B, M, H), which may be the same tokens.

    >>> attention = Attention(hidden=16, heads=2)
    >>> attention(torch.randn(2, 5, 16), torch.randn(2, 3, 16)).shape
    torch.Size([2, 5, 16])
    """

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(hidden, hidden)
        self.key_value = nn.Linear(hidden, 2 * hidden)
        self.out = nn.Linear(hidden, hidden)

    def forward(self, tokens: Tensor, source: Tensor, mask: Tensor | None = None) -> Tensor:
        """Attended (B, N, H); ``mask`` (B, 1, 1, M) is True where to attend."""
        query = self.query(tokens).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        key, value = self.key_value(source).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        attended = F.scaled_dot_product_attention(query, key, value, attn_mask=mask)
        return self.out(attended.transpose(1, 2).flatten(-2))


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a GELU between them."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, outputs))


def head(hidden: int, outputs: int) -> nn.Sequential:
    """Layer norm and two layers, of which the last starts at zero."""
    last = nn.Linear(hidden, outputs)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, hidden), nn.GELU(), last)


class _Baseline(nn.Module):
    """A trunk with inputs for time and text."""

    def __init__(self, config: BaselineConfig, trunk: nn.Module) -> None:
        super().__init__()
        self.config = config
        hidden = config.hidden
        self.time_in = mlp(_TIME_WIDTH, hidden, hidden)
        self.text_in = nn.Linear(config.text_width, hidden) if config.text_width else None
        self.trunk = trunk
        octaves = math.pi * 2.0 ** torch.arange(config.frequencies, dtype=torch.float32)
        self.octaves: Tensor
        self.register_buffer("octaves", octaves, persistent=False)

    def _tokens(self, tokens: Tensor, time: Tensor, text: Tensor | None, text_mask: Tensor | None) -> Tensor:
        """Tokens (B, N, H) through the trunk; ``time`` (B,)."""
        condition = self.time_in(timestep_embedding(time, _TIME_WIDTH).to(tokens.dtype))
        if self.text_in is None:
            return self.trunk(tokens, condition, None, None)
        if text is None:
            text, text_mask = tokens.new_zeros(len(tokens), 1, self.text_in.in_features), None
        mask = None
        if text_mask is not None:
            text = text * text_mask[..., None]
            somewhere = text_mask.any(dim=-1, keepdim=True)
            mask = (text_mask | ~somewhere)[:, None, None]  # a row of padding alone is read as no text
        return self.trunk(tokens, condition, self.text_in(text), mask)

    def _with_octaves(self, features: Tensor, position: Tensor | None, noise_level: Tensor | None) -> Tensor:
        """Features (B, N, D), with Fourier features of the translations appended where the network has any.

        The translations are the first three features of ``position``.
        """
        if not len(self.octaves):
            return features
        if position is None or noise_level is None:
            raise InvalidInputError("a network with Fourier features needs position= and noise_level=")
        return torch.cat([features, fourier_features(position, noise_level, self.octaves)], dim=-1)


class ContinuousBaseline(_Baseline):
    """Scenes (B, N, D) at a noise level (B,) to a prediction (B, N, D), which starts at zero."""

    def __init__(self, config: BaselineConfig, features: int, trunk: nn.Module) -> None:
        super().__init__(config, trunk)
        self.scene_in = mlp(features + 6 * config.frequencies, config.hidden, config.hidden)
        self.scene_out = head(config.hidden, features)

    def forward(
        self,
        x: Tensor,
        position: Tensor,
        noise_level: Tensor,
        *,
        text: Tensor | None = None,
        text_mask: Tensor | None = None,
    ) -> Tensor:
        """Predict.

        Args:
            x: (B, N, D) network input, unit variance.
            position: (B, N, D) the scene in signal units; its first three features are read, for Fourier features.
            noise_level: (B,) noise-to-signal ratio of ``position``; its logarithm is the time that is embedded.
            text: (B, L, W) text tokens; None for no text.
            text_mask: (B, L) bool, True for real tokens.
        """
        levels = noise_level[:, None].expand(x.shape[:2])
        tokens = self.scene_in(self._with_octaves(x, position, levels))
        return self.scene_out(self._tokens(tokens, 250.0 * noise_level.log(), text, text_mask))


class MixedBaseline(_Baseline):
    """Poses (B, N, 12) and category states (B, N) to a pose output (B, N, 12) and logits (B, N, K), zero at first."""

    def __init__(self, config: MixedBaselineConfig, trunk: nn.Module) -> None:
        super().__init__(config, trunk)
        hidden = config.hidden
        self.time_scale = config.time_scale
        self.pose_in = mlp(POSE_FEATURES + 6 * config.frequencies, hidden, hidden)
        self.category_in = nn.Embedding(config.categories + 1, hidden)
        self.given_in = nn.Embedding(4, hidden) if config.flags else None
        if self.given_in is not None:
            nn.init.zeros_(self.given_in.weight)
        self.pose_out = head(hidden, POSE_FEATURES)
        self.logits_out = head(hidden, config.categories)

    def forward(
        self,
        pose: Tensor,
        states: Tensor,
        time: Tensor,
        *,
        text: Tensor | None = None,
        text_mask: Tensor | None = None,
        position: Tensor | None = None,
        noise_level: Tensor | None = None,
        observed: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Predict; arguments and results as in :meth:`agents.networks.mixed_flux.MixedFlux.forward`."""
        tokens = self.pose_in(self._with_octaves(pose, position, noise_level)) + self.category_in(states)
        if self.given_in is not None and observed is not None:
            tokens = tokens + self.given_in(observed)
        tokens = self._tokens(tokens, time * self.time_scale, text, text_mask)
        return self.pose_out(tokens), self.logits_out(tokens)
