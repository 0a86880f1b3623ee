"""Reward: distance of a scene to the other scenes of its batch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.scene import SceneBatch, SceneObjects, cutoff, matching_distance


@register_reward("diversity")
@dataclass(frozen=True)
class Diversity:
    """Mean distance of a scene to the other scenes of its batch, from 0 (all are copies) to 1 (nothing in common).

    The distance matches objects of the same asset one to one at the least cost
    (:func:`scene_envs.scene.matching_distance`). It is divided by its largest value. A batch of one scene is
    invalid.

    >>> scenes = SceneBatch.empty("dimsum_table", 2)
    >>> Diversity()(scenes, RewardContext()).value
    tensor([0., 0.])
    """

    name: ClassVar[str] = "diversity"
    maximum: ClassVar[float] = 1.0
    depends_on_batch: ClassVar[bool] = True

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Compare all pairs of scenes. Term: ``nearest``, the distance to the nearest other scene, from 0 to 1."""
        count, limit = len(batch), cutoff(batch.scene_type)
        scenes = list(SceneObjects(batch))
        apart = np.zeros((count, count))
        for i in range(count):
            for j in range(i):
                apart[i, j] = apart[j, i] = matching_distance(scenes[i], scenes[j], limit) / limit
        device = batch.tensor.device
        value = torch.from_numpy(apart.sum(axis=1) / max(count - 1, 1)).float().to(device)
        others = apart + np.diag(np.full(count, np.inf))
        nearest = torch.from_numpy(np.where(count > 1, others.min(axis=1, initial=1.0), 0.0)).float().to(device)
        return RewardOutput(value, terms={"nearest": nearest}, valid=torch.full((count,), count > 1, device=device))
