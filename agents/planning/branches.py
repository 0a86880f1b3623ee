"""Scenes that are denoised from a stop on the way, and kept at later stops."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch


class Branches:
    """Denoises scenes from a stop on the way, and keeps each at the later stops with the value it promises there.

    Args:
        stops: shares of the denoising steps, increasing, each in (0, 1).
        begin: the stop that the scenes begin at; -1 for noise.
        x: (B, N, D) the scenes there; None for noise.
        values: Φ (B,) of scenes.
    """

    def __init__(
        self, stops: Sequence[float], begin: int, x: Tensor | None, values: Callable[[SceneBatch], Tensor]
    ) -> None:
        self.stops, self.first, self.x, self.values = stops, begin, x, values
        self.places: list[Tensor] = []
        self.promises: list[Tensor] = []

    def first_step(self, steps: int) -> int:
        """The step that the scenes begin at."""
        return 0 if self.first < 0 else self.at(steps)[self.first]

    def at(self, steps: int) -> list[int]:
        """The step of every stop."""
        return [int(stop * steps) for stop in self.stops]

    def start(self, steps: int) -> tuple[int, Tensor] | None:
        """The step and the scenes that denoising begins with; None for noise."""
        return None if self.x is None else (self.first_step(steps), self.x)

    def see(self, step: int, steps: int, x: Tensor) -> None:
        """Keep the scenes x_t (B, N, D) at a later stop."""
        if step in self.at(steps)[self.first + 1 :]:
            self.places.append(x.cpu())

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch]) -> None:
        """Score what the scenes promise at a later stop."""
        if step in self.at(steps)[self.first + 1 :]:
            self.promises.append(self.values(denoised()))

    def trace(self, row: int) -> Mapping[str, Tensor]:
        """The stops of one scene: ``x`` (M, N, D), and ``promises`` (M,)."""
        if not self.places:
            return {}
        return {
            "x": torch.stack([x[row] for x in self.places]).clone(),
            "promises": torch.stack([values[row] for values in self.promises]),
        }
