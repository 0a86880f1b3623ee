"""Unmasking of absorbing chains: the number of slots that a step unmasks, and the draws of their categories.

Slots that are unmasked in the same step are drawn independently, so scenes can get too many objects of a kind. Two
remedies leave the distribution of each slot unchanged. The number of slots that a step unmasks differs from its
expectation by less than one (:func:`draw_unmasked`). The kinds of objects whose number a prompt gives are drawn by
systematic sampling (:func:`systematic`), so the number of each also differs little from its expectation.
"""

from __future__ import annotations

import torch
from torch import Tensor

UNMASKINGS = ("systematic", "even", "independent")
"""Ways to choose the masked slots that a step unmasks."""
_TINY = 1e-30


def draw_unmasked(masked: Tensor, chance: Tensor, uniform: Tensor) -> Tensor:
    """(B, N) bool: of the ``masked`` slots of each scene, those that are unmasked now, drawn without replacement.

    Of M masked slots with chance p, M p rounded down or up are unmasked, up with the probability that makes M p the
    mean. The ranks of independent numbers do not depend on their minimum. So one number per slot is enough: the
    ranks choose the slots, and the minimum decides the rounding.

    Args:
        masked: (B, N) bool, the masked slots.
        chance: (B, N) probability that a masked slot is unmasked, equal for all slots of a scene.
        uniform: (B, N) independent numbers, uniform on [0, 1).

    >>> masked = torch.tensor([[True, True, False, True, True]])
    >>> draw_unmasked(masked, torch.full((1, 5), 0.5), torch.tensor([[0.4, 0.9, 0.0, 0.2, 0.6]])).tolist()
    [[True, False, False, True, False]]
    """
    total, expected = _expected(masked, chance)
    order = torch.where(masked, uniform.double(), torch.full_like(uniform, torch.inf, dtype=torch.float64))
    least = order.amin(dim=-1).clamp(max=1.0)
    rounding = (1 - (1 - least) ** total).clamp(max=1 - 1e-12)
    number = (expected + rounding).floor()
    return masked & (order.argsort(dim=-1).argsort(dim=-1) < number.unsqueeze(-1))


def systematic(unmasked: Tensor, uniform: Tensor) -> Tensor:
    """(B, N) numbers on [0, 1) that are evenly spread over the ``unmasked`` slots of a scene, in random order.

    Systematic sampling (Madow and Madow 1944): with k slots the numbers are (r + v) / k with the ranks r of ``uniform``
    among these slots and one v for all, the fractional part of their sum. Ranks and v are independent, so each number
    is uniform. Slots of equal probabilities p take a category p k times, rounded down or up.

    Args:
        unmasked: (B, N) bool, the slots that a step unmasks.
        uniform: (B, N) float64, independent and uniform on [0, 1); slots that are not unmasked keep theirs.

    >>> unmasked = torch.tensor([[True, True, False, True, True]])
    >>> systematic(unmasked, torch.tensor([[0.75, 0.25, 0.5, 0.5, 0.125]])).tolist()
    [[0.90625, 0.40625, 0.5, 0.65625, 0.15625]]
    """
    number = unmasked.sum(dim=-1, keepdim=True).clamp(min=1)
    ranks = torch.where(unmasked, uniform, torch.full_like(uniform, torch.inf)).argsort(dim=-1).argsort(dim=-1)
    shared = torch.where(unmasked, uniform, torch.zeros_like(uniform)).sum(dim=-1, keepdim=True).frac()
    return torch.where(unmasked, (ranks + shared) / number, uniform)


def unmasking_log_prob(masked: Tensor, chance: Tensor, unmasked: Tensor) -> Tensor:
    """(B, N) nats, whose sum over a scene's slots is the log-probability that exactly ``unmasked`` are unmasked.

    It depends on no parameter of a network; the masked slots of a scene have equal shares of it.

    Args:
        masked, chance: the arguments of :func:`draw_unmasked`.
        unmasked: (B, N) bool, a subset of the masked slots.

    >>> masked, chance = torch.ones(1, 4, dtype=torch.bool), torch.full((1, 4), 0.5)
    >>> two = torch.tensor([[True, False, True, False]])
    >>> round(float(unmasking_log_prob(masked, chance, two).sum().exp()), 4)  # one of six pairs
    0.1667
    """
    total, expected = _expected(masked, chance)
    number = (unmasked & masked).sum(dim=-1).double()
    probability = (1 - (number - expected).abs()).clamp(min=_TINY)  # of rounding to this number
    subsets = torch.lgamma(total + 1) - torch.lgamma(number + 1) - torch.lgamma(total - number + 1)
    share = (probability.log() - subsets) / total.clamp(min=1)
    return torch.where(masked, share.unsqueeze(-1), torch.zeros_like(share).unsqueeze(-1)).to(chance.dtype)


def _expected(masked: Tensor, chance: Tensor) -> tuple[Tensor, Tensor]:
    """(B,) numbers of masked slots, and (B,) expected numbers of slots to unmask, float64."""
    return masked.sum(dim=-1).double(), torch.where(masked, chance.double(), 0.0).sum(dim=-1)
