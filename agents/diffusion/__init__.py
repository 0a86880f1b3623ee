"""Diffusion processes, noise schedules and step tables."""

from agents.diffusion.gaussian import PREDICTIONS, GaussianProcess, Preconditioning, lognormal_timesteps
from agents.diffusion.schedules import NoiseSchedule, make_schedule
from agents.diffusion.step_tables import StepTable

__all__ = [
    "PREDICTIONS",
    "GaussianProcess",
    "NoiseSchedule",
    "Preconditioning",
    "StepTable",
    "lognormal_timesteps",
    "make_schedule",
]
