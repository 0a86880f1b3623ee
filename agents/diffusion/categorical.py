"""Discrete diffusion on categories (D3PM; Austin et al. 2021): absorbing and mask-and-replace kernels.

All kernels are of one family that is closed under composition, so that strides of any length have posteriors in
closed form and few-step chains have exact log-probabilities. From s to t a category

    is kept with probability k, is replaced by the mask token with probability m,
    and is replaced by a uniformly drawn category with probability 1 - k - m.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from scene_envs.arrays import constant_on
from scene_envs.errors import InvalidInputError, unknown_name

UNMASKINGS = ("systematic", "even", "independent")
"""Ways to choose the masked slots that a step unmasks."""

_TINY = 1e-30


@dataclass(frozen=True)
class CategoricalSchedule:
    """Cumulative rates of a kernel at t = 0..T.

    >>> schedule = make_categorical_schedule("early_absorbing", 10)
    >>> round(float(schedule.keep[6]), 3), round(float(schedule.mask[6]), 3)
    (0.8, 0.2)
    """

    name: str  # one of :data:`CATEGORICAL_KERNELS`
    keep: Tensor  # (T + 1,) float64, probability that a category has not been touched; 1 at t = 0
    mask: Tensor  # (T + 1,) float64, probability that it is the mask token; 0 at t = 0

    @property
    def num_timesteps(self) -> int:
        """T."""
        return self.keep.shape[0] - 1


def _mask_and_replace(num_timesteps: int) -> tuple[Tensor, Tensor]:
    """The paper's: keep falls from 0.99999 to 9e-6 and mask rises from 9e-6 to 0.99999, linearly over 1..T."""
    keep = torch.linspace(0.99999, 0.000009, num_timesteps, dtype=torch.float64)
    mask = torch.linspace(0.000009, 0.99999, num_timesteps, dtype=torch.float64)
    one = torch.ones(1, dtype=torch.float64)
    return torch.cat([one, keep]), torch.cat([0.0 * one, mask])


def _absorbing(num_timesteps: int, power: int) -> tuple[Tensor, Tensor]:
    """With power 1, masks an equal share of original categories per timestep (Austin et al. 2021, app. A.2.2), but from
    T/2 on: a reverse chain draws all categories in its first half. Power 2 unmasks the last categories one at a time,
    as the cosine of MaskGIT does (Chang et al. 2022): categories of the same step are drawn independently, which makes
    counts inexact.
    """
    u = torch.linspace(0, 1, num_timesteps + 1, dtype=torch.float64)
    mask = torch.maximum(1e-5 * u, ((u - 0.5) / 0.5).clamp(min=0.0) ** power)
    return 1.0 - mask, mask


CATEGORICAL_KERNELS: dict[str, Callable[[int], tuple[Tensor, Tensor]]] = {
    "early_absorbing": partial(_absorbing, power=1),
    "squared_absorbing": partial(_absorbing, power=2),
    "mask_and_replace": _mask_and_replace,
}


def make_categorical_schedule(name: str, num_timesteps: int = 1000) -> CategoricalSchedule:
    """The schedule of the kernel called ``name`` with T = ``num_timesteps``."""
    if name not in CATEGORICAL_KERNELS:
        raise unknown_name("categorical kernel", name, CATEGORICAL_KERNELS)
    if num_timesteps < 2:
        raise InvalidInputError(f"a categorical schedule needs at least 2 timesteps, got {num_timesteps}")
    return CategoricalSchedule(name, *CATEGORICAL_KERNELS[name](num_timesteps))


