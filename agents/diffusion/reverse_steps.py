"""Distribution of one reverse step: sampling and log-probabilities."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from agents.diffusion.categorical import _TINY, draw_unmasked, inverted, one_hot, systematic, unmasking_log_prob


class ReverseStep(Protocol):
    """p(x_s | x_t) of B scenes; differentiable in the denoiser's parameters."""

    @property
    def std(self) -> Tensor:
        """(N, D) standard deviation of continuous entries; 0 where an entry is certain or discrete."""

    @property
    def denoised(self) -> Tensor | None:
        """(B, N, D) the denoiser's estimate of x_0, where it is known."""

    @property
    def entries(self) -> int:
        """Number of random variables of the step of each scene."""

    def shifted(self, shift: Tensor) -> ReverseStep:
        """The step with the means of the first features moved by ``shift`` (B, N, F)."""
        ...

    def from_noise(self, noise: Tensor) -> Tensor:
        """x_s (B, N, D) from noise (B, N, D); standard normal noise gives exactly this distribution."""

    def log_prob(self, x: Tensor) -> Tensor:
        """(B, N) log-probability of ``x`` (B, N, D), summed over each slot's random variables, nats."""


def gaussian_log_prob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """(B, N) log-density in nats of independent normals at ``x`` (B, N, D), summed over the features of each slot, with
    ``mean`` (B, N, D) and ``std`` (N, D). An entry with std 0 is certain: it carries no probability and no gradient.

    >>> x, std = torch.zeros(1, 1, 2), torch.tensor([[1.0, 0.0]])
    >>> round(float(gaussian_log_prob(x, torch.zeros(1, 1, 2), std)), 4)
    -0.9189
    """
    random = std > 0
    safe = torch.where(random, std, torch.ones_like(std))
    z = (x - mean) / safe
    log_density = -0.5 * z.square() - safe.log() - 0.5 * math.log(2 * math.pi)
    return torch.where(random, log_density, torch.zeros_like(log_density)).sum(dim=-1)


class GaussianStep(NamedTuple):
    """Independent normals.

    Attributes:
        mean: (B, N, D).
        std: (N, D); 0 marks a certain entry.
        denoised: (B, N, D) the denoiser's estimate of x_0, where it is known.

    >>> step = GaussianStep(torch.zeros(1, 1, 2), torch.tensor([[1.0, 0.0]]))
    >>> step.from_noise(torch.ones(1, 1, 2)), step.entries
    (tensor([[[1., 0.]]]), 1)
    """

    mean: Tensor
    std: Tensor
    denoised: Tensor | None = None

    def shifted(self, shift: Tensor) -> GaussianStep:
        """The step with the means of the first features moved by ``shift`` (B, N, F)."""
        return self._replace(mean=_shifted(self.mean, shift))

    @property
    def entries(self) -> int:
        """Random entries of a scene."""
        return int((self.std > 0).sum())

    def from_noise(self, noise: Tensor) -> Tensor:
        """``mean + std * noise``."""
        return self.mean + self.std * noise

    def log_prob(self, x: Tensor) -> Tensor:
        """(B, N) nats."""
        return gaussian_log_prob(x, self.mean, self.std)


