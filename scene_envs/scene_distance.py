"""Distance between scenes as sets of objects."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

PlacedObjects = tuple[Index, Array]
"""Objects of one scene: categories (n,), ascending, and positions (n, 3) m."""


def cutoff(scene_type: SceneType) -> float:
    """The cost (m) of an object without counterpart: a quarter of the longer horizontal side of the workspace.

    >>> from scene_envs.scene_types import get_scene_type
    >>> cutoff(get_scene_type("dimsum_table"))
    0.245
    """
    low, high = scene_type.workspace
    return 0.25 * max(high[0] - low[0], high[1] - low[1])


def scene_distances(batch: SceneBatch, other: SceneBatch) -> Tensor:
    """(B,) m: distance of each scene from its counterpart in ``other``, as sets of objects; orientations do not count.

    This is the OSPA distance of order 1 (Schuhmacher, Vo and Vo, 2008). Objects are matched one to one at the least
    total cost. A match costs the distance of the two positions, at most c, or c when the assets differ. Each object
    without a match costs c. The total is divided by the number of objects of the larger scene. Fixed welded objects
    are left out; c is :func:`cutoff`. The assignment is exact: it is the limit of Sinkhorn iterations as their
    regularisation goes to zero.

    >>> from scene_envs.grammars import get_grammar
    >>> scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 2)
    >>> shuffled = SceneBatch(scenes.tensor.flip(1), scenes.scene_type)
    >>> scene_distances(shuffled, scenes)
    tensor([0., 0.], dtype=torch.float64)

    Raises:
        InvalidInputError: another number of scenes, or scenes of other assets.
    """
    check_same_assets(batch, other)
    if len(batch) != len(other):
        raise InvalidInputError(f"{len(batch)} scenes have no counterparts in {len(other)}; give as many")
    limit = cutoff(batch.scene_type)
    pairs = zip(SceneObjects(batch), SceneObjects(other), strict=True)
    return torch.tensor([matching_distance(first, second, limit) for first, second in pairs], dtype=torch.float64)


class SceneObjects:
    """The counted objects of each scene of a batch, sorted by category; each scene is computed on first use."""

    def __init__(self, batch: SceneBatch) -> None:
        self._present = counted_objects(batch).cpu().numpy()
        self._categories = batch.categories.cpu().numpy()
        self._positions = batch.translations.double().cpu().numpy()
        self._known: dict[int, PlacedObjects] = {}

    def __len__(self) -> int:
        return len(self._present)

    def __iter__(self) -> Iterator[PlacedObjects]:
        return (self[row] for row in range(len(self)))

    def __getitem__(self, row: int) -> PlacedObjects:
        if row not in self._known:
            slots = np.flatnonzero(self._present[row])
            slots = slots[np.argsort(self._categories[row, slots], kind="stable")]
            self._known[row] = self._categories[row, slots], self._positions[row, slots]
        return self._known[row]


def counted_objects(batch: SceneBatch) -> Tensor:
    """(B, N) bool: objects without the fixed welded ones that are in every scene."""
    fixed = torch.tensor(batch.scene_type.fixed_categories, dtype=torch.long, device=batch.tensor.device)
    return ~batch.is_empty & ~torch.isin(batch.categories, fixed)


def matching_distance(first: PlacedObjects, second: PlacedObjects, limit: float) -> float:
    """Distance (m) of two scenes, as in :func:`scene_distances`; ``limit`` (m) is the cost of an unmatched object."""
    from scipy.optimize import linear_sum_assignment

    count, larger = len(first[0]), max(len(first[0]), len(second[0]))
    if not larger:
        return 0.0
    apart = np.sqrt(((first[1][:, None] - second[1][None]) ** 2).sum(axis=-1))
    cost = np.where(first[0][:, None] == second[0][None], np.minimum(apart, limit), limit)
    rows, columns = linear_sum_assignment(cost)
    matched = float(cost[rows, columns].sum())
    return (matched + limit * (larger - min(count, len(second[0])))) / larger


def check_same_assets(batch: SceneBatch, other: SceneBatch) -> None:
    """Raise InvalidInputError when two batches hold scenes of other assets."""
    if batch.scene_type.assets != other.scene_type.assets:
        raise InvalidInputError(
            f"scenes of {batch.scene_type.name!r} cannot be compared with scenes of {other.scene_type.name!r}: "
            "their assets differ"
        )
