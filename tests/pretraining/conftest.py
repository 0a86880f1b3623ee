"""Scenes and a configuration for short pretraining runs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from agents.pretraining.settings import PretrainConfig
from scene_envs.scene import SceneBatch


@pytest.fixture(scope="module")
def raw() -> torch.Tensor:
    """Tables with teapots somewhere: enough to train on."""
    generator = torch.Generator().manual_seed(0)
    scenes = SceneBatch.empty("dimsum_table", 64)
    categories = torch.where(torch.rand(64, 34, generator=generator) < 0.5, 6, 7)
    categories[:, 0] = 0
    translations = torch.rand(64, 34, 3, generator=generator) - 0.5
    translations[:, 0] = 0
    rotations = torch.eye(3).expand(64, 34, 3, 3)
    return SceneBatch.from_parts(translations, rotations, categories, scenes.scene_type).tensor


@pytest.fixture
def config(tmp_path: Path) -> PretrainConfig:
    return PretrainConfig(
        output=str(tmp_path), iterations=6, batch_size=8, network={"hidden": 16, "depth": 1, "heads": 2},
        optimizer={"rate": {"warmup": 2}}, logger={"log_every": 1, "evaluate_every": 3, "checkpoint_every": 2},
    )  # fmt: skip
