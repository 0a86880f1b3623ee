"""Composite rewards: weighted sum, product, clip.

Every part may be a name, a mapping, a function or a reward. A scene is valid when every part could score it.
A composite depends on the batch if a part does. A part's value is a term under the part's name, and its own
terms follow as ``"<part>.<term>"``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import torch
from torch import Tensor

from rewards.base import Reward, RewardContext, RewardOutput, declared_maximum, facts_of
from rewards.evaluation import evaluate_reward
from rewards.registry import register_reward, resolve_reward, reward_name
from scene_envs.errors import FINITE, Checked, InvalidInputError
from scene_envs.scene import SceneBatch


@register_reward("weighted_sum")
class WeightedSum:
    """Sum of rewards, each times its weight.

    ``per_object`` is the weighted sum of the parts' credits when all of them give one. If some parts are means over the
    objects and others are not, the credits of a mean are divided by its number of objects, so that the parts have the
    same weights in the credits as in the value. A slot is judged where every part judges it.

    Args:
        rewards: parts of the reward.
        weights: one number per part; all 1 by default.
        offset: number that is added to the sum, such as one that lifts an objective of a search above 0.

    >>> reward = WeightedSum(["object_count", "object_count"], weights=[1.0, 0.5])
    >>> reward(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([1.5000])
    """

    name: ClassVar[str] = "weighted_sum"

    def __init__(self, rewards: Sequence[Any], weights: Sequence[float] | None = None, offset: float = 0.0) -> None:
        self.rewards = _resolve_parts(self.name, rewards)
        self.weights = tuple(1.0 for _ in self.rewards) if weights is None else tuple(weights)
        if len(self.weights) != len(self.rewards):
            raise InvalidInputError(f"weighted_sum: {len(self.rewards)} rewards need as many weights, got {weights!r}")
        self.offset = offset
        for key, value in [*(("weights", weight) for weight in self.weights), ("offset", offset)]:
            FINITE.check("weighted_sum: ", key, value, False)
        self.facts = facts_of(*self.rewards)
        vars(self).update(self.facts)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        outputs = _score_parts(self.rewards, batch, context)
        pairs = zip(self.rewards, outputs.values(), strict=True)
        credits = [self._credit(reward, output, batch) for reward, output in pairs if output.per_object is not None]
        per_object = self._add_up(credits) if len(credits) == len(outputs) else None
        value = self._add_up([output.value for output in outputs.values()]) + self.offset
        total = _combine(value, outputs, per_object)
        if not any("judged" in output.object_flags for output in outputs.values()):
            return total
        judged = [output.object_flags.get("judged", batch.is_free) for output in outputs.values()]
        return replace(total, object_flags={**total.object_flags, "judged": torch.stack(judged).all(dim=0)})

    def _credit(self, reward: Reward, output: RewardOutput, batch: SceneBatch) -> Tensor:
        """(B, N) credits of a part; in a sum of means and other rewards, those of a mean are shares of its value."""
        assert output.per_object is not None
        if self.facts["averages_objects"] or not facts_of(reward)["averages_objects"]:
            return output.per_object
        judged = output.object_flags.get("judged", batch.is_free)
        return output.per_object / judged.sum(dim=1, keepdim=True).clamp(min=1)

    def _add_up(self, tensors: Sequence[Tensor]) -> Tensor:
        return torch.stack([weight * tensor for weight, tensor in zip(self.weights, tensors, strict=True)]).sum(dim=0)

    def __repr__(self) -> str:
        return f"WeightedSum({list(self.rewards)}, weights={list(self.weights)}, offset={self.offset})"


@register_reward("product")
class Product:
    """Product of rewards; 0 if one of them is 0.

    >>> Product(["object_count"])(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([1.])
    """

    name: ClassVar[str] = "product"

    def __init__(self, rewards: Sequence[Any]) -> None:
        self.rewards = _resolve_parts(self.name, rewards)
        vars(self).update(facts_of(*self.rewards), averages_objects=False, counts_objects=False)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        outputs = _score_parts(self.rewards, batch, context)
        return _combine(torch.stack([output.value for output in outputs.values()]).prod(dim=0), outputs)

    def __repr__(self) -> str:
        return f"Product({list(self.rewards)})"


@register_reward("clip")
@dataclass(frozen=True)
class Clip(Checked):
    """A reward kept between two bounds.

    Attributes:
        reward: reward to compute.
        low: smallest value; null for no bound.
        high: largest value; null for no bound.

    >>> Clip("object_count", high=0.5)(SceneBatch.empty("dimsum_table", 1), RewardContext()).value
    tensor([0.5000])
    """

    name: ClassVar[str] = "clip"
    place = "clip: "
    reward: Any
    low: Annotated[float, FINITE] | None = None
    high: Annotated[float, FINITE] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        reward = resolve_reward(self.reward)
        vars(self).update(facts_of(reward), reward=reward)
        if self.low is None and self.high is None:
            raise InvalidInputError("clip: give low, high or both")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise InvalidInputError(f"clip: low={self.low} is above high={self.high}")

    def maximum(self, slots: int, free_slots: int) -> float | None:
        """``high``, or the largest value of the reward where that is less."""
        bounds = self.high, declared_maximum(self.reward, slots, free_slots)
        return min((bound for bound in bounds if bound is not None), default=None)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Score and clip; scenes beyond a bound give their objects no credit."""
        outputs = _score_parts((self.reward,), batch, context)
        (output,) = outputs.values()
        value = output.value.clamp(self.low, self.high)
        inside = (value == output.value).unsqueeze(-1)
        return _combine(value, outputs, None if output.per_object is None else output.per_object * inside)


def _resolve_parts(name: str, rewards: Sequence[Any]) -> tuple[Reward, ...]:
    if isinstance(rewards, str | Mapping) or not len(rewards):
        raise InvalidInputError(f"{name}: rewards={rewards!r} must be a list of at least one reward")
    return tuple(resolve_reward(reward) for reward in rewards)


def _score_parts(parts: Sequence[Reward], batch: SceneBatch, context: RewardContext) -> dict[str, RewardOutput]:
    """The checked output of each part, under its name; repeated names get a number."""
    outputs: dict[str, RewardOutput] = {}
    for part in parts:
        name = label = reward_name(part)
        number = 1
        while label in outputs:
            number += 1
            label = f"{name}_{number}"
        outputs[label] = evaluate_reward(part, batch, context, strict=True)
    return outputs


def _combine(value: Tensor, outputs: Mapping[str, RewardOutput], per_object: Tensor | None = None) -> RewardOutput:
    terms: dict[str, Tensor] = {}
    flags: dict[str, Tensor] = {}
    for label, output in outputs.items():
        terms[label] = output.value
        terms.update({f"{label}.{name}": term for name, term in output.terms.items()})
        for name, flag in output.object_flags.items():
            flags[name if name not in flags else f"{label}.{name}"] = flag
    valid = torch.stack([output.is_valid for output in outputs.values()]).all(dim=0)
    return RewardOutput(value, per_object, terms, valid, flags)
