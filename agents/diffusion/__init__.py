"""Diffusion processes, noise schedules and step tables."""

from agents.diffusion.categorical import (
    CATEGORICAL_KERNELS,
    CategoricalProcess,
    CategoricalSchedule,
    make_categorical_schedule,
    sample_categorical,
)
from agents.diffusion.gaussian import PREDICTIONS, TIMESTEP_LAWS, GaussianProcess, lognormal_timesteps, timestep_weights
from agents.diffusion.moments import CategoryMoments, Preconditioning
from agents.diffusion.residual import ResidualVariance
from agents.diffusion.reverse_steps import (
    GaussianStep,
    MixedStep,
    ReverseStep,
    concatenate_steps,
    gaussian_log_prob,
)
from agents.diffusion.schedules import NoiseSchedule, make_schedule
from agents.diffusion.step_tables import StepTable
from agents.diffusion.weighting import LOSS_WEIGHTINGS, check_weighting, loss_weights

__all__ = [
    "CATEGORICAL_KERNELS",
    "LOSS_WEIGHTINGS",
    "PREDICTIONS",
    "TIMESTEP_LAWS",
    "CategoricalProcess",
    "CategoricalSchedule",
    "CategoryMoments",
    "GaussianProcess",
    "GaussianStep",
    "MixedStep",
    "NoiseSchedule",
    "Preconditioning",
    "ResidualVariance",
    "ReverseStep",
    "StepTable",
    "check_weighting",
    "concatenate_steps",
    "gaussian_log_prob",
    "lognormal_timesteps",
    "loss_weights",
    "make_categorical_schedule",
    "make_schedule",
    "sample_categorical",
    "timestep_weights",
]
