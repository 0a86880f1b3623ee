"""Datasets of scenes: generation from grammars, files, prompts."""

from scene_envs.datasets.dataset import SceneDataset
from scene_envs.datasets.generate import GenerationReport, generate
from scene_envs.datasets.prompts import PromptFacts, SceneFacts, describe, parse_prompt, scene_facts
from scene_envs.datasets.ranges import fixed_normalizer
from scene_envs.datasets.verification import verify_scenes

__all__ = [
    "GenerationReport",
    "PromptFacts",
    "SceneDataset",
    "SceneFacts",
    "describe",
    "fixed_normalizer",
    "generate",
    "parse_prompt",
    "scene_facts",
    "verify_scenes",
]
