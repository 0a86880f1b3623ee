"""Untrained priors with very small networks, for tests and examples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import nn

from agents.priors.storage import prior_class
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType, get_scene_type

if TYPE_CHECKING:
    from agents.priors.base import ScenePrior


def _workspace_normalizer(scene_type: SceneType) -> Normalizer:
    """A normalizer made from the scene type alone: workspace, yaw-only rotations, one-hot categories."""
    low, high = (torch.tensor(corner) for corner in scene_type.workspace)
    yaw_low = torch.tensor([-1.0, -1, 0, -1, -1, 0, 0, 0, 0])
    yaw_high = torch.tensor([1.0, 1, 0, 1, 1, 0, 0, 0, 1])
    flags = torch.ones(scene_type.num_assets + 1)
    return Normalizer.from_range(torch.cat([low, yaw_low, 0 * flags]), torch.cat([high, yaw_high, flags]))


def tiny_prior(
    scene_type: str | SceneType = "dimsum_table",
    seed: int = 0,
    slots: int | None = None,
    process: str = "continuous",
    text: bool = False,
) -> ScenePrior:
    """An untrained prior with a very small network and random weights, for tests and examples.

    Args:
        scene_type: scene type or its name.
        seed: of the weights.
        slots: slots per scene; the scene type's when None.
        process: ``"continuous"`` or ``"mixed"``.
        text: whether it reads prompts, with a vocabulary of what can be said of scenes of this type; mixed only.
    """
    scene_type = get_scene_type(scene_type)
    normalizer = _workspace_normalizer(scene_type)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        prior = prior_class(process).tiny(scene_type, scene_type.slots if slots is None else slots, normalizer, text)
        for parameter in prior.parameters():
            if not bool(parameter.any()):
                nn.init.normal_(parameter, std=0.02)
    return prior.eval()