class CategoricalProcess:
    """Discrete diffusion over K categories and a mask token, whose index is K.

    States are int64 indices in 0..K; data are in 0..K-1. Distributions over states have K + 1 entries.

    Args:
        schedule: cumulative rates.
        categories: number K of categories.

    >>> process = CategoricalProcess(make_categorical_schedule("early_absorbing", 4), 3)
    >>> process.marginal(torch.tensor([1]), torch.tensor([3]))
    tensor([[0.0000, 0.5000, 0.0000, 0.5000]])
    """

    def __init__(self, schedule: CategoricalSchedule, categories: int) -> None:
        self.schedule = schedule
        self.categories = categories
        self._tables: dict[Any, tuple[Tensor, ...]] = {}

    @cached_property
    def only_absorbs(self) -> bool:
        """Whether a category is either unchanged or masked, so that a visible category is the clean one."""
        return not bool(_replaced(self.schedule.keep, self.schedule.mask).any())

    def rates(
        self, start: Tensor | int, end: Tensor | int, device: torch.device | None = None
    ) -> tuple[Tensor, Tensor]:
        """keep and mask probability of the stride ``start`` -> ``end`` (start < end), float64."""
        keep, mask = (constant_on(rate, device or rate.device) for rate in (self.schedule.keep, self.schedule.mask))
        kept = keep[end] / keep[start].clamp(min=_TINY)
        masked = 1.0 - (1.0 - mask[end]) / (1.0 - mask[start]).clamp(min=_TINY)
        masked = masked.clamp(0.0, 1.0)
        return torch.minimum(kept, 1.0 - masked), masked

    def transition(self, start: int, end: int) -> Tensor:
        """(K + 1, K + 1) float64, row i the distribution of the state at ``end`` given state i at ``start``."""
        keep, mask = self.rates(start, end)
        k = self.categories
        matrix = torch.zeros(k + 1, k + 1, dtype=torch.float64)
        matrix[:k, :k] = _replaced(keep, mask) / k
        matrix[:k, :k] += keep * torch.eye(k, dtype=torch.float64)
        matrix[:k, k] = mask
        matrix[k, k] = 1.0
        return matrix

    def marginal(self, x0: Tensor, t: Tensor) -> Tensor:
        """q(x_t | x_0) (..., K + 1) of data ``x0`` (...), int64, at timesteps ``t`` that broadcast against it."""
        keep, mask = torch.broadcast_tensors(*self._rates_at(t, x0))
        kept = keep * F.one_hot(x0, self.categories) + _replaced(keep, mask) / self.categories
        return torch.cat([kept, mask.expand(*x0.shape, 1)], dim=-1).float()

    def prior(self) -> Tensor:
        """(K + 1,) distribution of x_T: the marginal of uniformly drawn data."""
        mask = self.schedule.mask[-1]
        spread = torch.full((self.categories,), float(1.0 - mask) / self.categories)
        return torch.cat([spread, mask.float().reshape(1)])

    def posterior(self, x_t: Tensor, x0_probs: Tensor, t: Tensor | int, previous: Tensor | int) -> Tensor:
        """p(x_s | x_t) = sum over x_0 of q(x_s | x_t, x_0) p(x_0 | x_t) for a stride t -> s (Austin et al., Eq. 4).

        With w(x_0) = p(x_0) / q(x_t | x_0), the posterior is q(x_t | x_s) times the sum of q(x_s | x_0) weighted by w.
        The cost is linear in K. An x_0 that cannot lead to x_t has weight 0.

        Args:
            x_t: (B, ...) int64, states at t.
            x0_probs: (B, ..., K) the denoiser's distribution of the data.
            t: first timestep of each stride, int or (B,).
            previous: last timestep s of each stride; at 0 the result is ``x0_probs`` itself.

        Returns:
            (B, ..., K + 1) probabilities, rows sum to one; differentiable in ``x0_probs``.
        """
        likelihood, back, kept, spread, mask = self._stride(x_t, t, previous)
        weight = x0_probs.double() / likelihood
        weight = weight / weight.sum(dim=-1, keepdim=True).clamp(min=_TINY)
        states = back * (kept * weight + spread)
        joint = torch.cat([states, (x_t == self.categories).unsqueeze(-1) * mask], dim=-1)
        return (joint / joint.sum(dim=-1, keepdim=True).clamp(min=_TINY)).to(x0_probs.dtype)

    def _stride(self, x_t: Tensor, t: Tensor | int, previous: Tensor | int) -> tuple[Tensor, ...]:
        """q(x_t | x_0), inf where it is 0, q(x_t | x_s), (B, ..., K) each, and keep, spread and mask at s."""
        if isinstance(t, int) and x_t.ndim > 1:  # once for each state
            key = t, previous, x_t.device
            if key not in self._tables:
                with torch.inference_mode(False):  # training may read them, too
                    every = torch.arange(self.categories + 1, device=x_t.device)
                    self._tables[key] = self._stride(every, t, previous)
            likelihood, back, *rates = self._tables[key]
            return F.embedding(x_t, likelihood), F.embedding(x_t, back), *rates
        keep_s, mask_s = self._rates_at(previous, x_t)
        keep_t, mask_t = self._rates_at(t, x_t)
        keep_ts, mask_ts = (_broadcast(rate, x_t) for rate in self.rates(previous, t, x_t.device))
        k, masked = self.categories, (x_t == self.categories).unsqueeze(-1)
        here = one_hot(x_t, k, torch.float64)
        likelihood = torch.where(masked, mask_t, keep_t * here + _replaced(keep_t, mask_t) / k)
        back = torch.where(masked, mask_ts, keep_ts * here + _replaced(keep_ts, mask_ts) / k)
        likelihood = torch.where(likelihood > _TINY, likelihood, torch.inf)
        return likelihood, back, keep_s, _replaced(keep_s, mask_s) / k, mask_s

    def _rates_at(self, t: Tensor | int, like: Tensor) -> tuple[Tensor, Tensor]:
        """Cumulative keep and mask at ``t``, shaped (B, ..., 1) for states ``like`` (B, ...); () for an int."""
        keep, mask = (constant_on(rate, like.device)[t] for rate in (self.schedule.keep, self.schedule.mask))
        return _broadcast(keep, like), _broadcast(mask, like)

    def loss(self, x0: Tensor, x_t: Tensor, t: Tensor, logits: Tensor, auxiliary: float = 5e-4) -> Tensor:
        """(B, ...) bound of one timestep: KL of the posteriors, or -log p(x_0) at t = 1, plus an auxiliary term.

        Args:
            x0: (B, ...) data.
            x_t: (B, ...) states at t.
            t: (B,) timesteps, 1..T.
            logits: (B, ..., K) logits of x_0.
            auxiliary: weight of the cross-entropy of x_0 (Austin et al. 2021, Eq. 5; the paper's is 5e-4).
        """
        log_x0 = F.log_softmax(logits, dim=-1)
        cross_entropy = -log_x0.gather(-1, x0.unsqueeze(-1)).squeeze(-1)
        truth = F.one_hot(x0, self.categories).to(logits.dtype)
        q, p = (self.posterior(x_t, probs, t, t - 1) for probs in (truth, log_x0.exp()))
        divergence = (q * (q.clamp(min=_TINY).log() - p.clamp(min=_TINY).log())).sum(dim=-1)
        bound = torch.where(fitted(t.to(x0.device), x0) == 1, cross_entropy, divergence)
        return bound + auxiliary * cross_entropy


