"""Datasets of scenes: generation from grammars, files, prompts, mixtures."""

from scene_envs.datasets.dataset import SceneDataset
from scene_envs.datasets.generate import GenerationReport, generate
from scene_envs.datasets.info import DatasetInfo, read_metadata
from scene_envs.datasets.mixing import MixedDataset, mix
from scene_envs.datasets.prompts import PromptFacts, SceneFacts, describe, describe_all, parse_prompt, scene_facts
from scene_envs.datasets.splits import Part
from scene_envs.datasets.stream import SceneStream
from scene_envs.datasets.union import from_union, to_union
from scene_envs.datasets.verification import judge_scenes
from scene_envs.errors import StorageError

__all__ = [
    "DatasetInfo",
    "GenerationReport",
    "MixedDataset",
    "Part",
    "PromptFacts",
    "SceneDataset",
    "SceneFacts",
    "SceneStream",
    "StorageError",
    "describe",
    "describe_all",
    "from_union",
    "generate",
    "judge_scenes",
    "mix",
    "parse_prompt",
    "read_metadata",
    "scene_facts",
    "to_union",
]
