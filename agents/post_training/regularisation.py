"""Regularisation of a run: its loss, its weight, and the factor on the weight that holds a target."""

from __future__ import annotations

import logging
from copy import deepcopy
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.networks.text import Text
from agents.post_training.algorithms.base import SceneLoss, add_regularisation_gradient
from agents.post_training.real_scenes import PromptedScenes
from agents.post_training.settings import (
    FAR,
    HIGHEST,
    SHARPNESS,
    HoldState,
    RegularisationSettings,
    adjust,
    relative_error,
)
from agents.priors.prior import NoisedScenes, ScenePrior


@dataclass(frozen=True)
class DiscriminativeLoss:
    """Direct discriminative optimisation (Zheng et al. 2025, arXiv 2503.01103) of a diffusion prior.

    The log-likelihood ratio of the prior and its base is the logit of a discriminator of real scenes and samples of the
    base prior, which is trained with the logistic loss. The odds of the best discriminator are the density of real
    scenes divided by that of base samples, so the best prior has the density of real scenes. The pretraining loss l of
    a noised scene takes the place of -log p. With the gap d = l(base) - l(prior), the losses are

        (2 / s) softplus(-s d) of real scenes,    (2 / s) softplus(s d) of base samples

    At the base prior, their gradients are those of l and of -l. The gradient of a real scene vanishes where s d is
    large, and that of a base sample where -s d is large. So no sample repels without bound. Where base samples are like
    real scenes, the two gradients cancel in the mean.

    Attributes:
        prior: prior in training.
        base: base prior, with which the prior is compared; its weights get no gradient.
        sharpness: factor s, per unit of the pretraining loss; near 0 the loss of base samples has no bound.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> noised = prior.noised(prior.encode(prior.sample(2, num_steps=3)))
    >>> loss = DiscriminativeLoss(prior, prior, sharpness=20.0)
    >>> [round(value, 4) for value in loss.of_base(noised).tolist()]  # (2 / s) log 2
    [0.0693, 0.0693]
    """

    prior: ScenePrior
    base: ScenePrior
    sharpness: float

    def of_real(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) losses of noised real scenes."""
        return F.softplus(-self.sharpness * self.gap(noised, text)) * (2 / self.sharpness)

    def of_base(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) losses of noised samples of the base prior."""
        return F.softplus(self.sharpness * self.gap(noised, text)) * (2 / self.sharpness)

    def gap(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) pretraining losses of the base prior minus those of the prior in training."""
        with torch.no_grad():
            base = self.base.noised_loss(noised, text)
        return base - self.prior.noised_loss(noised, text)


logger = logging.getLogger(__name__)


class Regularisation:
    """The loss that keeps a prior in training near real scenes, and its weight.

    Args:
        settings: settings of the regularisation.
        prior: the base prior; it is copied if it is needed.
    """

    def __init__(self, settings: RegularisationSettings, prior: ScenePrior) -> None:
        self.settings = settings
        self.target = settings.target
        self.state = HoldState()
        compares = settings.objective == "discriminative"
        self.base = deepcopy(prior).eval().requires_grad_(False) if compares else None

    @property
    def weight(self) -> float:
        """Coefficient of the pretraining loss on real scenes."""
        return self.settings.pretraining_weight * self.state.factor

    def accumulate(
        self,
        prior: ScenePrior,
        real: PromptedScenes,
        base: PromptedScenes | None,
        generator: Generator,
        chunk: int | None,
    ) -> dict[str, float]:
        """Add the gradient of the loss on real scenes, and on samples of the base prior; returns columns of the log.

        Real scenes and samples get the same timesteps and noise.

        Args:
            prior: prior in training.
            real: real scenes of all processes.
            base: an equal number of samples of the base prior; None for any loss but the discriminative one.
            generator: source of timesteps and noise (CPU).
            chunk: number of scenes per pass.
        """

        def add(scenes: PromptedScenes, generator: Generator, loss: SceneLoss | None) -> tuple[float, float]:
            return add_regularisation_gradient(
                prior, scenes.scenes, self.weight, generator, loss=loss, chunk=chunk, prompts=scenes.prompts
            )

        held = {} if self.target is None else {"regularisation_weight": self.weight, "hold_factor": self.state.factor}
        if base is None or self.base is None:
            value, norm = add(real, generator, None)
            return {"pretraining_loss": value, "pretraining_gradient_norm": norm, **held}
        loss = DiscriminativeLoss(prior, self.base, SHARPNESS)
        same = Generator().set_state(generator.get_state())
        value, norm = add(real, generator, loss.of_real)
        base_value, base_norm = add(base, same, loss.of_base)
        return {
            "pretraining_loss": value,
            "pretraining_gradient_norm": norm,
            "base_sample_loss": base_value,
            "base_sample_gradient_norm": base_norm,
            **held,
        }

    def observe(self, ratio: float, iteration: int) -> None:
        """Adjust the weight after a check of the guard, whose held-out loss is ``ratio`` times the base prior's."""
        if self.target is None:
            return
        held = self.state.lost_at is None
        self.state = adjust(self.state, self.target, ratio, iteration)
        if held and self.state.lost_at is not None:
            logger.warning("%s", self.verdict())

    def return_to_checkpoint(self, ratio: float) -> None:
        """Keep the weight, and forget how the held-out loss changed before a return to an earlier checkpoint.

        Args:
            ratio: held-out loss of this checkpoint, as a ratio to the base prior's.
        """
        self.state = self.state.returned(ratio)

    def verdict(self) -> str:
        """One sentence that says whether the target was held; empty without a target."""
        state, settings = self.state, self.settings
        if self.target is None or state.measured is None:
            return ""
        if state.lost_at is None and relative_error(self.target, state.measured) > FAR:
            return (
                f"hold={settings.hold} was not held at the end: guard {state.measured:.4g} at the last measurement, "
                f"when the weight of the regularisation was {state.factor:.3g} times the first one and still rising; "
                "measure more often (guard.every), raise the weight, or lower optimizer.lr"
            )
        if state.lost_at is None:
            return f"hold={settings.hold} was held: guard {state.measured:.4g} at the last measurement."
        return (
            f"hold={settings.hold} could not be held: at iteration {state.lost_at} the weight of the regularisation "
            f"was at its bound, {HIGHEST:g} times the first one, and the held-out loss was still above the target "
            f"({state.measured:.4g} at the last measurement); lower optimizer.lr, raise the weight, or allow more"
        )

    def summary(self) -> dict[str, Any] | None:
        """Values for the metrics; None without a target."""
        if self.target is None:
            return None
        return {
            "target": self.settings.hold,
            "measured": self.state.measured,
            "weight": self.weight,
            "not_held_from": self.state.lost_at,
            "verdict": self.verdict(),
        }

    def state_dict(self) -> dict[str, Any]:
        """State for a checkpoint."""
        return asdict(self.state)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self.state = HoldState(**state)