class MixedStep(NamedTuple):
    """Normal poses and a categorical state per slot, independent given x_t and which slots are unmasked.

    The last K features of a slot are the one-hot vector of its state; the mask token is all zeros.

    Attributes:
        mean: (B, N, P) of the pose.
        pose_std: (N, P); 0 marks a certain entry.
        probs: (B, N, K + 1) of the state, the mask token last.
        random: (N,) bool, slots whose state is drawn; in the others the likeliest one is taken.
        masked: (B, N) bool, masked slots that are unmasked together, so that their number is near the expected one
            (:mod:`agents.diffusion.categorical`); None unmasks each slot independently.
        denoised: (B, N, P + K) the denoiser's estimate of x_0, categories by arg-max, where it is known.
        groups: (B, K) int64, the group of each category. Slots that are unmasked together draw groups by systematic
            sampling, so that the number of each group is near the expected one. Then they draw categories within the
            groups independently. None draws categories independently, which is what :meth:`log_prob` describes.

    >>> probs = torch.tensor([[[0.25, 0.75, 0.0]]])
    >>> step = MixedStep(torch.zeros(1, 1, 1), torch.ones(1, 1), probs, torch.tensor([True]))
    >>> step.from_noise(torch.tensor([[[0.5, -2.0, 0.0]]]))  # the first noise of the state decides: Phi(-2) < 0.25
    tensor([[[0.5000, 1.0000, 0.0000]]])
    """

    mean: Tensor
    pose_std: Tensor
    probs: Tensor
    random: Tensor
    masked: Tensor | None = None
    denoised: Tensor | None = None
    groups: Tensor | None = None

    def shifted(self, shift: Tensor) -> MixedStep:
        """The step with the means of the first features moved by ``shift`` (B, N, F)."""
        return self._replace(mean=_shifted(self.mean, shift))

    def independent(self) -> MixedStep:
        """The step whose slots draw their categories independently, as :meth:`log_prob` assumes."""
        return self._replace(groups=None)

    @property
    def std(self) -> Tensor:
        """(N, P + K) standard deviation; 0 for the entries of the state."""
        return F.pad(self.pose_std, (0, self.probs.shape[-1] - 1))

    @property
    def entries(self) -> int:
        """Random pose entries and states of a scene."""
        return int((self.pose_std > 0).sum()) + int(self.random.sum())

    def from_noise(self, noise: Tensor) -> Tensor:
        """Poses by shifting and scaling noise; states by inverting their distribution function at Phi of a noise entry.

        Phi of the next entry decides which masked slots are unmasked, where slots are unmasked together. Phi of the
        third entry draws categories within the groups.
        """
        pose = self.mean.shape[-1]
        uniform = torch.special.ndtr(noise[..., pose : pose + 3].double())
        drawn = self._draw_states(uniform[..., 0], uniform[..., 1], uniform[..., -1])
        state = torch.where(self.random, drawn, self.probs.argmax(dim=-1))
        return torch.cat([self.mean + self.pose_std * noise[..., :pose], one_hot_state(state, self.probs)], dim=-1)

    def _draw_states(self, uniform: Tensor, order: Tensor, inner: Tensor) -> Tensor:
        mask = self.probs.shape[-1] - 1
        cumulative = self.probs.double().cumsum(dim=-1)
        if self.masked is None:
            return inverted(cumulative, uniform)
        if self.masked.device.type == "cpu" and not self.masked.any():
            return self.probs.argmax(dim=-1)
        unmasked = draw_unmasked(self.masked, 1 - self.probs[..., -1], order)
        if self.groups is None:
            chosen = inverted(cumulative[..., :-1], uniform)
        else:
            chosen = _draw_grouped(self.probs[..., :-1].double(), self.groups, systematic(unmasked, uniform), inner)
        states = torch.where(unmasked, chosen, torch.full_like(chosen, mask))
        return torch.where(self.masked, states, self.probs.argmax(dim=-1))

    def log_prob(self, x: Tensor) -> Tensor:
        """(B, N) nats: the log-density of the pose plus the log-probability of the state.

        The choice of the unmasked slots has one log-probability per scene; the masked slots have equal shares of it.
        With ``groups`` the sum over slots is not the log-probability of the step, which has no simple form.
        """
        pose = self.mean.shape[-1]
        continuous = gaussian_log_prob(x[..., :pose], self.mean, self.pose_std)
        state = state_of(x[..., pose:])
        discrete = self.probs.gather(-1, state.unsqueeze(-1)).squeeze(-1).clamp(min=_TINY).log()
        if self.masked is not None:
            chance, still = 1 - self.probs[..., -1], state == self.probs.shape[-1] - 1
            chosen = torch.where(still, torch.zeros_like(discrete), discrete - chance.clamp(min=_TINY).log())
            together = unmasking_log_prob(self.masked, chance.detach(), ~still)
            discrete = torch.where(self.masked, chosen + together, discrete)
        return continuous + torch.where(self.random, discrete, torch.zeros_like(discrete))


def _shifted(mean: Tensor, shift: Tensor) -> Tensor:
    return mean + F.pad(shift, (0, mean.shape[-1] - shift.shape[-1]))


def _draw_grouped(probs: Tensor, groups: Tensor, uniform: Tensor, inner: Tensor) -> Tensor:
    """(B, N) int64 categories, drawn with the weights ``probs`` (B, N, K): ``uniform`` draws one of the ``groups`` (B,
    K), then ``inner`` draws a category of this group.
    """
    order = groups.argsort(dim=-1, stable=True)[:, None].expand_as(probs)
    sorted_groups = groups[:, None].expand_as(probs).gather(2, order)
    weights = probs.gather(2, order)
    group = sorted_groups.gather(2, inverted(weights.cumsum(dim=-1), uniform).unsqueeze(-1))
    within = inverted((weights * (sorted_groups == group)).cumsum(dim=-1), inner)
    return order.gather(2, within.unsqueeze(-1)).squeeze(-1)


def one_hot_state(state: Tensor, probs: Tensor) -> Tensor:
    """(..., K) one-hot rows of states (...) in 0..K, with all zeros for the mask token K; dtype of ``probs``."""
    return one_hot(state, probs.shape[-1] - 1, probs.dtype)


def state_of(one_hot: Tensor) -> Tensor:
    """(...) int64 states of one-hot rows (..., K): the largest entry, or the mask token K where none is above 1/2."""
    value, index = one_hot.max(dim=-1)
    return torch.where(value > 0.5, index, torch.full_like(index, one_hot.shape[-1]))


def concatenate_steps(parts: Sequence[ReverseStep]) -> ReverseStep:
    """One step of several batches of the same chain at the same level."""
    first = parts[0]
    if len(parts) == 1:
        return first
    if not isinstance(first, GaussianStep | MixedStep):
        raise TypeError(f"cannot concatenate steps of type {type(first).__name__}")

    def joined(name: str) -> Tensor | None:
        columns = [getattr(part, name) for part in parts]
        if name in ("std", "pose_std", "random"):  # the same for all scenes
            return columns[0]
        return None if any(column is None for column in columns) else torch.cat(columns)

    return type(first)(*map(joined, first._fields))  # type: ignore[arg-type]
