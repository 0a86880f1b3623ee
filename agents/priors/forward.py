"""Forward-process view of a prior: noised scenes, the targets of its denoiser, and the denoiser's output."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor

from agents.networks.mixed_denoiser import Observed


@dataclass(frozen=True)
class NoisedScenes:
    """B scenes of N slots at timesteps of the forward process, with the training targets of the denoiser.

    Attributes:
        x_t: (B, N, D) noised scenes; observed and known entries carry no noise.
        t: (B,) int64 timesteps.
        target: (B, N, F) of the continuous output; F is 12 (poses) for a mixed prior and D for a continuous one.
        weight: (B, N, F) weights of its squared errors; 0 on known and on observed entries.
        scale: (B,) weight of the timestep in the loss.
        category: (B, N) int64, the clean categories.
        drawn: (B, N) weights of the category losses, 0 where the category is seen; None for a continuous prior.
        observed: entries that the denoiser sees without noise; None where there are none.
    """

    x_t: Tensor
    t: Tensor
    target: Tensor
    weight: Tensor
    scale: Tensor
    category: Tensor
    drawn: Tensor | None = None
    observed: Observed | None = None

    def rows(self, rows: slice) -> NoisedScenes:
        """Some of the scenes."""
        named = ("x_t", "t", "target", "weight", "scale", "category")
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in named},
            drawn=None if self.drawn is None else self.drawn[rows],
            observed=None if self.observed is None else self.observed.rows(rows),
        )


@dataclass(frozen=True)
class DenoiserOutput:
    """Output of the denoiser for noised scenes.

    Attributes:
        continuous: (B, N, F), in the units of :attr:`NoisedScenes.target`.
        logits: (B, N, K) of the clean categories; None for a continuous prior.
    """

    continuous: Tensor
    logits: Tensor | None = None
