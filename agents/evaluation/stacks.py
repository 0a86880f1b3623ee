"""Heights of stacks of objects, compared with real scenes."""

from __future__ import annotations

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch
from scene_envs.scene_distance import check_same_assets


def tallest_stacks(batch: SceneBatch) -> Tensor:
    """Number of objects in the tallest stack of each scene, (B,) int64.

    A stack is a chain of free objects, each standing on the one below or lying in it
    (:attr:`SceneBatch.supports <scene_envs.scene_facts.AssetFacts.supports>`). A lone object is a stack of one.
    A scene without free objects has 0.

    >>> tallest_stacks(SceneBatch.empty("dimsum_table", 2)).tolist()
    [0, 0]
    """
    below, free = batch.supports, batch.is_free
    on_free = (below >= 0) & free.gather(1, below.clamp(min=0))
    levels = free.long()  # (B, N): objects from each object down to the lowest free one below it
    for _ in range(below.shape[1]):
        deeper = torch.where(free & on_free, 1 + levels.gather(1, below.clamp(min=0)), free.long())
        if torch.equal(deeper, levels):
            break
        levels = deeper
    return levels.amax(dim=1)


def stack_wasserstein(batch: SceneBatch, reference: SceneBatch) -> float:
    """Wasserstein-1 distance of the tallest stack per scene, in objects.

    It shows whether stacks are lower than in real scenes, even if the number and categories of objects are those of
    real scenes.

    Args:
        batch: the samples, at least one.
        reference: real scenes of the same assets, at least one.

    Raises:
        InvalidInputError: the batches have other assets.

    >>> stack_wasserstein(SceneBatch.empty("dimsum_table", 3), SceneBatch.empty("dimsum_table", 5))
    0.0
    """
    from scipy.stats import wasserstein_distance

    check_same_assets(batch, reference)
    return float(wasserstein_distance(tallest_stacks(batch).cpu().numpy(), tallest_stacks(reference).cpu().numpy()))
