"""Reward contract: the types of a reward, its context and its output."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch

if TYPE_CHECKING:
    from scene_envs.physics import PhysicsPool


@dataclass(frozen=True)
class RewardContext:
    """Inputs of a reward besides the scenes.

    Attributes:
        prompts: one prompt per scene if the prior is conditional, else None.
        pool: worker processes for physics; None computes in this process.
        seed: seed for rewards that draw random numbers.
    """

    prompts: tuple[str, ...] | None = None
    pool: PhysicsPool | None = None
    seed: int = 0


@dataclass(frozen=True)
class RewardOutput:
    """Scores of B scenes with N slots.

    Attributes:
        value: (B,) float, larger is better; ignored where ``valid`` is False.
        per_object: (B, N) float, credit per slot, or None.
        terms: (B,) floats for the log, by name.
        valid: (B,) bool, or None if every row is valid. Invalid rows are left out of all statistics.
        object_flags: (B, N) bools by name, such as ``"feasible"``. ``"judged"`` marks the slots to which a mean over
            objects gives credit; without this flag, they are the free objects.
        problem: reason why the whole batch is invalid if the reward raised or broke its contract, else empty.
    """

    value: Tensor
    per_object: Tensor | None = None
    terms: Mapping[str, Tensor] = field(default_factory=dict)
    valid: Tensor | None = None
    object_flags: Mapping[str, Tensor] = field(default_factory=dict)
    problem: str = ""

    @property
    def is_valid(self) -> Tensor:
        """(B,) bool: ``valid``, or all rows where it is None, without rows whose value is not finite."""
        finite = torch.isfinite(self.value)
        return finite if self.valid is None else self.valid & finite


@runtime_checkable
class Reward(Protocol):
    """Anything callable as ``(SceneBatch, RewardContext) -> RewardOutput``.

    A scene scores the same alone and in any batch, unless the reward says otherwise. A reward may declare its largest
    value by an attribute ``maximum`` (see :func:`declared_maximum`), which searches take for their scale. Attributes
    that are True describe it (see :func:`facts_of`):

    - ``depends_on_batch``: the score of a scene depends on the other scenes of its batch;
    - ``averages_objects``: the score is a mean over the objects, not a sum. In a sum, an empty slot has credit 0. A
      mean is taken over the objects alone, so an empty slot has no credit;
    - ``counts_objects``: the score depends on which objects a scene has. Their credit does not depend on their poses,
      so algorithms with credit per object give the advantage of the scene to the categories;
    - ``needs_prompts``: the reward compares scenes with the prompts of its context; runs without prompts refuse it at
      their start.
    """

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput: ...


_FACTS: dict[str, Callable[[Iterable[bool]], bool]] = {
    "depends_on_batch": any, "averages_objects": all, "counts_objects": any, "needs_prompts": any,
}  # fmt: skip


def facts_of(*rewards: object) -> dict[str, bool]:
    """The attributes by which a :class:`Reward` describes itself, False where it has none. Of several rewards, such as
    the parts of a sum, ``averages_objects`` says whether all are means, and the others whether one of them is so.

    >>> facts_of(lambda batch: batch.counts)["depends_on_batch"]
    False
    """
    return {name: of(bool(getattr(reward, name, False)) for reward in rewards) for name, of in _FACTS.items()}


def declared_maximum(reward: object, slots: int, free_slots: int) -> float | None:
    """The largest value that a reward declares for scenes of this size; None if it declares no positive number. Its
    attribute ``maximum`` is a number, or a method of the number of slots per scene, and of those without fixed objects.

    >>> class Share:
    ...     maximum = 1.0
    >>> declared_maximum(Share(), 40, 39), declared_maximum(len, 40, 39)
    (1.0, None)
    """
    declared = getattr(reward, "maximum", None)
    if callable(declared):
        declared = declared(slots, free_slots)
    if isinstance(declared, bool) or not isinstance(declared, int | float):
        return None
    return float(declared) if 0 < declared < float("inf") else None


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
    parts = [*([reward.reward] if hasattr(reward, "reward") else []), *getattr(reward, "rewards", ())]
    return [found for part in parts for found in learned_parts(part)]
