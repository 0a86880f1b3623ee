"""Baseline networks: MiDiffusion and DiffuScene, with inputs for slots, time and text and outputs for slots in common.

The *trunk* between inputs and outputs maps tokens (B, N, H), a time embedding (B, H) and text (B, L, H) with its
padding (B, L), both None without text, to tokens (B, N, H).

MiDiffusion (Hu et al. 2024, "Mixed Diffusion for 3D Indoor Scene Synthesis", section on the denoising network) is a
transformer over the objects of a scene, without positional encoding, whose layer norms are functions of time. The
paper's condition is a floor plan; here it is text, as in the comparison of Pfaff et al. (CoRL 2025).

DiffuScene (Tang et al. 2024, "DiffuScene: Denoising Diffusion Models for Generative Indoor Scene Synthesis", section on
the denoising network) is a U-Net of 1-D convolutions along the slots of a scene (Ho et al. 2020), with attention among
slots and, with text, from slots to words at each level. Convolutions mix neighbouring slots, so the network depends on
the order of slots, although scenes have no order.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux import timestep_embedding
from agents.networks.flux_modules import start_at_zero
from agents.networks.registry import register_network
from scene_envs.errors import InvalidInputError
from scene_envs.scene import POSE_FEATURES

_TIME_WIDTH = 256


@dataclass(frozen=True, kw_only=True)
class BaselineConfig(ABC):
    """Common part of the sizes of all baselines.

    Attributes:
        hidden: width of the tokens; a multiple of ``heads``.
        heads: attention heads.
        text_width: width of the text tokens; 0 for none, as in continuous networks.
    """

    hidden: int = 128
    heads: int = 4
    text_width: int = 0

    def __post_init__(self) -> None:
        for name in ("hidden", "heads", "depth", "levels", "blocks"):
            if getattr(self, name, 1) < 1:
                raise InvalidInputError(f"{name}={getattr(self, name)} is not positive")
        if self.hidden % self.heads:
            raise InvalidInputError(f"hidden={self.hidden} is not a multiple of heads={self.heads}")

    @abstractmethod
    def trunk(self) -> nn.Module:
        """The trunk with fresh weights."""


@dataclass(frozen=True, kw_only=True)
class MixedBaselineConfig(BaselineConfig):
    """Common part of the sizes of all baselines of mixed scenes.

    Attributes:
        categories: K = C + 1, assets and *empty*; the mask token is one more.
    """

    categories: int


def attended(layer: nn.MultiheadAttention, tokens: Tensor, source: Tensor, padding: Tensor | None = None) -> Tensor:
    """Tokens (B, N, H) after attention to ``source`` (B, M, H); ``padding`` (B, M) is True where nothing attends."""
    result: Tensor = layer(tokens, source, source, key_padding_mask=padding, need_weights=False)[0]
    return result


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Two linear layers with a GELU between them."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, outputs))


def head(hidden: int, outputs: int) -> nn.Sequential:
    """Layer norm and two layers, of which the last starts at zero."""
    last = nn.Linear(hidden, outputs)
    start_at_zero(last)
    return nn.Sequential(nn.LayerNorm(hidden), nn.Linear(hidden, hidden), nn.GELU(), last)


class _Baseline(nn.Module):
    """A trunk with inputs for time and text."""

    def __init__(self, config: BaselineConfig) -> None:
        super().__init__()
        self.trunk = config.trunk()
        self.config = config
        hidden = config.hidden
        self.time_in = mlp(_TIME_WIDTH, hidden, hidden)
        self.text_in = nn.Linear(config.text_width, hidden) if config.text_width else None

    def _tokens(self, tokens: Tensor, time: Tensor, text: Tensor | None, text_mask: Tensor | None) -> Tensor:
        """Tokens (B, N, H) through the trunk; ``time`` (B,)."""
        condition = self.time_in(timestep_embedding(time, _TIME_WIDTH).to(tokens.dtype))
        if self.text_in is None:
            return self.trunk(tokens, condition, None, None)
        padding = None
        if text is None:
            text = tokens.new_zeros(len(tokens), 1, self.text_in.in_features)
        elif text_mask is not None:
            text = text * text_mask[..., None]
            somewhere = text_mask.any(dim=-1, keepdim=True)
            padding = ~text_mask & somewhere  # a row of padding alone is read as no text
        return self.trunk(tokens, condition, self.text_in(text), padding)


class ContinuousBaseline(_Baseline):
    """Scenes (B, N, D) at a noise level (B,) to a prediction (B, N, D), which starts at zero.

    >>> network = ContinuousBaseline(DiffuSceneConfig(features=20, hidden=16, heads=2))
    >>> x = torch.randn(2, 35, 20)
    >>> network(x, x, torch.tensor([0.1, 0.2])).shape
    torch.Size([2, 35, 20])
    """

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.scene_in = mlp(config.features, config.hidden, config.hidden)
        self.scene_out = head(config.hidden, config.features)

    def forward(self, x: Tensor, position: Tensor, noise_level: Tensor) -> Tensor:
        """Predict from (B, N, D) network input of unit variance and the noise-to-signal ratio (B,), whose logarithm is
        embedded as time; ``position``, the scene in signal units, is not read.
        """
        return self.scene_out(self._tokens(self.scene_in(x), 250.0 * noise_level.log(), None, None))


class MixedBaseline(_Baseline):
    """Poses (B, N, 12) and category states (B, N) to a pose output (B, N, 12) and logits (B, N, K), zero at first.

    >>> network = MixedBaseline(MixedMiDiffusionConfig(categories=8, hidden=32, depth=2, heads=2, text_width=16))
    >>> pose, states = torch.randn(2, 5, 12), torch.randint(9, (2, 5))
    >>> out, logits = network(pose, states, torch.tensor([3.0, 7.0]), text=torch.randn(2, 4, 16))
    >>> out.shape, logits.shape
    (torch.Size([2, 5, 12]), torch.Size([2, 5, 8]))
    """

    def __init__(self, config: MixedBaselineConfig) -> None:
        super().__init__(config)
        hidden = config.hidden
        self.pose_in = mlp(POSE_FEATURES, hidden, hidden)
        self.category_in = nn.Embedding(config.categories + 1, hidden)
        self.given_in = nn.Embedding(4, hidden)
        nn.init.zeros_(self.given_in.weight)
        self.pose_out = head(hidden, POSE_FEATURES)
        self.logits_out = head(hidden, config.categories)

    def forward(
        self, pose: Tensor, states: Tensor, time: Tensor, *, text: Tensor | None = None,
        text_mask: Tensor | None = None, position: Tensor | None = None, noise_level: Tensor | None = None,
        observed: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Predict; arguments and results as in :meth:`agents.networks.flux.MixedFlux.forward`."""
        tokens = self.pose_in(pose) + self.category_in(states)
        if observed is not None:
            tokens = tokens + self.given_in(observed)
        tokens = self._tokens(tokens, time, text, text_mask)
        return self.pose_out(tokens), self.logits_out(tokens)


