"""Recorder of half-denoised scenes at given steps of the denoising, the stops."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch


class Branches:
    """Records scenes at the stops of their denoising, with the values of their expected final scenes.

    A stop is a share of the denoising steps. The denoising begins at noise, or at a stop with given scenes. Only the
    later stops are recorded.

    Args:
        stops: shares of the denoising steps, increasing, each in (0, 1).
        begin: index of the stop at which the scenes begin; -1 for noise.
        x: (B, N, D) scenes at that stop; None for noise.
        values: function from scenes to their values Φ (B,).
    """

    def __init__(
        self, stops: Sequence[float], begin: int, x: Tensor | None, values: Callable[[SceneBatch], Tensor]
    ) -> None:
        self.stops, self.first, self.x, self.values = stops, begin, x, values
        self.places: list[Tensor] = []
        self.promises: list[Tensor] = []

    def first_step(self, steps: int) -> int:
        """The step at which the scenes begin."""
        return 0 if self.first < 0 else self.at(steps)[self.first]

    def at(self, steps: int) -> list[int]:
        """The step of every stop."""
        return [int(stop * steps) for stop in self.stops]

    def start(self, steps: int) -> tuple[int, Tensor] | None:
        """The step and the scenes that denoising begins with; None for noise."""
        return None if self.x is None else (self.first_step(steps), self.x)

    def see(self, step: int, steps: int, x: Tensor) -> None:
        """Record the scenes x_t (B, N, D) if ``step`` is a later stop."""
        if step in self.at(steps)[self.first + 1 :]:
            self.places.append(x.cpu())

    def __call__(self, step: int, steps: int, denoised: Callable[[], SceneBatch]) -> None:
        """Record the values Φ of the expected final scenes if ``step`` is a later stop."""
        if step in self.at(steps)[self.first + 1 :]:
            self.promises.append(self.values(denoised()))

    def trace(self, row: int) -> Mapping[str, Tensor]:
        """The recorded stops of scene ``row``.

        Its states are ``x`` (M, N, D), and the values Φ of its expected final scenes are ``promises`` (M,).
        """
        if not self.places:
            return {}
        return {
            "x": torch.stack([x[row] for x in self.places]).clone(),
            "promises": torch.stack([values[row] for values in self.promises]),
        }
