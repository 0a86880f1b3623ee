"""Discriminative loss, which raises the likelihood of real scenes and lowers that of samples of the base prior."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from agents.networks.text import Text
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
