"""Policy and regularisation gradients of an update, accumulated into ``.grad``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Generator, Tensor, nn

from agents.networks.text import Text
from agents.post_training.losses import DDPOSFLoss
from agents.post_training.rollouts import Rollout
from agents.priors.base import ScenePrior
from agents.priors.forward import NoisedScenes
from agents.utils.process_group import ProcessGroup
from scene_envs.errors import InvalidInputError

SceneLoss = Callable[[NoisedScenes, Text | None], Tensor]
"""(B,) losses of noised scenes and their prompts."""


@dataclass(frozen=True)
class BatchGradient:
    """Statistics of the gradient that a batch added to ``.grad``.

    Attributes:
        loss: value of the objective, over the scenes of all processes.
        columns: further columns of the log.
    """

    loss: float
    columns: Mapping[str, float] = field(default_factory=dict)

    def figures(self) -> Mapping[str, float]:
        """Further columns of the log."""
        return self.columns


class GradientSum:
    """Sum of the gradients of parts of a batch, each of which is complete before it is added.

    The sum of two parts is the same, bit for bit, in one process as in two processes with one part each.

    Args:
        parameters: parameters whose ``.grad`` is summed; a gradient that is there already is the first part.

    >>> weight = nn.Parameter(torch.ones(1))
    >>> total = GradientSum([weight])
    >>> for factor in (2.0, 3.0):
    ...     (factor * weight).sum().backward()
    ...     total.add_part()
    >>> total.write()
    >>> weight.grad
    tensor([5.])
    """

    def __init__(self, parameters: Iterable[nn.Parameter]) -> None:
        self._parameters = [p for p in parameters if p.requires_grad]
        self._total: list[Tensor | None] = [None] * len(self._parameters)
        self.add_part()

    def add_part(self) -> None:
        """Add ``.grad`` to the sum, and clear it."""
        for index, parameter in enumerate(self._parameters):
            before, gradient = self._total[index], parameter.grad
            self._total[index] = before if gradient is None else gradient if before is None else before.add_(gradient)
            parameter.grad = None

    def write(self) -> None:
        """Put the sum into ``.grad``."""
        for parameter, total in zip(self._parameters, self._total, strict=True):
            parameter.grad = total


def draw_steps(weights: Tensor, count: int, generator: Generator) -> tuple[list[int], float]:
    """``count`` distinct steps of positive weight, and the factor that scales their sum to all such steps."""
    eligible = torch.nonzero(weights > 0).flatten()
    chosen = eligible[torch.randperm(len(eligible), generator=generator)[:count]]
    return sorted(chosen.tolist()), len(eligible) / len(chosen)


def accumulate_policy_gradient(
    loss: DDPOSFLoss, rollout: Rollout, advantage: Tensor, steps: Sequence[int], *, scale: float = 1.0
) -> BatchGradient:
    """Add the policy gradient of a rollout to ``.grad``, one chunk of scenes and one step at a time.

    The graph of a step is freed after the step, so memory does not depend on the number of steps. With several
    processes, ``.grad`` gets the part of this process's scenes in the mean over all scenes.

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
    processes = ProcessGroup.current()
    valid_count = max(1.0, processes.sum_numbers(int(rollout.valid.sum()))[0])
    gradient = GradientSum(loss.policy.parameters())
    for start in range(0, batch, size):
        rows = slice(start, min(start + size, batch))
        share = int(rollout.valid[rows].sum()) / valid_count  # turns a chunk's mean into its part of the batch's mean
        for step in steps if share else ():
            result = loss(rollout.transitions(step, advantage, rows))
            objective = result["loss_objective"] * (scale * share)
            objective.backward()
            total += float(objective.detach())
            largest = max(largest, float(result["log_ratio"]))
            clipped += float(result["clip_fraction"]) * share / len(steps)
        gradient.add_part()
    gradient.write()
    total, clipped = processes.sum_numbers(total, clipped)
    return BatchGradient(total, {"log_ratio": processes.largest(largest), "clip_fraction": clipped})


