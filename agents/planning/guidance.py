"""Guidance of the denoising by the gradient of a differentiable weight of scenes, and the named weights."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch
from scene_envs.scene_facts import hull_corners

Weight = Callable[[SceneBatch, Tensor], Tensor]
"""``(batch, translations) -> (B,)``: log-weight of the scenes of ``batch`` with these translations (B, N, 3), m.

Differentiable in ``translations``.
"""


def overlap(batch: SceneBatch, translations: Tensor) -> Tensor:
    """(B,) minus half the sum of squared overlaps of objects, mm²: 0 where no two overlap.

    Each object is the upright cylinder around its asset. The overlap of a pair is the smaller of the overlap of their
    circles and that of their heights. Pairs of two welded objects are left out.
    """
    radius, low, high = (column[batch.categories.clamp(max=batch.scene_type.num_assets)] for column in _sizes(batch))
    flat = translations[..., :2]
    away = (flat[:, :, None] - flat[:, None]).square().sum(-1).clamp(min=1e-12).sqrt()
    across = radius[:, :, None] + radius[:, None] - away
    bottom, top = translations[..., 2] + low, translations[..., 2] + high
    along = torch.minimum(top[:, :, None], top[:, None]) - torch.maximum(bottom[:, :, None], bottom[:, None])
    pairs = (
        ~batch.is_empty[:, :, None] & ~batch.is_empty[:, None] & (batch.is_free[:, :, None] | batch.is_free[:, None])
    )
    pairs = pairs.triu(diagonal=1) & ~_contained(across, radius)
    depth = torch.minimum(across, along).clamp(min=0.0)
    return -0.5 * (1e3 * torch.where(pairs, depth, torch.zeros_like(depth))).square().sum(dim=(1, 2))


def _contained(across: Tensor, radius: Tensor) -> Tensor:
    """(B, N, N) bool: pairs in which one circle contains the centre of the other: objects on tables, food in bowls."""
    return across.detach() > torch.minimum(radius[:, :, None], radius[:, None])


def _sizes(batch: SceneBatch) -> tuple[Tensor, Tensor, Tensor]:
    """Radius, lowest and highest point of every asset, (C + 1,) m each; 0 for the empty slot."""
    rows = [
        (corners[:, :2].norm(dim=-1).amax(), corners[:, 2].amin(), corners[:, 2].amax())
        for corners in hull_corners(batch.scene_type.library)
    ]
    columns = torch.tensor([*[[float(x) for x in row] for row in rows], [0.0, 0.0, 0.0]], device=batch.tensor.device)
    return columns[:, 0], columns[:, 1], columns[:, 2]


class Guidance:
    """Gradient of a log-weight at the scenes that the network expects.

    Args:
        weight: the log-weight.
        strength: factor on the log-weight.
        begin: share of the denoising steps that come before guidance.
    """

    role = "guide"

    def __init__(self, weight: Weight, strength: float, begin: float) -> None:
        self.weight, self.strength, self.begin = weight, strength, begin

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch], std: Tensor) -> Tensor | None:
        """(B, N, 3) m, shift of the denoised translations; None at a step without guidance.

        Given x_t, x_0 is approximately normal around the denoised scene, with standard deviation ``std`` (3,), m. The
        weight moves its mean by the variance times the gradient of the log-weight. This is exact if the gradient is
        constant. No object moves by more than one standard deviation.
        """
        if step < int(self.begin * steps) or not self.strength:
            return None
        batch = denoised()
        with torch.enable_grad():
            translations = batch.translations.detach().clone().requires_grad_()
            total = self.weight(batch, translations).sum()
            (gradient,) = torch.autograd.grad(total, translations)
        deviations = std * (self.strength * torch.nan_to_num(gradient)).to(std)
        return std * deviations / deviations.norm(dim=-1, keepdim=True).clamp(min=1.0)