@dataclass(frozen=True, kw_only=True)
class _MiDiffusionSize(BaselineConfig):
    depth: int = 6

    def trunk(self) -> nn.Module:
        return _Transformer(self)


@dataclass(frozen=True, kw_only=True)
class MiDiffusionConfig(_MiDiffusionSize):
    """Size of MiDiffusion for continuous scenes, permutation-equivariant in the slots.

    Further fields are those of :class:`BaselineConfig`.

    Attributes:
        features: D, numbers per slot.
        depth: number of blocks.
    """

    features: int


@dataclass(frozen=True, kw_only=True)
class MixedMiDiffusionConfig(_MiDiffusionSize, MixedBaselineConfig):
    """Size of MiDiffusion for mixed scenes: that of :class:`MiDiffusionConfig`, and :class:`MixedBaselineConfig`."""


class _AdaptiveNorm(nn.Module):
    """Layer norm whose scale and shift are linear in the time embedding (adaptive layer norm)."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.hidden = hidden
        self.modulation = nn.Linear(hidden, 2 * hidden)
        start_at_zero(self.modulation)

    def forward(self, tokens: Tensor, condition: Tensor) -> Tensor:
        shift, scale = self.modulation(F.silu(condition)).unsqueeze(1).chunk(2, dim=-1)
        return (1 + scale) * F.layer_norm(tokens, (self.hidden,)) + shift


class _Block(nn.Module):
    """Self-attention, cross-attention to the text when there is any, and a feed-forward layer."""

    def __init__(self, config: _MiDiffusionSize) -> None:
        super().__init__()
        hidden, heads = config.hidden, config.heads
        self.norm, self.feed_norm = _AdaptiveNorm(hidden), _AdaptiveNorm(hidden)
        self.attention = nn.MultiheadAttention(hidden, heads, batch_first=True)
        self.text_norm = _AdaptiveNorm(hidden) if config.text_width else None
        self.text_attention = nn.MultiheadAttention(hidden, heads, batch_first=True) if config.text_width else None
        self.feed = mlp(hidden, 4 * hidden, hidden)

    def forward(self, tokens: Tensor, condition: Tensor, text: Tensor | None, padding: Tensor | None) -> Tensor:
        normal = self.norm(tokens, condition)
        tokens = tokens + attended(self.attention, normal, normal)
        if self.text_norm is not None and self.text_attention is not None and text is not None:
            tokens = tokens + attended(self.text_attention, self.text_norm(tokens, condition), text, padding)
        return tokens + self.feed(self.feed_norm(tokens, condition))


class _Transformer(nn.Module):
    """The trunk."""

    def __init__(self, config: _MiDiffusionSize) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(_Block(config) for _ in range(config.depth))

    def forward(self, tokens: Tensor, condition: Tensor, text: Tensor | None, padding: Tensor | None) -> Tensor:
        for block in self.blocks:
            tokens = block(tokens, condition, text, padding)
        return tokens


@dataclass(frozen=True, kw_only=True)
class _DiffuSceneSize(BaselineConfig):
    hidden: int = 64
    levels: int = 4
    blocks: int = 2

    def trunk(self) -> nn.Module:
        return _UNet(self)


@dataclass(frozen=True, kw_only=True)
class DiffuSceneConfig(_DiffuSceneSize):
    """Size of DiffuScene for continuous scenes, which depends on the order of slots.

    Attributes:
        features: D, numbers per slot.
        hidden: channels at every level; a multiple of ``heads``.
        levels: resolutions along the slots, each half of the one before.
        blocks: residual blocks per level, on the way down and again on the way up.
        heads: attention heads, and groups of the group norms.
    """

    features: int


@dataclass(frozen=True, kw_only=True)
class MixedDiffuSceneConfig(_DiffuSceneSize, MixedBaselineConfig):
    """Size of DiffuScene for mixed scenes: that of :class:`DiffuSceneConfig`, and :class:`MixedBaselineConfig`."""


class _Residual(nn.Module):
    """Two convolutions of width 3 with the time embedding between them (Ho et al. 2020)."""

    def __init__(self, config: _DiffuSceneSize, channels: int) -> None:
        super().__init__()
        hidden = config.hidden
        self.norm = nn.GroupNorm(config.heads, channels)
        self.convolution = nn.Conv1d(channels, hidden, 3, padding=1)
        self.time = nn.Linear(hidden, hidden)
        self.inner_norm = nn.GroupNorm(config.heads, hidden)
        self.out = nn.Conv1d(hidden, hidden, 3, padding=1)
        self.skip = nn.Conv1d(channels, hidden, 1) if channels != hidden else nn.Identity()

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Channels (B, C, N) and the time embedding (B, H) to (B, H, N)."""
        h = self.convolution(F.silu(self.norm(x))) + self.time(F.silu(condition))[..., None]
        return self.skip(x) + self.out(F.silu(self.inner_norm(h)))


