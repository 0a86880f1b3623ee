"""Short pretraining runs on tables with teapots."""

from __future__ import annotations

import torch

from agents.pretraining.initial_prior import SceneTable, build_prior
from agents.pretraining.settings import PretrainConfig
from agents.pretraining.trainer import Pretrainer
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch


def make_run(config: PretrainConfig, raw: torch.Tensor) -> Pretrainer:
    """The run of ``config`` on scenes ``raw``, of which the last eight are held out."""
    prior = build_prior(config, raw, Normalizer.fit(raw))
    scenes = prior.encode(SceneBatch(raw, prior.scene_type))
    return Pretrainer(config, SceneTable(scenes[:-8]), scenes[-8:], prior)
