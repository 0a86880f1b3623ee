"""Datasets of scenes: generation from grammars, files, prompts, unions."""

from scene_envs.datasets.dataset import SceneDataset, load_scenes, to_union
from scene_envs.datasets.files import DatasetInfo, read_metadata
from scene_envs.datasets.generation import GenerationReport, generate, judge_scenes
from scene_envs.datasets.prompts import PromptFacts, SceneFacts, describe, describe_all, parse_prompt, scene_facts

__all__ = [
    "DatasetInfo",
    "GenerationReport",
    "PromptFacts",
    "SceneDataset",
    "SceneFacts",
    "describe",
    "describe_all",
    "generate",
    "judge_scenes",
    "load_scenes",
    "parse_prompt",
    "read_metadata",
    "scene_facts",
    "to_union",
]
