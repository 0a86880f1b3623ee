"""Advantages: rewards with one baseline and one scale for the whole batch, over all workers."""

from __future__ import annotations

import torch
from torch import Tensor

from agents.utils.process_group import gather_rows
from scene_envs.errors import InvalidInputError

_MIN_STD = 1e-8


BASELINES = ("leave_one_out", "mean")


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
        valid: (B,) bool or (B, K) bool; None means all.
        baseline: ``"leave_one_out"`` or ``"mean"``.
        clip: advantages are kept within ±clip.
        groups: (B,) int64, such as an index of the prompt; statistics are taken within each group.

    Returns:
        The shape of ``reward``, float32. All zeros where a group has fewer than two valid entries or no spread.

    >>> compute_advantages(torch.tensor([0.0, 1.0, 5.0]), torch.tensor([True, True, False]), baseline="mean")
    tensor([-1.,  1.,  0.])
    """
    if baseline not in BASELINES:
        raise InvalidInputError(f"baseline={baseline!r} is not known; use one of {', '.join(BASELINES)}")
    if not clip > 0:
        raise InvalidInputError(f"advantage_clip={clip} must be positive")
    taken = torch.ones_like(reward, dtype=torch.bool) if valid is None else _expand(valid, reward)
    taken = taken & torch.isfinite(reward)
    everywhere, mask, all_groups = (
        gather_rows(reward),
        gather_rows(taken),
        None if groups is None else gather_rows(groups),
    )
    if groups is None or all_groups is None:
        return _normalise(reward, taken, everywhere[mask], baseline, clip)
    advantage = torch.zeros_like(reward, dtype=torch.float32)
    for group in groups.unique():
        rows = groups == group
        elsewhere = all_groups == group
        advantage[rows] = _normalise(reward[rows], taken[rows], everywhere[elsewhere][mask[elsewhere]], baseline, clip)
    return advantage


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
