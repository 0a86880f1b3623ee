"""Rewards with a model that learns from the scenes of a post-training run."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from scene_envs.scene import SceneBatch


@runtime_checkable
class LearnedReward(Protocol):
    """A reward whose scores change during a run, because it learns from real scenes and from samples.

    ``post-train`` calls :meth:`begin` once, then :meth:`learn` with samples of the base prior and with the scenes of
    every iteration after they were scored. The state is part of the run's checkpoint. All processes of a run call both
    with the same scenes, so they have the same model.
    """

    def begin(self, real: SceneBatch, seed: int) -> None:
        """Forget everything, and take ``real`` as the real scenes."""

    def learn(self, samples: SceneBatch, steps: int | None = None) -> None:
        """Take ``steps`` optimiser steps on ``samples`` of the prior in training."""

    def state_dict(self) -> dict[str, Any]:
        """State for a checkpoint."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`, after :meth:`begin`."""


def learned_parts(reward: Any) -> list[LearnedReward]:
    """The rewards that learn, among a reward and the parts of a composite; in a fixed order.

    >>> from rewards import resolve_reward
    >>> learned_parts(resolve_reward("object_count"))
    []
    """
    if isinstance(reward, LearnedReward):
        return [reward]
    return [found for part in parts_of(reward) for found in learned_parts(part)]


def parts_of(reward: Any) -> list[Any]:
    """The parts of a composite, in a fixed order; none of any other reward."""
    parts = [getattr(reward, name) for name in ("reward", "condition") if hasattr(reward, name)]
    return [*parts, *getattr(reward, "rewards", ())]
