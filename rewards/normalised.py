"""Composite reward: another reward in standard deviations from its mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch

from rewards.base import RewardContext, RewardOutput, averages_objects, counts_objects, depends_on_batch
from rewards.evaluation import evaluate_reward
from rewards.learned import parts_of
from rewards.registry import register_reward, resolve_reward, reward_name
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


@register_reward("normalised")
@dataclass(frozen=True)
class Normalised:
    """A reward in standard deviations from its mean, so that parts of a weighted sum have equal weight.

    Mean and standard deviation are given, or are those of the valid scenes of the batch. They are not carried from
    batch to batch: a reward with a memory would score the same scene differently in training, in search and after a
    run is resumed. A post-training run fixes them once, at those of samples of its base prior (:meth:`fit`), so that
    its guard and its report can compare values.

    Attributes:
        reward: what is scored.
        mean: value that becomes 0; that of the batch when null.
        std: spread that becomes 1, above 0; that of the batch when null, where equal values all become 0.

    >>> reward = Normalised("object_count", mean=20.0, std=5.0)
    >>> reward(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([-3.8000])
    """

    name: ClassVar[str] = "normalised"
    reward: Any
    mean: float | None = None
    std: float | None = None
    _given: tuple[float | None, float | None] = field(init=False, repr=False, compare=False, default=(None, None))

    def __post_init__(self) -> None:
        object.__setattr__(self, "reward", resolve_reward(self.reward))
        object.__setattr__(self, "_given", (self.mean, self.std))
        if self.std is not None and not self.std > 0:
            raise InvalidInputError(f"normalised: std={self.std} must be positive")

    @property
    def depends_on_batch(self) -> bool:
        """True unless mean and std are both given and ``reward`` does not depend on the batch either."""
        return self.is_open or depends_on_batch(self.reward)

    @property
    def averages_objects(self) -> bool:
        """Whether ``reward`` is a mean over the objects."""
        return averages_objects(self.reward)

    @property
    def counts_objects(self) -> bool:
        """Whether ``reward`` depends on which objects there are."""
        return counts_objects(self.reward)

    @property
    def is_open(self) -> bool:
        """Whether mean or std are those of the batch."""
        return self.mean is None or self.std is None

    def fit(self, batch: SceneBatch, context: RewardContext) -> None:
        """Fix mean and std, where they are open, at those of the valid scenes of ``batch``; equal values give std 1."""
        output = evaluate_reward(self.reward, batch, context, strict=True)
        values = output.value[output.is_valid].double()
        if len(values):
            spread = float(values.std(correction=0))
            self.load_statistics(
                (
                    float(values.mean()) if self.mean is None else self.mean,
                    (spread if spread > 0 else 1.0) if self.std is None else self.std,
                )
            )

    def statistics(self) -> tuple[float | None, float | None]:
        """Mean and std; None for those of the batch."""
        return self.mean, self.std

    def load_statistics(self, statistics: Sequence[float | None] | None) -> None:
        """Take mean and std; None takes the given ones again."""
        for name, value in zip(("mean", "std"), self._given if statistics is None else statistics, strict=True):
            object.__setattr__(self, name, value)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Score and normalise. Terms: the value of ``reward``, under its name, and the terms of ``reward``.

        ``per_object`` is that of ``reward`` over the standard deviation; the mean is not subtracted from credit.
        """
        output = evaluate_reward(self.reward, batch, context, strict=True)
        valid = output.value[output.is_valid].double()
        mean = valid.mean() if self.mean is None and len(valid) else torch.tensor(self.mean or 0.0)
        spread = valid.std(correction=0) if self.std is None and len(valid) else torch.tensor(self.std or 1.0)
        scale = torch.where(spread > 0, 1.0 / spread, torch.zeros_like(spread)).to(output.value)
        label = reward_name(self.reward)
        terms = {label: output.value, **{f"{label}.{name}": term for name, term in output.terms.items()}}
        credit = None if output.per_object is None else output.per_object * scale
        value = (output.value - mean.to(output.value)) * scale
        return replace(output, value=value, per_object=credit, terms=terms)


def normalised_parts(reward: Any) -> list[Normalised]:
    """The normalised rewards out of a reward and the parts of a composite, inner ones first.

    >>> [part.name for part in normalised_parts(resolve_reward({"name": "normalised", "reward": "object_count"}))]
    ['normalised']
    """
    found = [part for inner in parts_of(reward) for part in normalised_parts(inner)]
    return [*found, reward] if isinstance(reward, Normalised) else found
