"""Losses of forward-process reinforcement learning: NFT and AWM."""

from __future__ import annotations

from torch import Generator, Tensor
from torch.nn import functional as F

from agents.post_training.expectation import Expectation
from agents.post_training.forward_process_loss import ForwardProcessLoss
from agents.priors.base import ScenePrior
from scene_envs.errors import InvalidInputError


class NFTLoss(ForwardProcessLoss):
    """Negative-aware fine-tuning (Zheng et al. 2025, arXiv 2509.16117), for poses and, on logits, for categories.

    With the optimality r = 1/2 + clip(A / c, -1, 1) / 2 and the implicit policies

        o_plus = (1 - beta) o_old + beta o,    o_minus = (1 + beta) o_old - beta o

    the loss is r |o_plus - target|^2 + (1 - r) |o_minus - target|^2. Its minimum over o at one x_t is
    o_old + E[(2 r - 1) (target - o_old)] / beta. The step is thus at most the mean absolute error of o_old divided by
    beta. The category loss has the same form, with cross-entropies of the logits l_plus and l_minus. These combine
    logits in the way that o_plus and o_minus combine outputs.

    Args:
        prior, sampler, expectation, generator: as in :class:`ForwardProcessLoss`.
        beta: strength; smaller values step further from the sampling policy.
        clip: c, the advantage at which a sample is fully good or bad.

    >>> from agents.priors.testing import tiny_prior
    >>> import torch
    >>> from tensordict import TensorDict
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> scenes = TensorDict({"scene": prior.encode(prior.sample(2, num_steps=3)), "advantage": torch.ones(2, 34)}, [2])
    >>> loss = NFTLoss(prior, prior)(scenes)
    >>> sorted(loss.keys()), float(loss["distance"])
    (['distance', 'loss_expectation', 'loss_objective'], 0.0)
    >>> loss["loss_objective"].backward()
    """

    def __init__(
        self,
        prior: ScenePrior,
        sampler: ScenePrior,
        *,
        beta: float = 0.5,
        clip: float = 1.0,
        expectation: Expectation | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__(prior, sampler, expectation=expectation, generator=generator)
        _positive(beta=beta, clip=clip)
        self.beta, self.clip = beta, clip

    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        good = self.optimality(advantage)
        change, error = self.beta * (output - old), target - old
        return good * (change - error).square() + (1 - good) * (change + error).square()

    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        good = self.optimality(advantage)
        change = self.beta * (logits - old)
        return good * _cross_entropy(old + change, category) + (1 - good) * _cross_entropy(old - change, category)

    def optimality(self, advantage: Tensor) -> Tensor:
        """The optimality r of an advantage, in [0, 1]."""
        return 0.5 + 0.5 * (advantage / self.clip).clamp(-1.0, 1.0)


class AWMLoss(ForwardProcessLoss):
    """Advantage weighted matching (Xue et al. 2025, arXiv 2509.25050) with a pull to the sampling policy.

    With a = clip(A / c, -1, 1), the loss of a continuous entry is a |o - target|^2 + beta |o - o_old|^2. This loss is
    bounded below for beta > 1. The loss of a category is a times its cross-entropy plus beta KL(p_old || p). For a bad
    sample it is bounded below if beta times p_old of the category exceeds -a. At o = o_old the gradient is that of
    :class:`NFTLoss` divided by the beta of :class:`NFTLoss`.

    Args:
        prior, sampler, expectation, generator: as in :class:`ForwardProcessLoss`.
        beta: strength of the pull, above 1.
        clip: c, the largest advantage.
    """

    def __init__(
        self,
        prior: ScenePrior,
        sampler: ScenePrior,
        *,
        beta: float = 2.0,
        clip: float = 1.0,
        expectation: Expectation | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__(prior, sampler, expectation=expectation, generator=generator)
        _positive(clip=clip)
        if not beta > 1:
            raise InvalidInputError(f"beta={beta} must be above 1: below, a bad sample pushes without bound")
        self.beta, self.clip = beta, clip

    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        bounded = (advantage / self.clip).clamp(-1.0, 1.0)
        return bounded * (output - target).square() + self.beta * (output - old).square()

    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """See :class:`ForwardProcessLoss`."""
        bounded = (advantage / self.clip).clamp(-1.0, 1.0)
        pull = F.kl_div(logits.log_softmax(-1), old.log_softmax(-1), reduction="none", log_target=True).sum(dim=-1)
        return bounded * _cross_entropy(logits, category) + self.beta * pull


def _cross_entropy(logits: Tensor, category: Tensor) -> Tensor:
    """(B, N) cross-entropies of (B, N, K) logits."""
    return F.cross_entropy(logits.flatten(0, 1), category.flatten(), reduction="none").view(category.shape)


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise InvalidInputError(f"{name}={value} must be positive")
