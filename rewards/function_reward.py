"""Bare functions as rewards."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from rewards.base import RewardContext, RewardOutput, averages_objects, counts_objects, depends_on_batch
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


class FunctionReward:
    """A bare function as a reward.

    Args:
        function: function of ``(batch)`` or ``(batch, context)`` and keyword settings, which returns (B,) numbers or a
            :class:`RewardOutput`.
        name: name of the reward in logs; the function's own by default.
        **settings: keyword arguments of every call.

    >>> FunctionReward(lambda batch: batch.counts, name="count")(SceneBatch.empty("dimsum_table", 2), RewardContext())
    RewardOutput(value=tensor([1., 1.]), per_object=None, terms={}, valid=None, object_flags={}, problem='')
    """

    def __init__(self, function: Callable[..., Any], name: str | None = None, **settings: Any) -> None:
        self.function = function
        self.name = str(name or getattr(function, "__name__", type(function).__name__))
        self.settings = settings
        self.maximum = getattr(function, "maximum", None)
        self.depends_on_batch, self.averages_objects = depends_on_batch(function), averages_objects(function)
        self.counts_objects = counts_objects(function)
        self._takes_context = _accepts(function, 2, settings, self.name)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        arguments = (batch, context) if self._takes_context else (batch,)
        return as_output(self.function(*arguments, **self.settings))

    def __repr__(self) -> str:
        return f"FunctionReward({self.name!r})"


def as_output(result: Any) -> Any:
    """A bare tensor as a RewardOutput, whole numbers as floats; anything else as it is."""
    if not isinstance(result, Tensor):
        return result
    is_whole = not result.is_floating_point() and not result.is_complex()
    return RewardOutput(result.to(torch.float32) if is_whole else result)


def _accepts(function: Callable[..., Any], count: int, settings: Mapping[str, Any], name: str) -> bool:
    """Whether ``function`` takes ``count`` positional arguments and ``settings``; if not, it must take one fewer."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True
    for number in (count, count - 1):
        try:
            signature.bind(*[None] * number, **settings)
        except TypeError:
            continue
        return number == count
    raise InvalidInputError(
        f"reward {name!r} has the signature {signature} and was given the settings {sorted(settings)}; "
        "it must take (batch) or (batch, context), and its settings as keywords"
    )
