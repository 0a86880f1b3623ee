"""UDM-GRPO in one file: a clipped policy gradient whose action is the finished scene, as an algorithm of a user's own.

    python examples/udm_grpo.py prior=dimsum_table reward=feasible_share iterations=40 output=runs/udm_grpo
    scene-envs post-train --allow-local algorithm=./examples/udm_grpo.py:udm_grpo reward=feasible_share

Wang et al. 2026 (arXiv 2604.18518) found that GRPO on the steps of a uniform discrete diffusion collapses: early steps
are noise, and the states that a sampler visits are not those of pretraining. Their action is the finished sample x_0
at every step, and its state x_t is made by the forward process. With the group-relative advantage A of x_0,

    loss = - min(rho A, clip(rho, 1 - eps, 1 + eps) A),    rho = p(x_0 | x_t) / p_old(x_0 | x_t)

averaged over random t; p_old is the policy that sampled x_0.

What the paper leaves open, and our reading. We know its abstract and its figures, not its equations.
 1. Categories. p(x_0 | x_t) is a product over slots, and each masked slot has the probability of its category. The
    ratio and its clip are those of a slot, as those of a token in language models. A slot that is not masked is
    certain in a chain that only absorbs, so it has no ratio.
 2. Poses. The denoiser's output o is the mean of its target y, a linear function of x_0 given x_t. With
    p(x_0 | x_t) = N(y; o, s^2), log rho = (|o_old - y|^2 - |o - y|^2) / (2 s^2), for every entry. The target of a
    preconditioned denoiser has unit variance, so s = 1 is the widest choice: a smaller s makes longer gradients and
    an earlier clip. Levels of noise have the weights of pretraining.
 3. The joint action. Pose and category are independent given x_t, so log rho is their sum, and each factor is clipped
    by itself. Poses take the advantage of their slot where the reward has credit per object, categories that of the
    scene (``category_credit``). Ratios end at 10 (dual clip): the target of an object that stands where its category
    never does is tens of standard deviations from 0, and its ratio overflows.
 4. The gradient at rho = 1 is that of -A log p(x_0 | x_t): for poses that of AWM without its pull, times c / (2 s^2).
    The clip takes the place of the pull. The paper's KL term is here the pretraining loss on real scenes, which the
    training loop adds (``regularisation.weight``).
 5. On-policy: ``sampler_decay=0`` samples with the weights in training, and ``expectation_lr=0`` learns no mean of own
    samples. Reduced steps are ``draws``; training needs no guidance.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.nn import functional as F

from agents.cli import main
from agents.post_training import ForwardProcess, ForwardProcessLoss, register_algorithm
from agents.post_training.algorithms.base import bounded_ratio
from agents.post_training.settings import ForwardProcessSettings
from scene_envs.errors import BELOW_ONE, Positive, Unlimited, at_least


@dataclass
class UDMGRPOSettings(ForwardProcessSettings):
    """UDM-GRPO: clipped ratios of the probability of finished scenes that are noised again (Wang et al. 2026).

    Attributes:
        clip_epsilon: half-width of the clip of the probability ratio of a slot's category or of an entry of its pose.
        std: standard deviation s of the denoiser's target around its output.
    """

    name: str = "udm_grpo"
    sampler_decay: Annotated[float, BELOW_ONE] = 0.0
    advantage_clip: Unlimited = 5.0
    expectation_lr: Annotated[float, at_least(0)] = 0.0
    clip_epsilon: Positive = 0.2
    std: Positive = 1.0


class UDMGRPOLoss(ForwardProcessLoss):
    """The clipped surrogate; ``beta`` is the half-width of the clip, and ``std`` the standard deviation of targets."""

    default_beta = 0.2
    std = 1.0

    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """(B, N, F) losses of the entries of poses."""
        log_ratio = ((old - target).square() - (output - target).square()) / (2 * self.std**2)
        return self.surrogate(log_ratio, advantage)

    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """(B, N) losses of the categories."""
        new, before = (
            -F.cross_entropy(scores.flatten(0, 1), category.flatten(), reduction="none").view(category.shape)
            for scores in (logits, old)
        )
        return self.surrogate(new - before, advantage)

    def surrogate(self, log_ratio: Tensor, advantage: Tensor) -> Tensor:
        """The loss of actions with these log ratios."""
        ratio, credit = bounded_ratio(log_ratio), advantage.clamp(-self.clip, self.clip)
        return -torch.minimum(ratio * credit, ratio.clamp(1 - self.beta, 1 + self.beta) * credit)


@register_algorithm("udm_grpo", UDMGRPOSettings)
class UDMGRPO(ForwardProcess):
    """The forward-process algorithm with the clipped surrogate."""

    def make_loss(self, settings: Any) -> UDMGRPOLoss:
        """The loss of these settings."""
        loss = UDMGRPOLoss(
            self.prior, self.sampler, beta=settings.clip_epsilon, clip=settings.advantage_clip,
            expectation=self.expectation,
        )  # fmt: skip
        loss.std = settings.std
        return loss


if __name__ == "__main__":
    sys.exit(main(["post-train", *sys.argv[1:], "algorithm=udm_grpo"]))
