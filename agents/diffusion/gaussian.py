"""The Gaussian diffusion process: forward noising, preconditioning, reverse posterior, training loss."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from agents.diffusion.moments import Preconditioning
from agents.diffusion.residual import ResidualVariance
from agents.diffusion.schedules import NoiseSchedule
from scene_envs.errors import InvalidInputError, unknown_name

Moments = tuple[Tensor, Tensor]
"""Mean and standard deviation."""

PREDICTIONS = ("edm", "epsilon", "x0", "v")
"""Targets that a network may predict; see :meth:`GaussianProcess.x0_from_output`."""


def check_prediction(name: str) -> None:
    """Raise when ``name`` is not a prediction.

    Raises:
        UnknownNameError: there is no such prediction.

    >>> check_prediction("edm")
    """
    if name not in PREDICTIONS:
        raise unknown_name("prediction", name, PREDICTIONS)


class GaussianProcess:
    """Variance-preserving Gaussian diffusion, x_t = alpha_t x_0 + sigma_t eps with alpha_t^2 + sigma_t^2 = 1.

    Args:
        schedule: signal rates for t = 0..T.
        prediction: parameterisation of the network's output (one of :data:`PREDICTIONS`).
        preconditioning: data moments, used by ``"edm"``.

    All timesteps ``t`` are int64 tensors of shape (B,) or (); chains run in float32.
    """

    def __init__(self, schedule: NoiseSchedule, prediction: str, preconditioning: Preconditioning) -> None:
        check_prediction(prediction)
        self.schedule = schedule
        self.prediction = prediction
        self.preconditioning = preconditioning
        self.alpha = schedule.alpha_bar.sqrt().float()  # (T + 1,)
        self.sigma = (1.0 - schedule.alpha_bar).sqrt().float()  # (T + 1,)

    # -- forward --------------------------------------------------------------------------------

    def rates(self, t: Tensor, like: Tensor) -> tuple[Tensor, Tensor]:
        """alpha_t and sigma_t, shaped to broadcast against ``like`` (B, N, D)."""
        alpha, sigma = self.alpha.to(like.device)[t], self.sigma.to(like.device)[t]
        while alpha.ndim < like.ndim and alpha.ndim > 0:
            alpha, sigma = alpha.unsqueeze(-1), sigma.unsqueeze(-1)
        return alpha, sigma

    def add_noise(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """A sample of q(x_t | x_0) (Ho et al. 2020, Eq. 4)."""
        alpha, sigma = self.rates(t, x0)
        return alpha * x0 + sigma * noise

    def renoise(self, x_s: Tensor, s: int, t: int, noise: Tensor) -> Tensor:
        """A sample of q(x_t | x_s), s < t: adds noise to go back from s to t."""
        ratio = self.schedule.alpha_bar[t] / self.schedule.alpha_bar[s]
        return float(ratio.sqrt()) * x_s + float((1.0 - ratio).sqrt()) * noise

    # -- input and output of the network --------------------------------------------------------

    def network_input(self, x_t: Tensor, t: Tensor) -> Tensor:
        """x_t scaled to unit variance per feature for ``edm`` (Karras et al. 2022, c_in); x_t itself otherwise."""
        if self.prediction != "edm":
            return x_t
        alpha, sigma = self.rates(t, x_t)
        mean, std = self._moments(x_t, None)
        return (x_t - alpha * mean) / (alpha**2 * std**2 + sigma**2).sqrt()

    def x0_from_output(self, x_t: Tensor, t: Tensor, output: Tensor, moments: Moments | None = None) -> Tensor:
        """The denoised scene x_0 that follows from a network output.

        ``edm``: skip and output scaling of Karras et al. (2022), Table 1, in variance-preserving
        coordinates and with per-feature moments; ``epsilon``: predicted noise; ``v``: Salimans and Ho (2022).

        ``moments``, here and in :meth:`target`, are mean and std that broadcast against ``x_t`` and scale the output.
        None takes those of all data. The input is always scaled by those of all data, because positions must stay
        comparable.
        """
        alpha, sigma = self.rates(t, x_t)
        if self.prediction == "edm":
            mean, std = self._moments(x_t, moments)
            variance = alpha**2 * std**2 + sigma**2
            skip = alpha * std**2 / variance
            return mean + skip * (x_t - alpha * mean) + sigma * std / variance.sqrt() * output
        if self.prediction == "epsilon":
            return (x_t - sigma * output) / alpha
        if self.prediction == "v":
            return alpha * x_t - sigma * output
        return output

    def target(self, x0: Tensor, x_t: Tensor, t: Tensor, noise: Tensor, moments: Moments | None = None) -> Tensor:
        """The regression target whose plain mean square is the training loss."""
        alpha, sigma = self.rates(t, x0)
        if self.prediction == "edm":
            mean, std = self._moments(x0, moments)
            variance = alpha**2 * std**2 + sigma**2
            skip = alpha * std**2 / variance
            residual = x0 - mean - skip * (x_t - alpha * mean)
            return residual * variance.sqrt() / (sigma * std)
        if self.prediction == "epsilon":
            return noise
        if self.prediction == "v":
            return alpha * noise - sigma * x0
        return x0

    # -- reverse --------------------------------------------------------------------------------

    def check_stride(self, t: int, previous: int) -> None:
        """Raise InvalidInputError unless 0 <= s < t <= T."""
        if not 0 <= previous < t <= self.schedule.num_timesteps:
            raise InvalidInputError(
                f"the step {t} -> {previous} is not a stride down within 0..{self.schedule.num_timesteps}, "
                "the timesteps of the schedule"
            )

    def posterior(
        self, x_t: Tensor, x0: Tensor, t: int, previous: int, residual: Tensor | None = None, eta: float = 1.0
    ) -> tuple[Tensor, Tensor]:
        """p(x_s | x_t) for a stride t -> s, given the denoised scene (Song et al. 2021, Eqs. 12 and 16, any s < t).

        With ``eta`` 1 these are Eqs. 6-7 of Ho et al. (2020), with 0 the deterministic chain of DDIM.

        Args:
            x_t: (B, N, D).
            x0: (B, N, D) denoised scene.
            t: first timestep of the stride.
            previous: last timestep s of the stride.
            residual: (D,) or () expected squared error of ``x0``; None takes ``x0`` as exact (Ho et al.). With
                ``residual``, the variance at ``eta`` 1 is the optimal one of Bao et al. (2022), Theorem 1. The variance
                that the error adds is scaled by the square of ``eta``, so that the chain at ``eta`` 0 stays
                deterministic.
            eta: noise of the chain, 0..1.

        Returns:
            mean (B, N, D) and std, () or (D,); 0 when ``previous`` or ``eta`` is 0.

        Raises:
            InvalidInputError: ``eta`` is outside 0..1, or the stride is not within 0..T.
        """
        if not 0.0 <= eta <= 1.0:
            raise InvalidInputError(f"eta={eta} is outside 0..1: 1 is the ancestral chain, 0 the deterministic one")
        self.check_stride(t, previous)
        alpha_bar = self.schedule.alpha_bar
        a_t, a_s = alpha_bar[t], alpha_bar[previous]
        variance = eta**2 * (1.0 - a_s) / (1.0 - a_t) * (1.0 - a_t / a_s)
        xt_weight = float(((1.0 - a_s - variance).clamp(min=0.0) / (1.0 - a_t)).sqrt())
        x0_weight = float(a_s.sqrt() - a_t.sqrt() * xt_weight)
        if residual is not None and previous > 0:
            variance = variance + (eta * x0_weight) ** 2 * residual.double().cpu()
        return x0_weight * x0 + xt_weight * x_t, variance.sqrt().float().to(x_t.device)

    def estimate(self, t: int, previous: int, residual: ResidualVariance | None = None) -> tuple[float, Tensor]:
        """Weight of the denoised scene in the mean of x_s, s < t, and standard deviation (D,) of its error.

        The deviation is the square root of ``residual``. None takes the deviation for normal data with the moments of
        ``preconditioning``.
        """
        alpha, sigma = self.alpha[t], self.sigma[t]
        if residual is None:
            std = self.preconditioning.std
            variance = (sigma * std) ** 2 / ((alpha * std) ** 2 + sigma**2)
        else:
            variance = residual.at(t)
        weight, _ = self.posterior(torch.zeros(()), torch.ones(()), t, previous)
        return float(weight), variance.sqrt()

    def _moments(self, like: Tensor, moments: Moments | None) -> Moments:
        if moments is not None:
            return moments
        return self.preconditioning.mean.to(like), self.preconditioning.std.to(like)


TIMESTEP_DISTRIBUTIONS = ("lognormal", "uniform", "both")
"""Distributions of training timesteps: lognormal in the noise-to-signal ratio, uniform, or half of each."""


def timestep_weights(distribution: str, schedule: NoiseSchedule, mean: float, std: float) -> Tensor:
    """(T + 1,) probabilities of drawing each timestep in training; ``mean`` and ``std`` are those of the lognormal."""
    if distribution not in TIMESTEP_DISTRIBUTIONS:
        raise unknown_name("distribution of timesteps", distribution, TIMESTEP_DISTRIBUTIONS)
    if distribution == "lognormal":
        return lognormal_timesteps(schedule, mean, std)
    weight = torch.full((schedule.num_timesteps + 1,), 1.0 / schedule.num_timesteps, dtype=torch.float64)
    weight[0] = 0.0
    return weight if distribution == "uniform" else 0.5 * (weight + lognormal_timesteps(schedule, mean, std))


def lognormal_timesteps(schedule: NoiseSchedule, mean: float, std: float) -> Tensor:
    """(T + 1,) probabilities of drawing each timestep so that ln(noise-to-signal) ~ N(mean, std^2).

    The distribution of Karras et al. (2022), Table 1, carried to a discrete schedule: the density at each level
    times the width of the level. t = 0 has probability 0.
    """
    log_sigma = schedule.noise_to_signal[1:].log()
    width = torch.gradient(log_sigma)[0]
    weight = torch.exp(-0.5 * ((log_sigma - mean) / std) ** 2) * width
    total = float(weight.sum())
    if not 0 < total < math.inf:
        raise InvalidInputError(
            f"noise levels with ln(noise-to-signal) of mean {mean:g} and standard deviation {std:g} lie outside the "
            f"schedule, whose levels are {float(log_sigma.min()):.3g} to {float(log_sigma.max()):.3g}"
        )
    return torch.cat([torch.zeros(1, dtype=weight.dtype), weight / total])
