"""DiffuScene's denoiser: a U-Net of 1-D convolutions along the slots of a scene (Tang et al. 2024, "DiffuScene:
Denoising Diffusion Models for Generative Indoor Scene Synthesis", section on the denoising network).

The attributes of an object are encoded to channels, and decoded, by MLPs that all objects share. Between encoder and
decoder there are residual blocks of convolutions, to which the time embedding is added. Each level has attention among
slots and, with text, from slots to words. As in the U-Net of Ho et al. 2020, convolutions of stride 2 halve the
resolution on the way down, and skip connections lead from each level on the way down to that on the way up.
Convolutions mix neighbouring slots, so the network depends on the order of slots, although scenes have no order.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.baseline import Attention, BaselineConfig, ContinuousBaseline, MixedBaseline, MixedBaselineConfig
from scene_envs.errors import InvalidInputError


@dataclass(frozen=True, kw_only=True)
class _Size(BaselineConfig):
    hidden: int = 64
    levels: int = 4
    blocks: int = 2
    inner_ratio: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("levels", "blocks"):
            if getattr(self, name) < 1:
                raise InvalidInputError(f"{name}={getattr(self, name)} is not positive")

    @property
    def inner(self) -> int:
        """Channels between the two convolutions of a residual block, a multiple of ``heads``."""
        return max(1, round(self.hidden * self.inner_ratio / self.heads)) * self.heads


@dataclass(frozen=True, kw_only=True)
class DiffuSceneConfig(_Size):
    """Size of a :class:`DiffuScene`.

    Attributes:
        features: D, numbers per slot.
        hidden: channels at every level; a multiple of ``heads``.
        levels: resolutions along the slots, each half of the one before.
        blocks: residual blocks per level, on the way down and again on the way up.
        heads: attention heads, and groups of the group norms.
        inner_ratio: channels between the two convolutions of a residual block, over ``hidden``.
        text_width: width of the text tokens; 0 for none.
        frequencies: octaves of Fourier features of each translation; 0 for none, as published.
    """

    features: int


@dataclass(frozen=True, kw_only=True)
class MixedDiffuSceneConfig(_Size, MixedBaselineConfig):
    """Size of a :class:`MixedDiffuScene`: that of :class:`DiffuSceneConfig`, and :class:`MixedBaselineConfig`."""


class _Residual(nn.Module):
    """Two convolutions of width 3 with the time embedding between them (Ho et al. 2020)."""

    def __init__(self, config: _Size, channels: int) -> None:
        super().__init__()
        hidden, inner = config.hidden, config.inner
        self.norm = nn.GroupNorm(config.heads, channels)
        self.convolution = nn.Conv1d(channels, inner, 3, padding=1)
        self.time = nn.Linear(hidden, inner)
        self.inner_norm = nn.GroupNorm(config.heads, inner)
        self.out = nn.Conv1d(inner, hidden, 3, padding=1)
        self.skip = nn.Conv1d(channels, hidden, 1) if channels != hidden else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Channels (B, C, N) and the time embedding (B, H) to (B, H, N)."""
        h = self.convolution(F.silu(self.norm(x))) + self.time(F.silu(condition))[..., None]
        return self.skip(x) + self.out(F.silu(self.inner_norm(h)))


class _Attend(nn.Module):
    """Attention among the slots of a level, then from them to the text when there is any."""

    def __init__(self, config: _Size) -> None:
        super().__init__()
        hidden, heads = config.hidden, config.heads
        self.norm = nn.GroupNorm(heads, hidden)
        self.attention = Attention(hidden, heads)
        self.text_norm = nn.GroupNorm(heads, hidden) if config.text_width else None
        self.text_attention = Attention(hidden, heads) if config.text_width else None

    def forward(self, x: Tensor, text: Tensor | None, mask: Tensor | None) -> Tensor:
        """Channels (B, H, N) to the same."""
        normal = self.norm(x).transpose(1, 2)
        x = x + self.attention(normal, normal).transpose(1, 2)
        if self.text_norm is not None and self.text_attention is not None and text is not None:
            x = x + self.text_attention(self.text_norm(x).transpose(1, 2), text, mask).transpose(1, 2)
        return x


