"""Forward-process view of a prior: noised scenes, the targets and the output of its denoiser, and the training loss."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor

from agents.diffusion import GaussianProcess, ResidualVariance
from agents.networks.mixed_denoiser import Observed
from agents.networks.text import Text
from scene_envs.scene import POSE_FEATURES, TRANSLATION


@dataclass(frozen=True)
class NoisedScenes:
    """B scenes of N slots at timesteps of the forward process, with the training targets of the denoiser.

    Attributes:
        x_t: (B, N, D) noised scenes; known entries carry no noise, nor do observed ones of a mixed prior.
        t: (B,) int64 timesteps.
        target: (B, N, F) of the continuous output; F is 12 (poses) for a mixed prior and D for a continuous one.
        weight: (B, N, F) weights of its squared errors; 0 on known and on observed entries.
        scale: (B,) weight of the timestep in the loss.
        category: (B, N) int64, the clean categories.
        drawn: (B, N) weights of the category losses, 0 where the category is seen; None for a continuous prior.
        observed: entries that are observed; None where there are none.
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


class Trainable(ABC):
    """The part of a prior that noises scenes, and computes the loss of the denoiser's output for them."""

    config: Any
    """Configuration of the prior, a dataclass."""
    process: GaussianProcess
    """Gaussian process of the continuous features."""
    _timestep_weights: Tensor

    @abstractmethod
    def known(self, slots: int) -> Tensor:
        """(slots, D) bool: entries that are clamped, and so have no part in the loss."""

    def draw_timesteps(self, count: int, generator: Generator | None = None) -> Tensor:
        """(count,) int64 training timesteps, from the distribution that the configuration names."""
        return torch.multinomial(self._timestep_weights, count, replacement=True, generator=generator)

    def pretraining_loss(
        self,
        x0: Tensor,
        generator: Generator | None = None,
        reduction: str = "mean",
        t: Tensor | None = None,
        text: Text | None = None,
    ) -> Tensor:
        """The training loss of scenes ``x0`` (B, N, D) as :meth:`encode` gives them, on entries that are not known.

        Args:
            x0: normalised scenes.
            generator: source of timesteps and noise (CPU).
            reduction: ``"mean"`` over scenes, or ``"none"`` for (B,); always the mean over entries.
            t: (B,) timesteps, drawn when None.
            text: tokens (B, L, W) and their mask (B, L), as :meth:`encode_prompts` gives them; None without prompts.
        """
        per_scene = self.noised_loss(self.noised(x0, generator, t), text)
        return per_scene.mean() if reduction == "mean" else per_scene

    @abstractmethod
    def noised_loss(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) training losses of scenes that :meth:`noised` has noised; arguments as for :meth:`output`."""

    @abstractmethod
    def noised(self, x0: Tensor, generator: Generator | None = None, t: Tensor | None = None) -> NoisedScenes:
        """A draw of the forward process for scenes ``x0`` (B, N, D), as the pretraining loss takes it.

        Args:
            x0: normalised scenes.
            generator: source of timesteps, noise and observed entries (CPU).
            t: (B,) timesteps, drawn when None.
        """

    @abstractmethod
    def output(self, noised: NoisedScenes, text: Text | None = None) -> DenoiserOutput:
        """Output of the denoiser for noised scenes; differentiable in its parameters.

        Args:
            noised: as :meth:`noised` gives them.
            text: tokens (B, L, W) and their mask (B, L), as :meth:`encode_prompts` gives them; None without prompts.
        """

    def denoised(self, noised: NoisedScenes, output: DenoiserOutput) -> Tensor:
        """(B, N, F) estimate of x_0 from the continuous ``output`` of noised scenes."""
        features = output.continuous.shape[-1]
        return self.process.x0_from_output(noised.x_t[..., :features], noised.t, output.continuous)

    def observed_entries(self, x: Tensor, observed: Observed | None = None) -> Observed | None:
        """Observed entries of scenes ``x`` (B, N, D), without noise, as the network reads them; None for none."""
        return observed

    @property
    def pose_width(self) -> int:
        """Leading features of the continuous output that are poses; the others, if any, are categories."""
        return POSE_FEATURES

    @abstractmethod
    def fit_residual(self, x0: Tensor, levels: int = 40, seed: int = 0) -> ResidualVariance:
        """Measure the denoiser's error on normalised scenes ``x0`` (B, N, D) at ``levels`` timesteps, and keep it."""

    def loss_weight(self, slots: int) -> Tensor:
        """(slots, D) weights of the pretraining loss; 0 on known entries."""
        weight = (~self.known(slots)).float()
        weight[:, TRANSLATION] *= self.config.translation_weight
        return weight
