"""Attention biases from the distances between slots: what is near, and what is above what."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

_SCALES, _SIGNED = 8, 4


class DistanceBias(nn.Module):
    """Adds to the attention logits of every block a learned function of where two slots stand to each other.

    Horizontal distance and difference in height are seen at eight scales, from a centimetre up, each blurred by the
    noise that is on the two positions: E exp(-d^2 / 2 l^2) under Gaussian noise is a wider Gaussian. Permutation-
    equivariant, and independent of the horizontal heading of the scene when both horizontal axes have one unit.

    Args:
        blocks: attention blocks.
        heads: heads per block.
        unit: metres per normalised unit along x, y, z.
        width: hidden width.

    >>> bias = DistanceBias(blocks=2, heads=4, unit=(0.5, 0.5, 0.5))
    >>> bias(torch.zeros(3, 5, 3), torch.ones(3, 5)).shape
    torch.Size([2, 3, 4, 5, 5])
    """

    def __init__(self, blocks: int, heads: int, unit: tuple[float, float, float], width: int = 32) -> None:
        super().__init__()
        self.blocks, self.heads = blocks, heads
        largest = max(*unit, 0.1)
        self.unit: Tensor
        self.scales: Tensor
        self.register_buffer("unit", torch.tensor(unit), persistent=False)
        self.register_buffer(
            "scales", torch.logspace(-2, float(torch.tensor(largest).log10()), _SCALES), persistent=False
        )
        self.hidden = nn.Linear(2 * _SCALES + _SIGNED, width)
        self.out = nn.Linear(width, blocks * heads)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, position: Tensor, noise_level: Tensor) -> Tensor:
        """Biases (blocks, B, heads, N, N) of positions (B, N, 3) with noise (B, N), both in normalised units."""
        metres = position * self.unit.to(position)
        noise = (noise_level * self.unit.max()).square()  # (B, N) m^2
        blur = (noise.unsqueeze(2) + noise.unsqueeze(1)).unsqueeze(-1)  # (B, N, N, 1)
        offset = metres.unsqueeze(2) - metres.unsqueeze(1)
        spread = blur + self.scales.to(position).square()  # (B, N, N, S)
        horizontal = torch.exp(-0.5 * offset[..., :2].square().sum(dim=-1, keepdim=True) / spread)
        height = offset[..., 2:]
        vertical = torch.exp(-0.5 * height.square() / spread)
        coarse = spread[..., :: _SCALES // _SIGNED]
        signed = height / (height.square() + coarse).sqrt()
        features = F.silu(self.hidden(torch.cat([horizontal, vertical, signed], dim=-1)))
        bias: Tensor = self.out(features)  # (B, N, N, blocks * heads)
        return bias.unflatten(-1, (self.blocks, self.heads)).permute(3, 0, 4, 1, 2)
