"""Novelty: duplicates and distances to training scenes, between scenes as sets of objects."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_distance import (
    PlacedObjects,
    SceneObjects,
    check_same_assets,
    counted_objects,
    cutoff,
    matching_distance,
)

DUPLICATE = 0.01
"""Largest distance (m) between objects that count as at the same place."""
CANDIDATES = 32
"""Number of scenes, the nearest by their features, to which the exact distance is computed."""

_ROWS = 256
"""Number of scenes whose features are compared with all others at once."""
_WAVES = 12
"""Number of test functions of the position, for each asset."""


@dataclass(frozen=True)
class Neighbors:
    """The nearest scene to each of B scenes.

    Attributes:
        distance: (B,) m, distance to the nearest scene; see :func:`scene_envs.scene_distance.scene_distances`.
        index: (B,) int64, index of the nearest scene.
        copied: (B,) bool, whether one of the other scenes has the same assets, each within 1 cm of its counterpart.

    >>> from scene_envs.grammars import get_grammar
    >>> scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)
    >>> found = nearest_scenes(scenes[2:4], scenes)
    >>> found.index.tolist(), found.distance.tolist(), found.copied.tolist()
    ([2, 3], [0.0, 0.0], [True, True])
    """

    distance: Tensor
    index: Tensor
    copied: Tensor


def nearest_scenes(batch: SceneBatch, others: SceneBatch, *, candidates: int = CANDIDATES) -> Neighbors:
    """The scene of ``others`` that is nearest to each scene of ``batch``, by its :func:`distance
    <scene_envs.scene_distance.scene_distances>`.

    The distance is computed exactly for the ``candidates`` scenes that are nearest by features. A feature is the sum of
    a function of the position over all objects of one asset. The functions are bounded and have slope 1 at most, so
    that a feature of two scenes never differs by more than the total cost of matching them (Kantorovich duality).

    Raises:
        InvalidInputError: no scenes, or scenes of other assets.
    """
    check_same_assets(batch, others)
    if not len(others) or not len(batch):
        raise InvalidInputError(f"{len(batch)} scenes have no nearest among {len(others)}: both need at least one")
    limit = cutoff(batch.scene_type)
    chosen = _nearest_features(_features(batch, limit), _features(others, limit), min(candidates, len(others)))
    mine, theirs = list(SceneObjects(batch)), SceneObjects(others)
    distance, index, copied = torch.zeros(len(batch), dtype=torch.float64), torch.zeros(len(batch)).long(), []
    for row, columns in enumerate(chosen.tolist()):
        found = [matching_distance(mine[row], theirs[column], limit) for column in columns]
        best = int(np.argmin(found))
        distance[row], index[row] = found[best], columns[best]
        copied.append(any(_is_copy(mine[row], theirs[column]) for column in columns))
    return Neighbors(distance, index, torch.tensor(copied))


def novelty(samples: Neighbors, real: Neighbors) -> float:
    """Median distance of samples to their nearest training scene, over that of held-out real scenes.

    At least 1 for samples that are as new as real scenes, 0 for copies; infinite when the held-out scenes are copies
    of training scenes themselves and the samples are not.

    Args:
        samples: nearest training scenes of the samples.
        real: nearest training scenes of held-out real scenes, from the same training scenes.
    """
    above, below = float(samples.distance.median()), float(real.distance.median())
    return above / below if below > 0 else (1.0 if above == 0 else math.inf)


def duplicates(batch: SceneBatch) -> float:
    """Share of the scenes that another scene of the batch repeats: same assets, each within 1 cm of its counterpart.

    >>> duplicates(SceneBatch.empty("dimsum_table", 4))
    1.0
    """
    objects = list(SceneObjects(batch))
    groups: dict[bytes, list[int]] = {}
    for row, (categories, _) in enumerate(objects):
        groups.setdefault(categories.tobytes(), []).append(row)
    repeated: set[int] = set()
    for rows in groups.values():
        for first, second in _close_pairs([objects[row][1] for row in rows]):
            pair = rows[first], rows[second]
            if not repeated.issuperset(pair) and _is_copy(objects[pair[0]], objects[pair[1]]):
                repeated.update(pair)
    return len(repeated) / len(batch)


def _is_copy(first: PlacedObjects, second: PlacedObjects) -> bool:
    """Whether the assets are the same and can be matched so that all are within :data:`DUPLICATE`."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import maximum_bipartite_matching

    if not np.array_equal(first[0], second[0]):
        return False
    near = ((first[1][:, None] - second[1][None]) ** 2).sum(axis=-1) <= DUPLICATE**2
    near &= first[0][:, None] == second[0][None]
    if not near.any(axis=1).all():
        return False
    return bool((maximum_bipartite_matching(csr_matrix(near)) >= 0).all())


def _close_pairs(positions: list[Array]) -> Index:
    """(P, 2): pairs of scenes whose centres are near enough for them to be copies; all are of the same assets."""
    from scipy.spatial import KDTree

    if len(positions) < 2:
        return np.empty((0, 2), dtype=np.int64)
    centers = np.stack([scene.mean(axis=0) if len(scene) else np.zeros(3) for scene in positions])
    return KDTree(centers).query_pairs(DUPLICATE * 1.001, output_type="ndarray")


# -- features --------------------------------------------------------------------------------------


def _features(batch: SceneBatch, limit: float) -> Tensor:
    """(B, C * (1 + waves)) m: per asset, the sums over its objects of functions with slope <= 1 and range <= ``limit``.

    The functions are the constant ``limit`` / 2 and waves of the position in random directions, equal for all scenes.
    """
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(torch.randn(3, _WAVES, generator=generator), dim=0)
    length = limit / 2 * torch.logspace(0, 1, _WAVES, 2.0)  # slope 1 at amplitude limit / 2 when length = limit / 2
    phase = 2 * math.pi * torch.rand(_WAVES, generator=generator)
    chunks = []
    for start in range(0, len(batch), 1024):
        part = batch[start : start + 1024].to("cpu")
        one_hot = part.tensor[..., 12:-1] * counted_objects(part).unsqueeze(-1)  # (b, N, C)
        waves = (limit / 2) * torch.sin(part.translations @ direction / length + phase)  # (b, N, waves)
        waves = torch.cat([torch.full_like(waves[..., :1], limit / 2), waves], dim=-1)
        chunks.append(torch.einsum("bnc,bnw->bcw", one_hot, waves).flatten(1))
    return torch.cat(chunks)


def _nearest_features(features: Tensor, others: Tensor, count: int) -> Tensor:
    """(B, count) int64: rows of ``others`` with the nearest features."""
    used = (features != 0).any(dim=0) | (others != 0).any(dim=0)
    features, others = features[:, used], others[:, used]
    chunks = features.split(_ROWS)
    return torch.cat([torch.cdist(chunk, others).topk(count, dim=1, largest=False).indices for chunk in chunks])