class _Attend(nn.Module):
    """Attention among the slots of a level, then from them to the text when there is any."""

    def __init__(self, config: _DiffuSceneSize) -> None:
        super().__init__()
        hidden, heads = config.hidden, config.heads
        self.norm = nn.GroupNorm(heads, hidden)
        self.attention = nn.MultiheadAttention(hidden, heads, batch_first=True)
        self.text_norm = nn.GroupNorm(heads, hidden) if config.text_width else None
        self.text_attention = nn.MultiheadAttention(hidden, heads, batch_first=True) if config.text_width else None

    def forward(self, x: Tensor, text: Tensor | None, padding: Tensor | None) -> Tensor:
        """Channels (B, H, N) to the same."""
        normal = self.norm(x).transpose(1, 2)
        x = x + attended(self.attention, normal, normal).transpose(1, 2)
        if self.text_norm is not None and self.text_attention is not None and text is not None:
            normal = self.text_norm(x).transpose(1, 2)
            x = x + attended(self.text_attention, normal, text, padding).transpose(1, 2)
        return x


class _Level(nn.Module):
    """The residual blocks and the attention of one resolution, on the way down or on the way up."""

    def __init__(self, config: _DiffuSceneSize, channels: int) -> None:
        super().__init__()
        widths = [channels] + [config.hidden] * (config.blocks - 1)
        self.blocks = nn.ModuleList(_Residual(config, width) for width in widths)
        self.attend = _Attend(config)

    def forward(self, x: Tensor, condition: Tensor, text: Tensor | None, padding: Tensor | None) -> Tensor:
        for block in self.blocks:
            x = block(x, condition)
        return self.attend(x, text, padding)


