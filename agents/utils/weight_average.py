"""Averages of weights over training, for evaluation and for saving."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Generic, TypeVar

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
    def restore(self, tensors: Mapping[str, Tensor], updates: int | None = None) -> None:
        """Take the averages of a checkpoint, and the number of ``updates`` that made them, if it is given."""
        for name, present in self.tensors.items():
            present.copy_(tensors[name])
        self.updates = self.updates if updates is None else updates

    @torch.no_grad()
    def copy_to(self, module: nn.Module) -> None:
        """Write the averages into ``module``."""
        for name, parameter in module.named_parameters():
            parameter.copy_(self.tensors[name])


class AveragedWeights(Generic[Module]):
    """Context in which a module has its averaged weights, if there is an ``average``; then it gets its own back."""

    def __init__(self, module: Module, average: WeightAverage | None) -> None:
        self.module, self.average = module, average
        self._own: dict[str, Tensor] = {}

    def __enter__(self) -> Module:
        if self.average is not None:
            self._own = {name: p.detach().clone() for name, p in self.module.named_parameters()}
            self.average.copy_to(self.module)
        return self.module

    def __exit__(self, *_: object) -> None:
        with torch.no_grad():
            for name, parameter in self.module.named_parameters():
                if name in self._own:
                    parameter.copy_(self._own[name])
