"""Relations between slots: features of pairs from relative positions, and attention biases from these features.

A transformer that reads positions slot by slot has to learn distances by itself. Here distances are features of pairs
of slots. They bias the attention logits. Attention also sums them with the weights with which it sums the values, so
that a head learns the offsets of its neighbours (as with the edges of graph transformers, Dwivedi and Bresson 2021, and
in the structure module of AlphaFold, Jumper et al. 2021).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene
from scene_envs.errors import unknown_name

_SCALES = 8
FEATURES = 5 * _SCALES
"""Numbers per pair of slots."""
BLURS = ("axis", "largest")
"""The noise that blurs the features of an axis: that of the axis itself, or the largest of all axes."""


@dataclass(frozen=True)
class RelationsConfig(ModuleConfig):
    """Attention between slots that sees where the others stand.

    Attributes:
        blur: the noise that blurs features of an axis, one of :data:`BLURS`; see :class:`Relations`.
    """

    blur: str = "axis"

    name = "relations"
    place = "attention"
    reads_geometry = True

    def __post_init__(self) -> None:
        if self.blur not in BLURS:
            raise unknown_name("blur", self.blur, BLURS)

    @property
    def pair_width(self) -> int:
        return FEATURES

    def build(self, core: FluxSizes) -> Relations:
        return Relations(core.blocks, core.heads, core.unit, blur=self.blur)


def pair_features(metres: Tensor, noise: Tensor, scales: Tensor) -> Tensor:
    """Features of every pair of slots, (B, N, N, :data:`FEATURES`); entry (i, j) is of the offset from slot j to i.

    They are Gaussians of the horizontal distance and of the difference in height at every scale, then the offsets along
    z, x and y, which saturate beyond each scale. All are blurred by the noise on the two positions: E exp(-d^2 / 2 l^2)
    under Gaussian noise is a wider Gaussian.

    Args:
        metres: (B, N, 3) positions.
        noise: (B, N, 3) standard deviation of the noise on them along x, y, z, metres; (B, N, 1) if equal for all axes.
        scales: (8,) lengths, metres.
    """
    variance, wide = noise.square(), scales.square()
    x, y, z = (metres.unsqueeze(2) - metres.unsqueeze(1)).unsqueeze(-1).unbind(dim=-2)  # (B, N, N, 1)
    blurs = (variance.unsqueeze(2) + variance.unsqueeze(1)).unsqueeze(-1).unbind(dim=-2)
    along_x, along_y, along_z = [blur + wide for blur in blurs] if len(blurs) == 3 else [blurs[0] + wide] * 3  # ..., 8
    xx, yy, zz = x.square(), y.square(), z.square()
    reach_x = (xx + yy + along_x).sqrt()
    reach_y = reach_x if along_y is along_x else (xx + yy + along_y).sqrt()
    parts = [torch.exp(-0.5 * (xx / along_x + yy / along_y)), torch.exp(-0.5 * zz / along_z)]
    return torch.cat([*parts, z / (zz + along_z).sqrt(), x / reach_x, y / reach_y], dim=-1)


class Relations(FluxModule):
    """Features of pairs of slots, and the biases that every attention block makes of them.

    Permutation-equivariant. Positions are read in normalised units; features are computed in metres.

    Args:
        blocks: attention blocks.
        heads: heads per block.
        unit: metres per normalised unit along x, y, z; 0 along an axis that never varies.
        width: hidden width.
        blur: the noise that blurs features of an axis: ``"axis"`` for the noise of the axis itself, ``"largest"`` for
            the largest noise of all axes, which is too large for heights in rooms.

    >>> relations = Relations(blocks=2, heads=4, unit=(0.5, 0.5, 0.5))
    >>> bias, features = relations(torch.zeros(3, 5, 3), torch.ones(3, 5))
    >>> bias.shape, features.shape
    (torch.Size([2, 3, 4, 5, 5]), torch.Size([3, 5, 5, 40]))
    """

    def __init__(
        self, blocks: int, heads: int, unit: tuple[float, float, float], width: int = 32, blur: str = "axis"
    ) -> None:
        super().__init__()
        if blur not in BLURS:
            raise unknown_name("blur", blur, BLURS)
        self.blocks, self.heads, self.blur = blocks, heads, blur
        largest = torch.tensor(max(*unit, 0.1))
        self.unit: Tensor
        self.scales: Tensor
        self.register_buffer("unit", torch.tensor(unit), persistent=False)
        self.register_buffer("scales", torch.logspace(-2, float(largest.log10()), _SCALES), persistent=False)
        self.hidden = nn.Linear(3 * _SCALES, width)
        self.out = nn.Linear(width, blocks * heads)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def relations(self, scene: Scene) -> tuple[Tensor, Tensor] | None:
        if scene.position is None or scene.noise_level is None:
            return None
        biases, features = self(scene.position[..., :3], scene.noise_level)
        return biases, features

    def forward(self, position: Tensor, noise_level: Tensor) -> tuple[Tensor, Tensor]:
        """Biases (blocks, B, heads, N, N) and features (B, N, N, :data:`FEATURES`).

        Args:
            position: (B, N, 3), normalised.
            noise_level: (B, N) noise on the positions, in the same units.
        """
        unit = self.unit.to(position)
        blurred = unit if self.blur == "axis" else unit.max().reshape(1)
        features = pair_features(position * unit, noise_level.unsqueeze(-1) * blurred, self.scales.to(position))
        bias: Tensor = self.out(F.silu(self.hidden(features[..., : 3 * _SCALES])))
        return bias.unflatten(-1, (self.blocks, self.heads)).permute(3, 0, 4, 1, 2).contiguous(), features


def joint_attention(
    query: Tensor,
    key: Tensor,
    value: Tensor,
    mask: Tensor | None = None,
    relations: Tensor | None = None,
    gathered: nn.Linear | None = None,
) -> Tensor:
    """Attention over T tokens, (B, T, H), plus a linear map of ``relations``, summed with the attention weights.

    Args:
        query, key, value: (B, heads, T, H / heads).
        mask: as in :func:`torch.nn.functional.scaled_dot_product_attention`; with ``relations`` a float mask.
        relations: (B, N, N, F) features of pairs of the last N tokens, the slots; None for none.
        gathered: linear map from heads * F to H.
    """
    if relations is None or gathered is None or mask is None:
        return F.scaled_dot_product_attention(query, key, value, attn_mask=mask).transpose(1, 2).flatten(-2)
    weights = (query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5 + mask).softmax(dim=-1)
    slots = relations.shape[1]
    among = weights[:, :, -slots:, -slots:].transpose(1, 2)  # (B, N, heads, N)
    message = gathered((among @ relations).flatten(-2))
    attended = (weights @ value).transpose(1, 2).flatten(-2)
    return attended + F.pad(message, (0, 0, attended.shape[1] - slots, 0))