class _UNet(nn.Module):
    """The trunk, for any number of slots: halving rounds up, and doubling cuts off surplus slots."""

    def __init__(self, config: _DiffuSceneSize) -> None:
        super().__init__()
        hidden = config.hidden
        self.first = nn.Conv1d(hidden, hidden, 3, padding=1)
        self.down = nn.ModuleList(_Level(config, hidden) for _ in range(config.levels))
        self.to_coarse = nn.ModuleList(nn.Conv1d(hidden, hidden, 3, 2, 1) for _ in range(config.levels - 1))
        self.middle_in, self.middle_out = _Residual(config, hidden), _Residual(config, hidden)
        self.middle = _Attend(config)
        self.to_fine = nn.ModuleList(nn.Conv1d(hidden, hidden, 3, padding=1) for _ in range(config.levels - 1))
        self.up = nn.ModuleList(_Level(config, 2 * hidden) for _ in range(config.levels))

    def forward(self, tokens: Tensor, condition: Tensor, text: Tensor | None, padding: Tensor | None) -> Tensor:
        x = self.first(tokens.transpose(1, 2))
        skips: list[Tensor] = []
        for index, level in enumerate(self.down):
            x = self.to_coarse[index - 1](x) if index else x
            x = level(x, condition, text, padding)
            skips.append(x)
        x = self.middle_out(self.middle(self.middle_in(x, condition), text, padding), condition)
        for index, level in enumerate(self.up):
            skip = skips.pop()
            if index:
                x = self.to_fine[index - 1](x.repeat_interleave(2, dim=-1)[..., : skip.shape[-1]])
            x = level(torch.cat([x, skip], dim=1), condition, text, padding)
        return x.transpose(1, 2)


def _diffuscene(keys: Mapping[str, Any]) -> dict[str, Any]:
    return {**{name: keys[name] for name in ("hidden", "heads", "text_width")}, "blocks": max(1, keys["depth"] // 3)}


register_network("midiffusion", "continuous", MiDiffusionConfig, ContinuousBaseline)
register_network("midiffusion", "mixed", MixedMiDiffusionConfig, MixedBaseline)
register_network("diffuscene", "continuous", DiffuSceneConfig, ContinuousBaseline, sizes=_diffuscene)
register_network("diffuscene", "mixed", MixedDiffuSceneConfig, MixedBaseline, sizes=_diffuscene)
