"""Rewards that depend on the batch: distance to its other scenes, and contribution to what it covers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from rewards.base import RewardContext, RewardOutput
from rewards.registry import register_reward
from scene_envs.errors import InvalidInputError
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


@register_reward("coverage")
@dataclass(frozen=True)
class Coverage:
    """Contribution of a scene to the coverage of its batch, the share of (asset, place) pairs that occur in some scene.

    Places are the cells of a grid over the workspace; pairs are of all assets but those of fixed objects. A pair that
    occurs in k scenes counts 1/k for each of them (Shapley 1953). Values are multiplied by the number of scenes, so
    that their mean over the batch is the coverage. Only objects in the workspace count.

    Attributes:
        cells: number of grid cells along x, y and z.

    >>> Coverage()(SceneBatch.empty("dimsum_table", 2), RewardContext()).value
    tensor([0., 0.])
    """

    name: ClassVar[str] = "coverage"
    depends_on_batch: ClassVar[bool] = True
    cells: tuple[int, int, int] = (4, 4, 4)

    def __post_init__(self) -> None:
        cells = tuple(int(number) for number in self.cells)
        if len(cells) != 3 or min(cells) < 1:
            raise InvalidInputError(
                f"coverage: cells={self.cells!r} must be three numbers of at least 1: along x, y, z"
            )
        object.__setattr__(self, "cells", cells)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Count. ``per_object`` (B, N) shares each pair among the objects that make it.

        Terms: ``batch_coverage``, the same for all scenes; ``pairs``, the number of pairs in the scene.
        """
        kind, device = batch.scene_type, batch.tensor.device
        low, high = (torch.tensor(corner, device=device) for corner in kind.workspace)
        grid = torch.tensor(self.cells, device=device)
        place = ((batch.translations - low) / (high - low) * grid).floor().long().clamp(min=torch.zeros_like(grid))
        place = torch.minimum(place, grid - 1)
        cell = (place[..., 0] * grid[1] + place[..., 1]) * grid[2] + place[..., 2]
        places = int(grid.prod())
        fixed = torch.tensor(kind.fixed_categories, dtype=torch.long, device=device)
        counts = batch.in_workspace & ~torch.isin(batch.categories, fixed)
        pair = torch.where(counts, batch.categories * places + cell, kind.num_assets * places)  # (B, N), last: none
        number = torch.zeros(len(batch), kind.num_assets * places + 1, device=device)
        number.scatter_add_(1, pair, counts.float())  # objects of each pair
        present = (number[:, :-1] > 0).float()
        scenes = present.sum(dim=0)
        total = (kind.num_assets - len(fixed)) * places
        share = len(batch) / total * present / scenes.clamp(min=1)  # (B, pairs)
        share = torch.cat([share, torch.zeros(len(batch), 1, device=device)], dim=1)
        credit = (share / number.clamp(min=1)).gather(1, pair)
        return RewardOutput(
            value=share.sum(dim=1),
            per_object=credit,
            terms={
                "batch_coverage": ((scenes > 0).sum() / total).expand(len(batch)).clone(),
                "pairs": present.sum(dim=1),
            },
        )
