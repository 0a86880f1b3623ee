"""Gaussian diffusion: noise schedules, preconditioning, the process, step tables, and weights of the loss."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import torch
from torch import Tensor

from agents.diffusion.categorical import CategoricalProcess, fitted
from scene_envs.arrays import constant_on
from scene_envs.errors import InvalidInputError, unknown_name

SCHEDULES = ("karras", "linear")
PREDICTIONS = ("edm", "epsilon", "x0", "v")
"""Targets that a network may predict; see :meth:`GaussianProcess.x0_from_output`."""
TIMESTEP_DISTRIBUTIONS = ("lognormal", "uniform", "both")
"""Distributions of training timesteps: lognormal in the noise-to-signal ratio, uniform, or half of each."""
LOSS_WEIGHTINGS = ("none", "min_snr")
"""Weightings of the squared error by timestep; see :func:`loss_weights`."""
MIN_SNR_GAMMA = 5.0
"""Gamma of Hang et al. (2023), section 3.4: the largest signal-to-noise ratio in the weight."""

Moments = tuple[Tensor, Tensor]
"""Mean and standard deviation."""

_MIN_SLOTS = 20
"""Smallest number of slots of a category from which its own moments are taken."""


@dataclass(frozen=True)
class CategoryMoments:
    """Moments of normalised poses, category by category; the last of the K categories is *empty*."""

    share: Tensor  # (K,) frequency of each category among slots; sums to 1
    mean: Tensor  # (K, D)
    std: Tensor  # (K, D), floored away from zero

    @classmethod
    def fit(cls, poses: Tensor, categories: Tensor, count: int, floor: float = 1e-4) -> CategoryMoments:
        """Moments of poses (M, D) whose categories are (M,) in 0..``count`` - 1. A category with fewer than 20 slots
        takes those of all objects, because too small a standard deviation makes the targets of poses far from the mean
        very large. *Empty* has the mean of all objects and the standard deviation ``floor``.
        """
        poses = poses.double()
        object_poses = poses[categories != count - 1]
        mean, std = object_poses.mean(dim=0).repeat(count, 1), object_poses.std(dim=0).repeat(count, 1)
        std[-1] = 0.0
        for category in range(count - 1):
            own = poses[categories == category]
            if len(own) >= _MIN_SLOTS:
                mean[category], std[category] = own.mean(dim=0), own.std(dim=0)
        share = torch.bincount(categories, minlength=count).double() + 1e-3
        return cls((share / share.sum()).float(), mean.float(), std.clamp(min=floor).float())

    def given_state(self, process: CategoricalProcess) -> tuple[Tensor, Tensor]:
        """E[x_0 | state at t] and its standard deviation, (T + 1, K + 1, D) each, K being the mask token. A state may
        be wrong where the kernel replaces categories, so both follow from the laws of total expectation and variance
        over the clean category, whose posterior follows from ``share`` by Bayes' rule.
        """
        categories = torch.arange(process.categories)
        steps = process.schedule.num_timesteps + 1
        levels = torch.arange(steps).repeat_interleave(process.categories)
        likelihood = process.marginal(categories.repeat(steps), levels).view(steps, process.categories, -1)
        joint = self.share.double()[:, None] * likelihood.double()  # (T + 1, K, K + 1)
        total = joint.sum(dim=1, keepdim=True)
        prior = self.share.double()[:, None].expand_as(joint)
        clean = torch.where(total > 1e-12, joint / total.clamp(min=1e-12), prior).transpose(1, 2)  # (T + 1, K + 1, K)
        mean = clean @ self.mean.double()
        square = clean @ (self.std.double().square() + self.mean.double().square())
        variance = (square - mean.square()).clamp(min=float(self.std.min()) ** 2)
        return mean.float(), variance.sqrt().float()


@dataclass(frozen=True)
class Preconditioning:
    """Per-feature first and second moments of normalised data.

    Attributes:
        mean: (D,) mean.
        std: (D,) standard deviation, floored away from zero.
        by_category: moments of each category; None if the process scales all categories alike.
    """

    mean: Tensor
    std: Tensor
    by_category: CategoryMoments | None = None

    @classmethod
    def fit(cls, data: Tensor, floor: float = 0.05) -> Preconditioning:
        """Moments of normalised scenes (..., D)."""
        flat = data.reshape(-1, data.shape[-1]).double()
        return cls(flat.mean(dim=0).float(), flat.std(dim=0).clamp(min=floor).float())

    def state(self) -> dict[str, Any]:
        """The moments as JSON."""
        state: dict[str, Any] = {"mean": self.mean.tolist(), "std": self.std.tolist()}
        if self.by_category is not None:
            state["by_category"] = {name: moment.tolist() for name, moment in vars(self.by_category).items()}
        return state

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Preconditioning:
        """Inverse of :meth:`state`; raises KeyError on a missing entry, ValueError where entries cannot be moments."""
        own = state.get("by_category")
        by_category = (
            None if own is None else CategoryMoments(*(torch.as_tensor(own[k]) for k in ("share", "mean", "std")))
        )
        mean, std = (torch.as_tensor(state[key], dtype=torch.float32) for key in ("mean", "std"))
        known = [mean, std, *([] if by_category is None else (by_category.share, by_category.mean, by_category.std))]
        if mean.shape != std.shape or mean.ndim != 1 or not all(bool(torch.isfinite(part).all()) for part in known):
            raise ValueError("the moments of the preconditioning must be finite numbers, one mean and std per feature")
        return cls(mean, std, by_category)


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


@dataclass(frozen=True)
class NoiseSchedule:
    """Cumulative signal rate of a variance-preserving diffusion, x_t = sqrt(a_t) x_0 + sqrt(1 - a_t) eps.

    Attributes:
        name: ``"karras"`` or ``"linear"``.
        alpha_bar: (T + 1,) float64, decreasing from 1 at t = 0.

    >>> schedule = make_schedule("karras", 1000)
    >>> round(float(schedule.noise_to_signal[1]), 4), round(float(schedule.noise_to_signal[1000]), 1)
    (0.002, 80.0)
    """

    name: str
    alpha_bar: Tensor

    @property
    def num_timesteps(self) -> int:
        """T."""
        return self.alpha_bar.shape[0] - 1

    @property
    def noise_to_signal(self) -> Tensor:
        """(T + 1,) sigma of Karras et al. (2022), sqrt((1 - a_t) / a_t)."""
        return ((1.0 - self.alpha_bar) / self.alpha_bar).sqrt()


def karras_alpha_bar(num_timesteps: int, sigma_min: float = 0.002, sigma_max: float = 80.0, rho: float = 7.0) -> Tensor:
    """(T + 1,) from noise levels spaced as in Karras et al. 2022, Eq. 5, from ``sigma_min`` at t = 1: 0.002 of the
    data's unit, five times finer than linear betas from 1e-4, as an object that stands and one that floats differ by a
    millimetre.
    """
    u = torch.linspace(0, 1, num_timesteps, dtype=torch.float64)
    low, high = sigma_min ** (1 / rho), sigma_max ** (1 / rho)
    sigma = (low + u * (high - low)) ** rho
    return torch.cat([torch.ones(1, dtype=torch.float64), 1.0 / (1.0 + sigma**2)])


def linear_alpha_bar(num_timesteps: int, beta_start: float = 1e-4, beta_end: float = 0.02) -> Tensor:
    """(T + 1,) from linearly growing betas (Ho et al. 2020, section 4; the paper's schedule)."""
    beta = torch.linspace(beta_start, beta_end, num_timesteps, dtype=torch.float64)
    return torch.cat([torch.ones(1, dtype=torch.float64), torch.cumprod(1.0 - beta, dim=0)])


def make_schedule(
    name: str, num_timesteps: int = 1000, noise_floor: float = 0.002, noise_ceiling: float = 80.0
) -> NoiseSchedule:
    """The schedule called ``name`` with ``num_timesteps`` levels; ``"karras"`` goes from floor to ceiling."""
    if name not in SCHEDULES:
        raise unknown_name("noise schedule", name, SCHEDULES)
    if num_timesteps < 2:
        raise InvalidInputError(f"a noise schedule needs at least 2 timesteps, got {num_timesteps}")
    if name == "karras":
        if not 0.0 < noise_floor < noise_ceiling:
            raise InvalidInputError(
                f"noise_floor={noise_floor:g} must be positive and below noise_ceiling={noise_ceiling:g}"
            )
        return NoiseSchedule(name, karras_alpha_bar(num_timesteps, noise_floor, noise_ceiling))
    return NoiseSchedule(name, linear_alpha_bar(num_timesteps))


def check_prediction(name: str) -> None:
    """Raise UnknownNameError unless ``name`` is one of :data:`PREDICTIONS`."""
    if name not in PREDICTIONS:
        raise unknown_name("prediction", name, PREDICTIONS)


class GaussianProcess:
    """Variance-preserving Gaussian diffusion, x_t = alpha_t x_0 + sigma_t eps with alpha_t^2 + sigma_t^2 = 1.

    Args:
        schedule: signal rates for t = 0..T.
        prediction: parameterisation of the network's output (one of :data:`PREDICTIONS`).
        preconditioning: data moments, used by ``"edm"``.

    Timesteps ``t`` are int64 tensors of shape (B,) or (), or one int for all scenes, for which the numbers of the
    timestep are computed once per device. Chains run in float32.
    """

    def __init__(self, schedule: NoiseSchedule, prediction: str, preconditioning: Preconditioning) -> None:
        check_prediction(prediction)
        self.schedule = schedule
        self.prediction = prediction
        self.preconditioning = preconditioning
        self.alpha = schedule.alpha_bar.sqrt().float()  # (T + 1,)
        self.sigma = (1.0 - schedule.alpha_bar).sqrt().float()  # (T + 1,)
        self._kept: dict[Any, tuple[Tensor, ...]] = {}

    def once(self, t: Tensor | int, like: Tensor, name: str, compute: Callable[[], tuple[Tensor, ...]]) -> Any:
        """What ``compute`` gives; for an int ``t`` it is kept under ``name`` for the device and type of ``like``."""
        if isinstance(t, Tensor):
            return compute()
        key = name, t, like.device, like.dtype
        if key not in self._kept:
            with torch.inference_mode(False), torch.no_grad():
                self._kept[key] = compute()
        return self._kept[key]

    def rates(self, t: Tensor | int, like: Tensor) -> tuple[Tensor, Tensor]:
        """alpha_t and sigma_t, shaped to broadcast against ``like`` (B, N, D)."""
        if isinstance(t, int):
            alpha, sigma = (constant_on(rate, like.device) for rate in (self.alpha, self.sigma))
            kept: tuple[Tensor, Tensor] = self.once(t, like, "rates", lambda: (alpha[t], sigma[t]))
            return kept
        alpha, sigma = constant_on(self.alpha, like.device)[t], constant_on(self.sigma, like.device)[t]
        return fitted(alpha, like), fitted(sigma, like)

    def add_noise(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """A sample of q(x_t | x_0) (Ho et al. 2020, Eq. 4)."""
        alpha, sigma = self.rates(t, x0)
        return alpha * x0 + sigma * noise

    def network_input(self, x_t: Tensor, t: Tensor | int) -> Tensor:
        """x_t scaled to unit variance per feature for ``edm`` (Karras et al. 2022, c_in); x_t itself otherwise."""
        if self.prediction != "edm":
            return x_t

        def scaling() -> tuple[Tensor, Tensor]:
            alpha, sigma = self.rates(t, x_t)
            mean, std = self._moments(x_t, None)
            return alpha * mean, (alpha**2 * std**2 + sigma**2).sqrt()

        middle, width = self.once(t, x_t, "input", scaling)
        return (x_t - middle) / width  # type: ignore[no-any-return]

    def output_scaling(self, t: Tensor | int, like: Tensor, moments: Moments | None) -> tuple[Tensor, ...]:
        """E x_0, E x_t, and the factors of x_t - E x_t and of the output in x_0, for ``edm``."""
        alpha, sigma = self.rates(t, like)
        mean, std = self._moments(like, moments)
        variance = alpha**2 * std**2 + sigma**2
        return mean, alpha * mean, alpha * std**2 / variance, sigma * std / variance.sqrt()

    def x0_from_output(
        self, x_t: Tensor, t: Tensor | int, output: Tensor, moments: Moments | None = None,
        scaling: tuple[Tensor, ...] | None = None,
    ) -> Tensor:  # fmt: skip
        """The denoised scene x_0 that follows from a network output.

        ``edm``: skip and output scaling of Karras et al. (2022), Table 1, in variance-preserving
        coordinates and with per-feature moments; ``epsilon``: predicted noise; ``v``: Salimans and Ho (2022).

        ``moments``, here and in :meth:`target`, are mean and std that broadcast against ``x_t`` and scale the output.
        None takes those of all data. The input is always scaled by those of all data, because positions must stay
        comparable. ``scaling`` are numbers of :meth:`output_scaling` that are known already.
        """
        if self.prediction == "edm":
            if scaling is None and moments is None:
                scaling = self.once(t, x_t, "output", lambda: self.output_scaling(t, x_t, None))
            mean, middle, skip, gain = self.output_scaling(t, x_t, moments) if scaling is None else scaling
            return mean + skip * (x_t - middle) + gain * output
        alpha, sigma = self.rates(t, x_t)
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
        x0_weight, xt_weight, std = self.posterior_weights(t, previous, residual, eta)
        return x0_weight * x0 + xt_weight * x_t, std.to(x_t.device)

    def posterior_weights(
        self, t: int, previous: int, residual: Tensor | None = None, eta: float = 1.0
    ) -> tuple[float, float, Tensor]:
        """Weights of x_0 and of x_t in the mean of :meth:`posterior`, and its std; arguments and errors as there."""
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
        return x0_weight, xt_weight, variance.sqrt().float()

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
        mean, std = (constant_on(x, like.device) for x in (self.preconditioning.mean, self.preconditioning.std))
        return mean.to(like.dtype), std.to(like.dtype)


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
    """(T + 1,) probabilities of drawing each timestep so that ln(noise-to-signal) ~ N(mean, std^2), 0 at t = 0: Karras
    et al. (2022), Table 1, on a discrete schedule: the density at each level times the width of the level.
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


@dataclass(frozen=True)
class StepTable:
    """Reverse steps as (t, t_prev) pairs.

    Attributes:
        timesteps: (S,) int64, strictly decreasing, within 1..T.
        previous: (S,) int64, timestep at which each step ends; the last is 0, clean data.

    >>> table = StepTable.spaced(1000, 4)
    >>> table.timesteps.tolist(), table.previous.tolist()
    ([1000, 667, 334, 1], [667, 334, 1, 0])
    """

    timesteps: Tensor
    previous: Tensor

    def __post_init__(self) -> None:
        t, previous = self.timesteps, self.previous
        chained = t.shape == previous.shape and len(t) > 0 and bool((t[1:] == previous[:-1]).all())
        if not chained or int(previous[-1]) != 0 or not bool((t > previous).all()):
            raise InvalidInputError(
                f"a step table must decrease, chain and end at 0, got {t.tolist()} -> {previous.tolist()}"
            )

    def __len__(self) -> int:
        return len(self.timesteps)

    @classmethod
    def spaced(cls, num_timesteps: int, num_steps: int) -> StepTable:
        """``num_steps`` steps evenly spaced over 1..T, both ends included; any number from 1 to T.

        The timesteps are one above those of diffusers' schedulers with ``timestep_spacing="linspace"``, which count
        from 0.

        Args:
            num_timesteps: number T of timesteps of the schedule.
            num_steps: number S of steps; need not divide T.

        Raises:
            InvalidInputError: ``num_steps`` is not a whole number in 1..T.
        """
        if not isinstance(num_steps, Integral) or isinstance(num_steps, bool):
            raise InvalidInputError(f"num_steps={num_steps!r} must be a whole number in 1..{num_timesteps}")
        if not 1 <= num_steps <= num_timesteps:
            raise InvalidInputError(f"num_steps={num_steps} is outside 1..{num_timesteps}, the prior's timesteps")
        t = torch.linspace(num_timesteps - 1, 0, num_steps, dtype=torch.float64).round().long() + 1
        return cls(t, torch.cat([t[1:], torch.zeros(1, dtype=torch.int64)]))

    @classmethod
    def gradual(cls, masked: Tensor, slots: int, num_steps: int) -> StepTable:
        """``num_steps`` steps, the first of which unmask about one slot each.

        The first k = min(num_steps // 2, num_steps - 25) steps unmask about one slot each; the rest are evenly spaced.
        Slots that are unmasked in one step are drawn independently, and the first slots determine the kind of scene.

        Args:
            masked: (T + 1,) share of masked slots at each timestep of an absorbing chain, non-decreasing.
            slots: number N of slots of a scene.
            num_steps: number S of steps, from 1 to T.

        >>> StepTable.gradual(torch.linspace(0, 1, 1001), 100, 30).timesteps[:8].tolist()
        [1000, 990, 980, 971, 961, 951, 911, 872]
        """
        num_timesteps = len(masked) - 1
        even = cls.spaced(num_timesteps, num_steps)
        single = max(0, min(num_steps // 2, num_steps - 25))
        shares = 1.0 - torch.arange(single + 1, dtype=torch.float64) / slots
        first = torch.searchsorted(masked.double().cpu(), shares.clamp(min=0.0))  # the earliest level with that share
        first = first[(first >= even.timesteps[: len(first)])].unique().flip(0)
        rest = num_steps - len(first)
        if len(first) < 2 or rest < 1 or int(first[-1]) - 1 < rest:
            return even
        later = torch.linspace(int(first[-1]), 1, rest + 1, dtype=torch.float64).round().long()[1:]
        return cls.from_timesteps([*first.tolist(), *later.tolist()], num_timesteps)

    @classmethod
    def from_timesteps(cls, timesteps: Sequence[int], num_timesteps: int | None = None) -> StepTable:
        """Table of timesteps in decreasing order; the last step ends at 0.

        Args:
            timesteps: timesteps in 1..T, such as those of another library.
            num_timesteps: T, against which the timesteps are checked; a process refuses timesteps above its own T.

        Raises:
            InvalidInputError: the timesteps are not in decreasing order, or outside 1..T.
        """
        t = torch.tensor(timesteps, dtype=torch.int64)
        if num_timesteps is not None and len(t) and not 1 <= int(t.min()) <= int(t.max()) <= num_timesteps:
            raise InvalidInputError(
                f"timesteps {int(t.min())}..{int(t.max())} are outside 1..{num_timesteps}, the prior's timesteps"
            )
        return cls(t, torch.cat([t[1:], torch.zeros(1, dtype=torch.int64)]))


def check_weighting(kind: str, prediction: str) -> None:
    """Raise UnknownNameError for an unknown name, InvalidInputError for ``"min_snr"`` with ``"edm"`` prediction."""
    if kind not in LOSS_WEIGHTINGS:
        raise unknown_name("loss weighting", kind, LOSS_WEIGHTINGS)
    check_prediction(prediction)
    if kind == "min_snr" and prediction == "edm":
        raise InvalidInputError(
            "loss_weighting='min_snr' does not go with prediction='edm', whose target has unit variance at every "
            "level already; use loss_weighting='none', or prediction 'epsilon', 'v' or 'x0'"
        )


def loss_weights(schedule: NoiseSchedule, t: Tensor, prediction: str, kind: str) -> Tensor:
    """(B,) float32 weights of the mean squares of the network's error at ``t`` (B,), int64 in 1..T: 1 for ``"none"``.
    For ``"min_snr"`` (Hang et al. 2023, Eq. 8) they are min(SNR, gamma) for the clean scene, with :data:`MIN_SNR_GAMMA`
    and SNR = alpha_t^2 / sigma_t^2, min(SNR, gamma) / SNR for the noise, and min(SNR, gamma) / (SNR + 1) for v, whose
    squared errors are SNR and SNR + 1 times that of the clean scene. Errors as for :func:`check_weighting`.

    >>> loss_weights(make_schedule("linear"), torch.tensor([1, 1000]), "x0", "min_snr").tolist()[0]
    5.0
    """
    check_weighting(kind, prediction)
    if kind == "none":
        return torch.ones(t.shape, device=t.device)
    alpha_bar = schedule.alpha_bar[t.cpu()]
    snr = alpha_bar / (1.0 - alpha_bar)
    over = {"epsilon": snr, "v": snr + 1.0, "x0": torch.ones_like(snr)}[prediction]
    return (snr.clamp(max=MIN_SNR_GAMMA) / over).float().to(t.device)


def timestep_distribution(timesteps: str | None, prediction: str) -> str:
    """The distribution of training timesteps: the given one, or the one published with ``prediction``.

    >>> timestep_distribution(None, "epsilon"), timestep_distribution(None, "edm")
    ('uniform', 'lognormal')
    >>> timestep_distribution("lognormal", "v")
    'lognormal'
    """
    return timesteps or ("lognormal" if prediction == "edm" else "uniform")
