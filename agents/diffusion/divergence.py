"""KL divergences of two reverse steps from the same state, in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

from agents.diffusion.reverse_steps import GaussianStep, MixedStep, ReverseStep

_TINY = 1e-30


def gaussian_kl(difference: Tensor, std: Tensor) -> Tensor:
    """(B, N) nats between normals of equal ``std`` (N, D) whose means differ by (B, N, D), without entries of std 0.

    >>> gaussian_kl(torch.tensor([[[1.0, 9.0]]]), torch.tensor([[0.5, 0.0]]))
    tensor([[2.]])
    """
    safe = torch.where(std > 0, std, torch.inf)
    return 0.5 * (difference / safe).square().sum(dim=-1)


def categorical_kl(probs: Tensor, base: Tensor) -> Tensor:
    """(...) nats of ``probs`` (..., K) from ``base`` (..., K); differentiable where a probability is 0.

    >>> categorical_kl(torch.tensor([1.0, 0.0]), torch.tensor([0.5, 0.5]))
    tensor(0.6931)
    """
    return (probs * (probs.clamp(min=_TINY).log() - base.clamp(min=_TINY).log())).sum(dim=-1)


def step_kl(step: ReverseStep, base: ReverseStep) -> Tensor:
    """(B, N) nats of one step of a chain from the same step of another prior, summed over a slot's random variables.

    Both start from the same states, and their standard deviations are equal.
    """
    if isinstance(step, GaussianStep) and isinstance(base, GaussianStep):
        return gaussian_kl(step.mean - base.mean, step.std)
    if isinstance(step, MixedStep) and isinstance(base, MixedStep):
        states = categorical_kl(step.probs, base.probs)
        return gaussian_kl(step.mean - base.mean, step.pose_std) + torch.where(step.random, states, 0.0)
    raise TypeError(f"no KL divergence of {type(step).__name__} from {type(base).__name__}")
