"""Averages of weights over training, which are what is evaluated and saved."""

from __future__ import annotations

import torch
from torch import nn


class WeightAverage:
    """Exponential moving average of a module's parameters, with a warm-up of the decay.

    >>> layer = nn.Linear(1, 1)
    >>> average = WeightAverage(layer, decay=0.5)
    >>> _ = average.update(layer)
    >>> bool((average.tensors["weight"] == layer.weight).all())
    True
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.decay = decay
        self.updates = 0
        self.tensors = {name: p.detach().clone() for name, p in module.named_parameters()}

    @torch.no_grad()
    def update(self, module: nn.Module) -> float:
        """Move towards ``module``; returns the decay that was used."""
        self.updates += 1
        decay = min(self.decay, self.updates / (self.updates + 10.0))
        for name, parameter in module.named_parameters():
            self.tensors[name].lerp_(parameter, 1.0 - decay)
        return decay

    @torch.no_grad()
    def copy_to(self, module: nn.Module) -> None:
        """Write the averages into ``module``."""
        for name, parameter in module.named_parameters():
            parameter.copy_(self.tensors[name])


class Averaged:
    """Context in which a network holds its averaged weights."""

    def __init__(self, network: nn.Module, average: WeightAverage) -> None:
        self.network, self.average = network, average

    def __enter__(self) -> None:
        self.saved = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        self.average.copy_to(self.network)

    def __exit__(self, *_: object) -> None:
        with torch.no_grad():
            for name, parameter in self.network.named_parameters():
                parameter.copy_(self.saved[name])
