"""Configuration: nested dataclasses, validated, composed by Hydra from the groups of ``configs``."""

from agents.configuration.composition import (
    DeviceKeys,
    ProgressKeys,
    PromptKeys,
    RewardLimitKeys,
    RewardLimits,
    SamplingKeys,
    TrainingKeys,
)

__all__ = [
    "DeviceKeys",
    "ProgressKeys",
    "PromptKeys",
    "RewardLimitKeys",
    "RewardLimits",
    "SamplingKeys",
    "TrainingKeys",
]
