"""Noise schedules: the share of signal at each of T timesteps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError, unknown_name


@dataclass(frozen=True)
class NoiseSchedule:
    """Cumulative signal rate of a variance-preserving diffusion, x_t = sqrt(a_t) x_0 + sqrt(1 - a_t) eps.

    Attributes:
        name: ``"karras"``, ``"linear"`` or ``"cosine"``.
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
    """(T + 1,) from noise levels spaced as in Karras et al. 2022, Eq. 5, from ``sigma_min`` at t = 1.

    The lowest noise level is 0.002 of the data's unit, five times finer than with linear betas from 1e-4. An object
    that stands and one that floats differ by a millimetre.
    """
    u = torch.linspace(0, 1, num_timesteps, dtype=torch.float64)
    low, high = sigma_min ** (1 / rho), sigma_max ** (1 / rho)
    sigma = (low + u * (high - low)) ** rho
    return torch.cat([torch.ones(1, dtype=torch.float64), 1.0 / (1.0 + sigma**2)])


def linear_alpha_bar(num_timesteps: int, beta_start: float = 1e-4, beta_end: float = 0.02) -> Tensor:
    """(T + 1,) from linearly growing betas (Ho et al. 2020, section 4; the paper's schedule)."""
    beta = torch.linspace(beta_start, beta_end, num_timesteps, dtype=torch.float64)
    return torch.cat([torch.ones(1, dtype=torch.float64), torch.cumprod(1.0 - beta, dim=0)])


def cosine_alpha_bar(num_timesteps: int, offset: float = 0.008, max_beta: float = 0.999) -> Tensor:
    """(T + 1,) of the squared-cosine schedule (Nichol and Dhariwal 2021, Eq. 17), betas capped at ``max_beta``."""
    t = torch.arange(num_timesteps + 1, dtype=torch.float64) / num_timesteps
    f = torch.cos((t + offset) / (1 + offset) * math.pi / 2) ** 2
    beta = (1.0 - f[1:] / f[:-1]).clamp(max=max_beta)
    return torch.cat([torch.ones(1, dtype=torch.float64), torch.cumprod(1.0 - beta, dim=0)])


_SCHEDULES: dict[str, Callable[[int], Tensor]] = {
    "karras": karras_alpha_bar,
    "linear": linear_alpha_bar,
    "cosine": cosine_alpha_bar,
}


def make_schedule(
    name: str, num_timesteps: int = 1000, noise_floor: float = 0.002, noise_ceiling: float = 80.0
) -> NoiseSchedule:
    """The schedule called ``name`` with ``num_timesteps`` levels; ``"karras"`` goes from floor to ceiling."""
    if name not in _SCHEDULES:
        raise unknown_name("noise schedule", name, _SCHEDULES)
    if num_timesteps < 2:
        raise InvalidInputError(f"a noise schedule needs at least 2 timesteps, got {num_timesteps}")
    if name == "karras":
        if not 0.0 < noise_floor < noise_ceiling:
            raise InvalidInputError(
                f"noise_floor={noise_floor:g} must be positive and below noise_ceiling={noise_ceiling:g}"
            )
        return NoiseSchedule(name, karras_alpha_bar(num_timesteps, noise_floor, noise_ceiling))
    return NoiseSchedule(name, _SCHEDULES[name](num_timesteps))
