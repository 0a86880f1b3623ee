"""Prompts that are true of a scene, with a parser and a checker."""

from scene_envs.datasets.prompts.claims import PromptFacts
from scene_envs.datasets.prompts.facts import SceneFacts, Tolerances, scene_facts, viewer_axes
from scene_envs.datasets.prompts.parser import parse_prompt
from scene_envs.datasets.prompts.writer import KINDS, describe, describe_all

__all__ = [
    "KINDS",
    "PromptFacts",
    "SceneFacts",
    "Tolerances",
    "describe",
    "describe_all",
    "parse_prompt",
    "scene_facts",
    "viewer_axes",
]