class _Level(nn.Module):
    """The residual blocks and the attention of one resolution, on the way down or on the way up."""

    def __init__(self, config: _Size, channels: int) -> None:
        super().__init__()
        widths = [channels] + [config.hidden] * (config.blocks - 1)
        self.blocks = nn.ModuleList(_Residual(config, width) for width in widths)
        self.attend = _Attend(config)

    def forward(self, x: Tensor, condition: Tensor, text: Tensor | None, mask: Tensor | None) -> Tensor:
        for block in self.blocks:
            x = block(x, condition)
        return self.attend(x, text, mask)


class _UNet(nn.Module):
    """The trunk, for any number of slots: halving rounds up, and doubling cuts off surplus slots."""

    def __init__(self, config: _Size) -> None:
        super().__init__()
        hidden = config.hidden
        self.first = nn.Conv1d(hidden, hidden, 3, padding=1)
        self.down = nn.ModuleList(_Level(config, hidden) for _ in range(config.levels))
        self.to_coarse = nn.ModuleList(nn.Conv1d(hidden, hidden, 3, 2, 1) for _ in range(config.levels - 1))
        self.middle_in, self.middle_out = _Residual(config, hidden), _Residual(config, hidden)
        self.middle = _Attend(config)
        self.to_fine = nn.ModuleList(nn.Conv1d(hidden, hidden, 3, padding=1) for _ in range(config.levels - 1))
        self.up = nn.ModuleList(_Level(config, 2 * hidden) for _ in range(config.levels))

    def forward(self, tokens: Tensor, condition: Tensor, text: Tensor | None, mask: Tensor | None) -> Tensor:
        x = self.first(tokens.transpose(1, 2))
        skips: list[Tensor] = []
        for index, level in enumerate(self.down):
            x = self.to_coarse[index - 1](x) if index else x
            x = level(x, condition, text, mask)
            skips.append(x)
        x = self.middle_out(self.middle(self.middle_in(x, condition), text, mask), condition)
        for index, level in enumerate(self.up):
            skip = skips.pop()
            if index:
                x = self.to_fine[index - 1](x.repeat_interleave(2, dim=-1)[..., : skip.shape[-1]])
            x = level(torch.cat([x, skip], dim=1), condition, text, mask)
        return x.transpose(1, 2)


class DiffuScene(ContinuousBaseline):
    """Scenes (B, N, D) at a noise level (B,) to a prediction (B, N, D); depends on the order of slots.

    >>> network = DiffuScene(DiffuSceneConfig(features=20, hidden=16, heads=2))
    >>> x = torch.randn(2, 35, 20)
    >>> network(x, x, torch.tensor([0.1, 0.2])).shape
    torch.Size([2, 35, 20])
    """

    def __init__(self, config: DiffuSceneConfig) -> None:
        super().__init__(config, config.features, _UNet(config))


class MixedDiffuScene(MixedBaseline):
    """Poses (B, N, 12) and states (B, N) to a pose output (B, N, 12) and logits (B, N, K); depends on slot order.

    >>> network = MixedDiffuScene(MixedDiffuSceneConfig(categories=8, hidden=16, heads=2, text_width=16))
    >>> pose, states = torch.randn(2, 5, 12), torch.randint(9, (2, 5))
    >>> out, logits = network(pose, states, torch.tensor([3.0, 7.0]), text=torch.randn(2, 4, 16))
    >>> out.shape, logits.shape
    (torch.Size([2, 5, 12]), torch.Size([2, 5, 8]))
    """

    def __init__(self, config: MixedDiffuSceneConfig) -> None:
        super().__init__(config, _UNet(config))
