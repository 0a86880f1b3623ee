"""Averages of weights over training, for evaluation and for saving."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

Module = TypeVar("Module", bound=nn.Module)


class WeightAverage:
    """Exponential moving average of a module's parameters. After ``warm_up`` updates the decay is one half, unless the
    final ``decay`` is less; with 0 it is final from the first on.

    >>> layer = nn.Linear(1, 1)
    >>> average = WeightAverage(layer, decay=0.5)
    >>> _ = average.update(layer)
    >>> bool((average.tensors["weight"] == layer.weight).all())
    True
    """

    def __init__(self, module: nn.Module, decay: float, warm_up: float = 10.0) -> None:
        self.decay = decay
        self.warm_up = warm_up
        self.updates = 0
        self.tensors = {name: p.detach().clone() for name, p in module.named_parameters()}

    @torch.no_grad()
    def update(self, module: nn.Module) -> float:
        """Move the averages towards ``module``; returns the decay of this update."""
        self.updates += 1
        decay = min(self.decay, self.updates / (self.updates + self.warm_up))
        named = dict(module.named_parameters())
        get_ema_multi_avg_fn(decay)([self.tensors[name] for name in named], list(named.values()), self.updates)
        return decay

    @torch.no_grad()
    def restore(self, tensors: Mapping[str, Tensor], updates: int) -> None:
        """Take the averages of a checkpoint, and the number of ``updates`` that made them."""
        for name, present in self.tensors.items():
            present.copy_(tensors[name])
        self.updates = updates

    @torch.no_grad()
    def copy_to(self, module: nn.Module) -> None:
        """Write the averages into ``module``."""
        for name, parameter in module.named_parameters():
            parameter.copy_(self.tensors[name])


@contextmanager
def averaged_weights(module: Module, average: WeightAverage | None) -> Iterator[Module]:
    """Context in which ``module`` has its averaged weights, if there is an ``average``; then it gets its own back."""
    if average is None:
        yield module
        return
    own = WeightAverage(module, 0.0)
    average.copy_to(module)
    try:
        yield module
    finally:
        own.copy_to(module)
