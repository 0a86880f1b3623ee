"""Configuration: nested dataclasses, validated, composed by Hydra from the groups of ``configs``."""

from agents.configuration.compose import compose_tree, group_options
from agents.configuration.fields import composed, named, nested
from agents.configuration.shared_keys import OutputKeys, RewardLimits, SamplingKeys, TrainingKeys
from agents.configuration.tree import build, changed, config_text, dotted_values, plain_tree

__all__ = [
    "OutputKeys",
    "RewardLimits",
    "SamplingKeys",
    "TrainingKeys",
    "build",
    "changed",
    "compose_tree",
    "composed",
    "config_text",
    "dotted_values",
    "group_options",
    "named",
    "nested",
    "plain_tree",
]
