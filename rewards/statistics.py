"""Fixed statistics of the normalised parts of a reward, also of one that runs in a process of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rewards.base import RewardContext
from rewards.isolation import IsolatedReward
from rewards.normalised import normalised_parts
from scene_envs.scene import SceneBatch

Statistics = Sequence[Sequence[float | None]]
"""Mean and standard deviation of each normalised part; None for those of the batch. Empty for the given ones."""


def has_open_statistics(reward: Any) -> bool:
    """Whether a normalised part takes its mean or its standard deviation from the batch.

    >>> from rewards import resolve_reward
    >>> has_open_statistics(resolve_reward({"name": "normalised", "reward": "object_count", "mean": 20.0, "std": 5.0}))
    False
    """
    if isinstance(reward, IsolatedReward):
        return reward.has_open_statistics
    return any(part.is_open for part in normalised_parts(reward))


def fit_statistics(reward: Any, batch: SceneBatch, context: RewardContext) -> None:
    """Fix the open statistics at those of the scenes of ``batch``."""
    if isinstance(reward, IsolatedReward):
        reward.fit_statistics(batch, context)
        return
    for part in normalised_parts(reward):
        part.fit(batch, context)


def statistics_of(reward: Any) -> Statistics:
    """The statistics of all normalised parts."""
    if isinstance(reward, IsolatedReward):
        return reward.statistics or []
    return [part.statistics() for part in normalised_parts(reward)]


def load_statistics(reward: Any, statistics: Statistics | None) -> None:
    """Take the statistics of :func:`statistics_of`; None takes the given ones again."""
    if isinstance(reward, IsolatedReward):
        reward.load_statistics(statistics)
        return
    parts = normalised_parts(reward)
    if not statistics:
        statistics = [None] * len(parts)  # type: ignore[list-item]
    for part, pair in zip(parts, statistics, strict=True):
        part.load_statistics(pair)