def add_regularisation_gradient(
    prior: ScenePrior,
    x0: Tensor,
    coefficient: float,
    generator: Generator,
    *,
    loss: SceneLoss | None = None,
    chunk: int | None = None,
    prompts: Sequence[str] | None = None,
) -> tuple[float, float]:
    """Add ``coefficient`` times the gradient of a loss of noised scenes to ``.grad``.

    Args:
        prior: the prior in training.
        x0: (B, N, D) normalised scenes of all processes; each process takes its share of them.
        coefficient: of the loss, which is a mean over scenes and entries.
        generator: source of timesteps and noise (CPU).
        loss: (B,) losses of noised scenes; None for the pretraining loss.
        chunk: scenes per pass.
        prompts: of the scenes, ``""`` for none; None for a prior that reads none.

    Returns:
        The mean loss of all scenes, and the norm of ``coefficient`` times its gradient.
    """
    if coefficient == 0:
        return 0.0, 0.0
    processes, parameters = ProcessGroup.current(), [p for p in prior.parameters() if p.requires_grad]
    before = [p.grad for p in parameters]
    for parameter in parameters:
        parameter.grad = None
    value, total = 0.0, GradientSum(parameters)
    noised, own = prior.noised(x0, generator), processes.rows(len(x0))
    losses = loss or prior.noised_loss
    size = chunk or len(x0)
    for start in range(own.start, own.stop, size):
        rows = slice(start, min(start + size, own.stop))
        text = None if prompts is None else encoded(prior, prompts[rows])
        mean = losses(noised.rows(rows), text).mean() * ((rows.stop - start) / len(x0))
        value += float(mean.detach())
        (coefficient * mean).backward()
        total.add_part()
    total.write()
    processes.sum_gradients(parameters)
    norm = gradient_norm(parameters)
    for parameter, gradient in zip(parameters, before, strict=True):
        if gradient is not None:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
    return processes.sum_numbers(value)[0], norm


def prompted_loss(prior: ScenePrior, x0: Tensor, prompts: Sequence[str] | None, generator: Generator | None) -> Tensor:
    """(B,) pretraining losses of real scenes ``x0`` (B, N, D), given their prompts if there are any."""
    text = None if prompts is None else encoded(prior, prompts)
    return prior.pretraining_loss(x0, generator, "none", text=text)


@torch.no_grad()
def encoded(prior: ScenePrior, prompts: Sequence[str]) -> Text | None:
    """Text of ``prompts`` without gradients; None for a prior that reads none."""
    return prior.encode_prompts(prompts) if prior.conditional else None


def gradient_norm(parameters: Iterable[nn.Parameter]) -> float:
    """Euclidean norm of all ``.grad``; 0 when there is none."""
    norms = [p.grad.norm() for p in parameters if p.grad is not None]
    return float(torch.stack(norms).norm()) if norms else 0.0


def judged_slots(rollout: Rollout) -> Tensor:
    """(B, N) bool: slots that the reward judges."""
    return rollout.batch.is_free if rollout.judged is None else rollout.judged


def no_credit_per_object() -> InvalidInputError:
    """The error where credit per object is asked of a reward that gives none."""
    return InvalidInputError(
        "algorithm.credit=object (credit='object') needs a reward with per_object values, and this one scores scenes "
        "only; take algorithm.credit=scene, or auto"
    )


def credited_reward(rollout: Rollout, credit: str) -> tuple[Tensor, Tensor]:
    """Rewards and their validity, (B,) for credit ``"scene"`` and (B, N) for ``"object"``; ``"auto"`` takes one.

    Fixed slots have no credit. If the reward is a mean over the objects, only the slots that it judges have credit. If
    it does not name these slots, they are the free objects.

    Raises:
        InvalidInputError: credit per object is asked of a reward that has no ``per_object``.
    """
    if credit == "scene" or (credit == "auto" and rollout.per_object is None):
        return rollout.reward, rollout.valid
    if rollout.per_object is None:
        raise no_credit_per_object()
    free = torch.ones(rollout.per_object.shape, dtype=torch.bool, device=rollout.per_object.device)
    free[:, : len(rollout.batch.scene_type.fixed)] = False  # fixed slots are not drawn
    if rollout.averages:
        free &= judged_slots(rollout).to(free.device)
    return rollout.per_object.float(), free & rollout.valid.unsqueeze(-1)
