"""Spacing of objects: distances between neighbours, compared with real scenes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
import torch

from scene_envs.scene import SceneBatch
from scene_envs.scene_distance import check_same_assets

SAME_HEIGHT = 0.02
"""Largest difference in height (m) between the frames of two neighbours."""
MAX_DISTANCE = 0.5
"""Bound of a distance (m), so that places on other tables of a room do not outweigh neighbours."""
MIN_DISTANCES = 30
"""Smallest number of distances of a pair of assets, in each of the two batches; rarer pairs are left out."""

_CHUNK = 128


def spacing_wasserstein(batch: SceneBatch, reference: SceneBatch) -> float | None:
    """Distance of the distributions of distances between neighbours from those of real scenes, m.

    For each ordered pair of assets (a, b), the horizontal distances from the free objects a to the nearest free object
    b at the same height form a distribution. The figure is the Wasserstein-1 distance of samples and reference, as a
    mean over the pairs, weighted by their number of distances in the reference. It shows whether objects are pushed
    apart or crowded, even if their number and categories are those of real scenes.

    Args:
        batch: the samples.
        reference: real scenes of the same assets.

    Returns:
        The distance in m; None if no pair of assets has 30 distances in both batches.

    Raises:
        InvalidInputError: the batches have other assets.

    >>> spacing_wasserstein(SceneBatch.empty("dimsum_table", 3), SceneBatch.empty("dimsum_table", 5)) is None
    True
    """
    from scipy.stats import wasserstein_distance

    check_same_assets(batch, reference)
    samples, real = _distances(batch), _distances(reference)
    pairs = [pair for pair in real if min(len(real[pair]), len(samples.get(pair, ()))) >= MIN_DISTANCES]
    if not pairs:
        return None
    distances = [float(wasserstein_distance(samples[pair], real[pair])) for pair in pairs]
    return float(np.average(distances, weights=[len(real[pair]) for pair in pairs]))


def _distances(batch: SceneBatch) -> Mapping[tuple[int, int], np.ndarray[tuple[int], np.dtype[np.float64]]]:
    """Distances (K,) m from objects of an asset to the nearest object of another, or of the same one, by pair."""
    found = defaultdict(list)
    for start in range(0, len(batch), _CHUNK):
        chunk = batch[start : start + _CHUNK].to("cpu")
        places, free, categories = chunk.translations.double(), chunk.is_free, chunk.categories
        offset = places[:, :, None] - places[:, None]  # (B, N, N, 3)
        level = (offset[..., 2].abs() < SAME_HEIGHT) & free[:, :, None] & free[:, None]
        level.diagonal(dim1=1, dim2=2).fill_(False)
        distance = offset[..., :2].norm(dim=-1).masked_fill(~level, torch.inf)
        for other in categories[free].unique().tolist():
            nearest = distance.masked_fill((categories != other)[:, None], torch.inf).amin(dim=-1)  # (B, N)
            there = nearest.isfinite()
            for asset in categories[there].unique().tolist():
                values = nearest[there & (categories == asset)].clamp(max=MAX_DISTANCE)
                found[asset, other].append(values.numpy())
    return {pair: np.concatenate(parts) for pair, parts in found.items()}
