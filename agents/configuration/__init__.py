"""Configuration: nested dataclasses, validated, composed by Hydra from the groups of ``configs``."""

from agents.configuration.composition import (
    DeviceKeys,
    OutputKeys,
    ProgressKeys,
    PromptKeys,
    RewardLimitKeys,
    RewardLimits,
    SamplingKeys,
    TrainingKeys,
    build,
    changed,
    composed,
    config_text,
    dotted_values,
    named,
    nested,
    plain_tree,
)

__all__ = [
    "DeviceKeys",
    "OutputKeys",
    "ProgressKeys",
    "PromptKeys",
    "RewardLimitKeys",
    "RewardLimits",
    "SamplingKeys",
    "TrainingKeys",
    "build",
    "changed",
    "composed",
    "config_text",
    "dotted_values",
    "named",
    "nested",
    "plain_tree",
]
