"""MiDiffusion's denoiser: a transformer over the objects of a scene (Hu et al. 2024, "Mixed Diffusion for 3D Indoor
Scene Synthesis", section on the denoising network).

Each object is a token, made of the embedding of its category and an MLP of its pose. Every block has self-attention
among objects, cross-attention to the condition and a feed-forward layer, each behind a layer norm whose scale and shift
are functions of time. Separate heads predict categories and poses. The paper's condition is a floor plan; here it is
text, as in the comparison of Pfaff et al. (CoRL 2025). There is no positional encoding.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.baseline import (
    Attention,
    BaselineConfig,
    ContinuousBaseline,
    MixedBaseline,
    MixedBaselineConfig,
    mlp,
)
from scene_envs.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class _Size(BaselineConfig):
    depth: int = 6
    mlp_ratio: float = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.depth < 1:
            raise InvalidInputError(f"depth={self.depth} is not positive")


@dataclass(frozen=True, kw_only=True)
class MiDiffusionConfig(_Size):
    """Size of a :class:`MiDiffusion`.

    Attributes:
        features: D, numbers per slot.
        hidden: width of the tokens; a multiple of ``heads``.
        depth: blocks.
        heads: attention heads.
        mlp_ratio: width of the feed-forward layers over ``hidden``.
        text_width: width of the text tokens; 0 for none.
        frequencies: octaves of Fourier features of each translation; 0 for none, as published.
    """

    features: int


@dataclass(frozen=True, kw_only=True)
class MixedMiDiffusionConfig(_Size, MixedBaselineConfig):
    """Size of a :class:`MixedMiDiffusion`: that of :class:`MiDiffusionConfig`, and :class:`MixedBaselineConfig`."""


class _AdaptiveNorm(nn.Module):
    """Layer norm whose scale and shift are linear in the time embedding (adaptive layer norm)."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.hidden = hidden
        self.modulation = nn.Linear(hidden, 2 * hidden)
        nn.init.zeros_(self.modulation.weight)
        nn.init.zeros_(self.modulation.bias)

    def forward(self, tokens: Tensor, condition: Tensor) -> Tensor:
        shift, scale = self.modulation(F.silu(condition)).unsqueeze(1).chunk(2, dim=-1)
        return (1 + scale) * F.layer_norm(tokens, (self.hidden,)) + shift


class _Block(nn.Module):
    """Self-attention, cross-attention to the text when there is any, and a feed-forward layer."""

    def __init__(self, config: _Size) -> None:
        super().__init__()
        hidden = config.hidden
        self.norm, self.feed_norm = _AdaptiveNorm(hidden), _AdaptiveNorm(hidden)
        self.attention = Attention(hidden, config.heads)
        self.text_norm = _AdaptiveNorm(hidden) if config.text_width else None
        self.text_attention = Attention(hidden, config.heads) if config.text_width else None
        self.feed = mlp(hidden, round(hidden * config.mlp_ratio), hidden)

    def forward(self, tokens: Tensor, condition: Tensor, text: Tensor | None, mask: Tensor | None) -> Tensor:
        normal = self.norm(tokens, condition)
        tokens = tokens + self.attention(normal, normal)
        if self.text_norm is not None and self.text_attention is not None and text is not None:
            tokens = tokens + self.text_attention(self.text_norm(tokens, condition), text, mask)
        return tokens + self.feed(self.feed_norm(tokens, condition))


class _Transformer(nn.Module):
    """The trunk: blocks, one after the other."""

    def __init__(self, config: _Size) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.depth))

    def forward(self, tokens: Tensor, condition: Tensor, text: Tensor | None, mask: Tensor | None) -> Tensor:
        for block in self.blocks:
            tokens = block(tokens, condition, text, mask)
        return tokens


class MiDiffusion(ContinuousBaseline):
    """Scenes (B, N, D) at a noise level (B,) to a prediction (B, N, D); permutation-equivariant in N.

    >>> import torch
    >>> network = MiDiffusion(MiDiffusionConfig(features=20, hidden=32, depth=2, heads=2))
    >>> x = torch.randn(2, 34, 20)
    >>> network(x, x, torch.tensor([0.1, 0.2])).shape
    torch.Size([2, 34, 20])
    """

    def __init__(self, config: MiDiffusionConfig) -> None:
        super().__init__(config, config.features, _Transformer(config))


class MixedMiDiffusion(MixedBaseline):
    """Poses (B, N, 12) and states (B, N) to a pose output (B, N, 12) and logits (B, N, K); permutation-equivariant.

    >>> import torch
    >>> network = MixedMiDiffusion(MixedMiDiffusionConfig(categories=8, hidden=32, depth=2, heads=2, text_width=16))
    >>> pose, states = torch.randn(2, 5, 12), torch.randint(9, (2, 5))
    >>> out, logits = network(pose, states, torch.tensor([3.0, 7.0]), text=torch.randn(2, 4, 16))
    >>> out.shape, logits.shape
    (torch.Size([2, 5, 12]), torch.Size([2, 5, 8]))
    """

    def __init__(self, config: MixedMiDiffusionConfig) -> None:
        super().__init__(config, _Transformer(config))
