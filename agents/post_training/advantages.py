"""Advantages: rewards with one baseline and one scale for the whole batch, over all workers."""

from __future__ import annotations

import torch
from torch import Tensor

from agents.post_training.algorithm_settings import BASELINES
from agents.utils.process_group import gather_rows
from scene_envs.errors import InvalidInputError

_MIN_STD = 1e-8


def compute_advantages(
    reward: Tensor,
    valid: Tensor | None = None,
    *,
    baseline: str = "leave_one_out",
    clip: float = 5.0,
    groups: Tensor | None = None,
) -> Tensor:
    """(reward - baseline) / std, clipped; invalid rows get 0 and are left out of all statistics.

    The std is the population's (divided by n) over the valid rows. The leave-one-out baseline of a row is
    the mean of the *other* valid rows (Kool et al. 2019), which keeps the gradient unbiased; ``"mean"`` is the
    mean of all. If ``torch.distributed`` runs, the rows of all workers count.

    Args:
        reward: (B,) or (B, K) floats; K columns (slots) share one baseline and one std.
        valid: (B,) or (B, K) bool; None takes all rows as valid.
        baseline: ``"leave_one_out"`` or ``"mean"``.
        clip: largest absolute value of an advantage.
        groups: (B,) int64, such as an index of the prompt; statistics are taken within each group.

    Returns:
        float32 of the shape of ``reward``; zeros for a group with fewer than two valid entries or no spread.

    >>> compute_advantages(torch.tensor([0.0, 1.0, 5.0]), torch.tensor([True, True, False]), baseline="mean")
    tensor([-1.,  1.,  0.])
    """
    if baseline not in BASELINES:
        raise InvalidInputError(f"baseline={baseline!r} is not known; use one of {', '.join(BASELINES)}")
    if not clip > 0:
        raise InvalidInputError(f"advantage_clip={clip} must be positive")
    taken = torch.ones_like(reward, dtype=torch.bool) if valid is None else _expand(valid, reward)
    taken = taken & torch.isfinite(reward)
    all_rewards, all_taken = gather_rows(reward), gather_rows(taken)
    if groups is None:
        return _normalise(reward, taken, all_rewards[all_taken], baseline, clip)
    all_groups = gather_rows(groups)
    advantage = torch.zeros_like(reward, dtype=torch.float32)
    for group in groups.unique():
        rows, in_group = groups == group, all_groups == group
        sample = all_rewards[in_group][all_taken[in_group]]
        advantage[rows] = _normalise(reward[rows], taken[rows], sample, baseline, clip)
    return advantage


def sibling_advantages(reward: Tensor, valid: Tensor, siblings: int) -> Tensor:
    """Rewards of slots minus those of the same slot in sibling scenes, over the root mean square of all differences.

    Siblings are neighbouring rows whose chains share their first steps, so that slot n of each holds the same object.
    The part of the reward that the shared steps decide cancels; the part that the later steps decide remains.

    Args:
        reward: (B, N) floats.
        valid: (B, N) bool; False entries, and rewards that are not finite, get 0 and have no part in their slot's mean.
        siblings: rows per group.

    Returns:
        (B, N) float32; 0 where fewer than two siblings are valid, or all differences vanish.

    >>> sibling_advantages(torch.tensor([[1.0], [0.0], [1.0], [1.0]]), torch.ones(4, 1, dtype=torch.bool), 2)[:, 0]
    tensor([ 1.4142, -1.4142,  0.0000,  0.0000])
    """
    valid = valid & torch.isfinite(reward)
    grouped = torch.where(valid, reward, torch.zeros_like(reward)).double().view(-1, siblings, reward.shape[1])
    present = valid.view_as(grouped)
    count = present.sum(dim=1, keepdim=True)
    others = (grouped.sum(dim=1, keepdim=True) - grouped) / (count - 1).clamp(min=1)
    difference = ((grouped - others) * present * (count > 1)).view_as(reward)
    taken = (present & (count > 1)).view_as(reward)
    all_differences = gather_rows(difference)[gather_rows(taken)]
    scale = all_differences.square().mean().sqrt() if len(all_differences) else all_differences.new_zeros(())
    return (difference / scale if scale > _MIN_STD else torch.zeros_like(difference)).float()


def _normalise(reward: Tensor, taken: Tensor, sample: Tensor, baseline: str, clip: float) -> Tensor:
    """Advantages of ``reward`` against the valid rewards ``sample`` (M,)."""
    count = sample.numel()
    zeros = torch.zeros_like(reward, dtype=torch.float32)
    if count < 2:
        return zeros
    values = sample.double()
    std = values.std(unbiased=False)
    if std <= _MIN_STD:
        return zeros
    deviation = (torch.where(taken, reward, zeros).double() - values.mean()) / std
    if baseline == "leave_one_out":  # r - mean of the others = (r - mean of all) n / (n - 1)
        deviation = deviation * (count / (count - 1))
    return torch.where(taken, deviation.clamp(-clip, clip).float(), zeros)


def _expand(valid: Tensor, reward: Tensor) -> Tensor:
    while valid.ndim < reward.ndim:
        valid = valid.unsqueeze(-1)
    return valid.expand(reward.shape)
