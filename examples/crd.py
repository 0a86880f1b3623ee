"""CRD in one file: centred reward distillation on the forward process, as an algorithm of a user's own.

    scene-envs post-train --allow-local algorithm=./examples/crd.py:crd reward=feasible_share

Zhu et al. 2026 (arXiv 2603.14128). The policy p* that maximises E[R] - tau KL(p || p_old) has
R = tau log p*(x) / p_old(x) + tau log Z, and Z depends on the prompt alone. Less its mean over a group of one prompt,
each side loses Z, and a regression is left. With the implicit reward r = |o_old - y|^2 - |o - y|^2 of a finished scene
that is noised again (y the target; r is log p / p_old up to a factor), and with R = 1/2 + clip(A / c) / 2,

    loss = (c / beta) (beta (r - mean r) - (R - mean R))^2 + anchor (floor + (1 - floor) R) |o - o_base|^2

where mean r is a constant. The reference o_old is not the sampler, which follows more slowly; o_base is the base prior
with its guidance, and the strength of this anchor follows the reward: strong late, weak early.
What the paper leaves open, and our reading (of its abstract and an open implementation, not of its equations):
 1. Slots. Given x_t, the probability of a scene is a product over slots. Each slot with credit has a regression of its
    own, on its own reward if the reward has credit per object; means are over all such slots of the group.
 2. Poses: r is a mean over the entries of a slot. For two targets y = +-1 with R - mean R = +-h, the minimum is
    o = h / (2 beta): to first order the mean tanh(h / tau) of the exact p* for tau = 2 beta.
 3. Categories: r = log p(c | x_t) - log p_old(c | x_t) of masked slots, and the anchor is KL(p_base || p).
 4. A group is the scenes of one prompt in one chunk of one process; without prompts, the chunk. o_old has the weights
    at the end of the last iteration; there, the gradient is that of AWM without its pull.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from agents.post_training import ForwardProcess, ForwardProcessLoss, register_algorithm
from agents.post_training.settings import ForwardProcessSettings
from agents.priors.prior import NoisedScenes, ScenePrior
from scene_envs.errors import Nonnegative, Positive, at_least


@dataclass
class CRDSettings(ForwardProcessSettings):
    """CRD: rewards and log ratios, both centred in a group, matched by regression (Zhu et al. 2026).

    Attributes:
        beta: factor of the implicit reward; smaller values step further from the reference.
        anchor: coefficient of the distance to the guided base prior.
        floor: share of ``anchor`` for the lowest reward.
    """

    name: str = "crd"
    expectation_lr: Annotated[float, at_least(0)] = 0.0
    beta: Positive = 0.5
    anchor: Nonnegative = 0.01
    floor: Nonnegative = 0.1


class CRDLoss(ForwardProcessLoss):
    """The regression; ``sampler`` is the reference, and the attributes are set after it is made."""

    default_beta, anchor, floor, guidance = 0.5, 0.0, 0.0, 0.0
    base: ScenePrior

    def of_noised(self, noised: NoisedScenes, flat: TensorDictBase) -> TensorDict:
        """The loss of noised scenes, whose groups and guided base outputs are kept for its two parts."""
        prompt, text = flat.get("prompt", torch.zeros_like(noised.t)[:, None]), self._text(flat)
        self.groups, self.drawn = torch.unique(prompt, dim=0, return_inverse=True)[1], noised.drawn
        with torch.no_grad():
            said = self.base.output(noised, text)
            free = said if text is None or not self.guidance else self.base.output(noised)
        self.poses = said.continuous.lerp(free.continuous, -self.guidance)
        self.logits = None if said.logits is None else said.logits.lerp(free.logits, -self.guidance)
        return super().of_noised(noised, flat)

    def continuous_loss(self, output: Tensor, old: Tensor, target: Tensor, advantage: Tensor) -> Tensor:
        """(B, N, F) losses; the entries of a slot share its regression."""
        weight = self.prior.loss_weight(output.shape[-2])[:, : output.shape[-1]].to(output)
        gain = ((old - target).square() - (output - target).square()) * weight
        slots = self.regression(gain.sum(-1) / weight.sum(-1).clamp(min=1.0), advantage[..., 0])
        return slots[..., None] + self.strength(advantage) * (output - self.poses).square()

    def category_loss(self, logits: Tensor, old: Tensor, category: Tensor, advantage: Tensor) -> Tensor:
        """(B, N) losses of categories."""
        new, before = (scores.log_softmax(-1).gather(-1, category[..., None])[..., 0] for scores in (logits, old))
        pull = F.kl_div(logits.log_softmax(-1), self.logits.log_softmax(-1), reduction="none", log_target=True).sum(-1)
        return self.regression(new - before, advantage * self.drawn) + self.strength(advantage) * pull

    def regression(self, implicit: Tensor, advantage: Tensor) -> Tensor:
        """(B, N) losses of slots with implicit rewards and advantages; 0 without an advantage."""
        credited = (advantage != 0).to(implicit)
        both = torch.stack([self.beta * implicit, (advantage / self.clip).clamp(-1.0, 1.0) / 2, credited], -1)
        sums = torch.zeros_like(both[:, 0]).index_add(0, self.groups, (both * credited[..., None]).sum(1).detach())
        centred = both - (sums / sums[:, 2:].clamp(min=1.0))[self.groups][:, None]
        return credited * (centred[..., 0] - centred[..., 1]).square() * self.clip / self.beta

    def strength(self, advantage: Tensor) -> Tensor:
        """Coefficient of the anchor."""
        return self.anchor * (self.floor + (1 - self.floor) * (1 + (advantage / self.clip).clamp(-1.0, 1.0)) / 2)


@register_algorithm("crd", CRDSettings)
class CRD(ForwardProcess):
    """The forward-process algorithm with the regression and a reference of its own."""

    def make_loss(self, settings: Any) -> CRDLoss:
        """The loss of these settings, with the reference and the base prior that it compares with."""
        loss = CRDLoss(self.prior, deepcopy(self.sampler), beta=settings.beta, clip=settings.advantage_clip)
        loss.anchor, loss.floor, loss.guidance = settings.anchor, settings.floor, self.policy.guidance
        loss.base, loss.expectation = deepcopy(self.sampler), self.expectation
        return loss

    def end_iteration(self) -> None:
        """Move the sampler towards the prior in training, and make the prior the reference."""
        super().end_iteration()
        self.loss.sampler.load_state_dict(self.prior.state_dict())

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`; the prior, which is the reference, is restored already."""
        super().restore(state)
        self.loss.sampler.load_state_dict(self.prior.state_dict())