def inverted(cumulative: Tensor, uniform: Tensor) -> Tensor:
    """(...) int64: index of the running sum (..., S) of weights in which ``uniform`` (...) falls."""
    below = cumulative < uniform.unsqueeze(-1) * cumulative[..., -1:]
    return below.sum(dim=-1).clamp(max=cumulative.shape[-1] - 1)


def _replaced(keep: Tensor, mask: Tensor) -> Tensor:
    """Probability of a uniformly drawn category; exactly 0 where only a rounding error is left."""
    rest = 1.0 - keep - mask
    return torch.where(rest > 1e-12, rest, torch.zeros_like(rest))


def _broadcast(rate: Tensor, like: Tensor) -> Tensor:
    """``rate`` (B,) as (B, ..., 1) beside ``like`` (B, ...); a single number () as it is."""
    return fitted(rate, like).unsqueeze(-1) if rate.ndim else rate


def one_hot(states: Tensor, count: int, dtype: torch.dtype) -> Tensor:
    """(..., ``count``) rows of states (...); a state beyond the last, such as the mask token, has zeros."""
    return (states.unsqueeze(-1) == torch.arange(count, device=states.device)).to(dtype)


def fitted(rate: Tensor, like: Tensor) -> Tensor:
    """``rate`` (B,) or () with trailing dimensions to broadcast against ``like`` (B, ...)."""
    return rate.reshape(rate.shape + (1,) * (like.ndim - rate.ndim)) if rate.ndim else rate


def draw_unmasked(masked: Tensor, chance: Tensor, uniform: Tensor) -> Tensor:
    """(B, N) bool: of the ``masked`` slots of each scene, those unmasked now, drawn without replacement. The masked
    slots of a scene have the same ``chance`` (B, N). Of M masked slots with chance p, M p rounded down or up are
    unmasked, with mean M p. The ranks of independent ``uniform`` numbers (B, N) on [0, 1) do not depend on their
    minimum, so the ranks choose the slots, and the minimum decides the rounding.

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
    """(B, N) numbers on [0, 1), evenly spread over the ``unmasked`` slots of a scene in random order (Madow and Madow
    1944): for k slots (r + v) / k, r being the ranks of the independent ``uniform`` (B, N) on [0, 1) and v the
    fractional part of their sum, independent of r, so each number is uniform. Slots of equal probabilities p take a
    category p k times, rounded down or up. Other slots keep theirs.

    >>> unmasked = torch.tensor([[True, True, False, True, True]])
    >>> systematic(unmasked, torch.tensor([[0.75, 0.25, 0.5, 0.5, 0.125]])).tolist()
    [[0.90625, 0.40625, 0.5, 0.65625, 0.15625]]
    """
    number = unmasked.sum(dim=-1, keepdim=True).clamp(min=1)
    ranks = torch.where(unmasked, uniform, torch.full_like(uniform, torch.inf)).argsort(dim=-1).argsort(dim=-1)
    shared = torch.where(unmasked, uniform, torch.zeros_like(uniform)).sum(dim=-1, keepdim=True).frac()
    return torch.where(unmasked, (ranks + shared) / number, uniform)


def unmasking_log_prob(masked: Tensor, chance: Tensor, unmasked: Tensor) -> Tensor:
    """(B, N) nats, whose sum over a scene's slots is the log-probability that exactly ``unmasked``, a subset of the
    masked slots, are unmasked by :func:`draw_unmasked`. It depends on no parameter of a network; a scene's masked slots
    share it equally.

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
