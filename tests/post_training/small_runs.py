"""Small runs on an untrained prior."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from agents.post_training import PostTrainConfig
from rewards.base import RewardContext, RewardOutput
from scene_envs.scene import SceneBatch


def small_config(output: Path | str, **changes: Any) -> PostTrainConfig:
    """Four iterations in about a second."""
    settings: dict[str, Any] = {
        "reward": count_objects,
        "output": str(output),
        "iterations": 4,
        "batch_size": 6,
        "num_steps": 5,
        "gradient_steps": 2,
        "regularisation": 1.0,
        "regularisation_batch": 4,
        "bank_size": 24,
        "guard_scenes": 8,
        "guard_every": 2,
        "checkpoint_every": 2,
        "learning_rate": 1e-3,
        "progress": "none",
    }
    return PostTrainConfig(**(settings | changes))


def count_objects(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Objects per scene, with credit per slot."""
    return RewardOutput(batch.counts.float(), per_object=(~batch.is_empty).float())


def not_a_number(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """No valid score for any scene."""
    return RewardOutput(torch.full((len(batch),), float("nan")))
