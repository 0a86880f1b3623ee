"""Diffusion processes, noise schedules and step tables."""

from agents.diffusion.categorical import CategoricalProcess
from agents.diffusion.gaussian import GaussianProcess, NoiseSchedule, Preconditioning, ResidualVariance, StepTable
from agents.diffusion.reverse_steps import GaussianStep, MixedStep, ReverseStep

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
