"""Residual error of a denoiser by noise level: the variance that few-step chains add (Bao et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class ResidualVariance:
    """Mean squared error of the denoised scene, E (x_0 - x_0_hat(x_t))^2, per noise level and feature.

    A chain that replaces x_0 by its estimate loses this much variance; with 25 strides of an exact denoiser of Gaussian
    data, a fifth of the standard deviation. Adding it back gives the optimal reverse variance of Bao et al.
    (Analytic-DPM, 2022), Theorem 1, here per feature.

    Attributes:
        timesteps: (G,) int64, the measured timesteps, increasing.
        variance: (G, D) float32, mean squared errors at these timesteps.

    >>> residual = ResidualVariance(torch.tensor([1, 3]), torch.tensor([[1.0], [4.0]]))
    >>> residual.at(2)
    tensor([2.])
    """

    timesteps: Tensor
    variance: Tensor

    def at(self, t: int) -> Tensor:
        """(D,) error at timestep ``t``, interpolated geometrically between the measured levels."""
        upper = int(torch.searchsorted(self.timesteps, t).clamp(max=len(self.timesteps) - 1))
        lower = max(0, upper - 1)
        span = int(self.timesteps[upper] - self.timesteps[lower])
        weight = 0.0 if span == 0 else (t - int(self.timesteps[lower])) / span
        log_variance = self.variance.clamp(min=1e-12).log()
        return torch.lerp(log_variance[lower], log_variance[upper], min(1.0, max(0.0, weight))).exp()
