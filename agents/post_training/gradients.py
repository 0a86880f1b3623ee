"""Policy and regularisation gradients of an update, accumulated into ``.grad`` and measured separately."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor, nn

from agents.post_training.losses import DDPOSFLoss
from agents.post_training.rollouts import Rollout
from agents.priors.base import ScenePrior
from scene_envs.errors import InvalidInputError


@dataclass(frozen=True)
class PolicyGradient:
    """Statistics of an accumulated policy gradient.

    Attributes:
        loss: value of the objective, summed over the steps taken.
        norm: its gradient's norm.
        log_ratio: largest |log p_now - log p_sampling| of a scene's step; 0 before the first update.
        clip_fraction: mean share of clipped ratios.
    """

    loss: float
    norm: float
    log_ratio: float
    clip_fraction: float

    def figures(self) -> Mapping[str, float]:
        """Further columns of the log."""
        return {"log_ratio": self.log_ratio, "clip_fraction": self.clip_fraction}


def draw_steps(weights: Tensor, count: int, generator: Generator) -> tuple[list[int], float]:
    """``count`` distinct steps of positive weight, and the factor that makes their sum stand for all of them."""
    eligible = torch.nonzero(weights > 0).flatten()
    chosen = eligible[torch.randperm(len(eligible), generator=generator)[:count]]
    return sorted(chosen.tolist()), len(eligible) / len(chosen)


def accumulate_policy_gradient(
    loss: DDPOSFLoss, rollout: Rollout, advantage: Tensor, steps: Sequence[int], *, scale: float = 1.0
) -> PolicyGradient:
    """Add the policy gradient of a rollout to ``.grad``, one step and one chunk of scenes at a time.

    No graph outlives its chunk, so memory does not depend on the number of steps.

    Args:
        loss: the objective; its policy's ``chunk`` bounds the scenes per pass.
        rollout: B episodes.
        advantage: (B,) or (B, N).
        steps: indices of the steps in the gradient.
        scale: factor on the sum over ``steps``.
    """
    total, largest, clipped = 0.0, 0.0, 0.0
    batch = rollout.reward.shape[0]
    size = loss.policy.chunk or batch
    valid_count = max(1, int(rollout.valid.sum()))
    for step in steps:
        for start in range(0, batch, size):
            rows = slice(start, min(start + size, batch))
            share = int(rollout.valid[rows].sum()) / valid_count  # a chunk's mean to the batch's mean
            if share == 0:
                continue
            result = loss(rollout.transitions(step, advantage, rows))
            objective = result["loss_objective"] * (scale * share)
            objective.backward()
            total += float(objective.detach())
            largest = max(largest, float(result["log_ratio"]))
            clipped += float(result["clip_fraction"]) * share / len(steps)
    return PolicyGradient(total, gradient_norm(loss.policy.parameters()), largest, clipped)


def add_regularisation_gradient(
    prior: ScenePrior,
    x0: Tensor,
    coefficient: float,
    generator: Generator,
    *,
    chunk: int | None = None,
    prompts: Sequence[str] | None = None,
) -> tuple[float, float]:
    """Add ``coefficient`` times the gradient of the pretraining loss to ``.grad``.

    Args:
        prior: the prior in training.
        x0: (B, N, D) normalised real scenes.
        coefficient: of the loss, which is a mean over scenes and entries.
        generator: source of timesteps and noise (CPU).
        chunk: scenes per pass.
        prompts: of the scenes, ``""`` for none; None for a prior that reads none.

    Returns:
        The pretraining loss, and the norm of ``coefficient`` times its gradient.
    """
    if coefficient == 0:
        return 0.0, 0.0
    size = chunk or len(x0)

    def terms() -> Iterator[Tensor]:
        for start in range(0, len(x0), size):
            part, texts = x0[start : start + size], None if prompts is None else prompts[start : start + size]
            yield prompted_loss(prior, part, texts, generator).mean() * (len(part) / len(x0))

    return add_gradient(terms(), prior.parameters(), coefficient)


def add_gradient(
    terms: Iterable[Tensor], parameters: Iterable[nn.Parameter], coefficient: float
) -> tuple[float, float]:
    """Add ``coefficient`` times the gradient of a sum to ``.grad``, one term () and its graph at a time.

    Returns:
        The sum, and the norm of ``coefficient`` times its gradient.
    """
    trained = [p for p in parameters if p.requires_grad]
    value, gradients = 0.0, [torch.zeros_like(p) for p in trained]
    for term in terms:
        value += float(term.detach())
        for total, gradient in zip(gradients, torch.autograd.grad(term, trained, allow_unused=True), strict=True):
            if gradient is not None:
                total.add_(gradient, alpha=coefficient)
    for parameter, gradient in zip(trained, gradients, strict=True):
        parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
    return value, float(_norm(gradients))


def prompted_loss(prior: ScenePrior, x0: Tensor, prompts: Sequence[str] | None, generator: Generator | None) -> Tensor:
    """(B,) pretraining losses of real scenes ``x0`` (B, N, D), given their prompts if there are any."""
    if prompts is None or not prior.conditional:
        return prior.pretraining_loss(x0, generator, "none")
    with torch.no_grad():
        text = prior.encode_prompts(prompts)
    return prior.pretraining_loss(x0, generator, "none", text=text)


def gradient_norm(parameters: Iterable[nn.Parameter]) -> float:
    """Euclidean norm of all ``.grad``; 0 when there is none."""
    return float(_norm([p.grad for p in parameters if p.grad is not None]))


def credited_reward(rollout: Rollout, credit: str) -> tuple[Tensor, Tensor]:
    """Rewards and their validity, (B,) for credit ``"scene"`` and (B, N) for ``"object"``; ``"auto"`` is one of them.

    Raises:
        InvalidInputError: credit per object is asked of a reward that has no ``per_object``.
    """
    if credit == "scene" or (credit == "auto" and rollout.per_object is None):
        return rollout.reward, rollout.valid
    if rollout.per_object is None:
        raise InvalidInputError("credit='object' needs a reward with per_object values; this one scores scenes only")
    free = torch.ones(rollout.per_object.shape, dtype=torch.bool, device=rollout.per_object.device)
    free[:, : len(rollout.batch.scene_type.fixed)] = False  # welded slots are not drawn
    return rollout.per_object.float(), free & rollout.valid.unsqueeze(-1)


def _norm(gradients: Sequence[Tensor]) -> Tensor:
    if not gradients:
        return torch.zeros(())
    return torch.stack([g.norm() for g in gradients]).norm()
