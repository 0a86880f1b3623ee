"""Diffusion processes, noise schedules and step tables."""

from agents.diffusion.gaussian import PREDICTIONS, GaussianProcess, Preconditioning, lognormal_timesteps
from agents.diffusion.residual import ResidualVariance
from agents.diffusion.schedules import NoiseSchedule, make_schedule
from agents.diffusion.step_tables import StepTable

__all__ = [
    "PREDICTIONS",
    "GaussianProcess",
    "NoiseSchedule",
    "Preconditioning",
    "ResidualVariance",
    "StepTable",
    "lognormal_timesteps",
    "make_schedule",
]
