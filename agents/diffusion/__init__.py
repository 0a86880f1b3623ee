"""Diffusion processes, noise schedules and step tables."""

from agents.diffusion.categorical import CategoricalProcess
from agents.diffusion.gaussian import GaussianProcess
from agents.diffusion.moments import Preconditioning
from agents.diffusion.residual import ResidualVariance
from agents.diffusion.reverse_steps import GaussianStep, MixedStep, ReverseStep
from agents.diffusion.schedules import NoiseSchedule
from agents.diffusion.step_tables import StepTable

__all__ = [
    "CategoricalProcess",
    "GaussianProcess",
    "GaussianStep",
    "MixedStep",
    "NoiseSchedule",
    "Preconditioning",
    "ResidualVariance",
    "ReverseStep",
    "StepTable",
]
