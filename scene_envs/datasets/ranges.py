"""Fixed normalizer of a generated dataset, computed before the first scene, so that all shards share it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from scene_envs.grammars import Grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import CATEGORY

_OBJECTS = 10_000
"""Smallest number of objects in a sample without tilted objects, unless it takes more than ``_SCENES`` scenes."""
_SCENES = 4096
_STEP = 128
"""Scenes drawn at a time, until one holds a tilted object."""
_SEED = 20_250_101
_UPRIGHT = 1e-6
"""A rotation entry that encodes tilt counts as zero below this."""
_TILT = [5, 8, 9, 10]
"""Features of a rotation that are zero when the object only turns about z: xz, yz, zx, zy."""
_PLANE = [3, 4, 6, 7]
"""Features of a rotation about z: xx, xy, yx, yy."""


def fixed_normalizer(grammar: Grammar) -> Normalizer:
    """The normalizer of a grammar's scenes, a function of the grammar alone.

    x and y take the workspace's range, one-hots [0, 1], and z the range of a sample of unverified scenes, empty slots
    included. If any object of the sample is tilted, all nine rotation entries take [-1, 1]. If objects only turn about
    z, the four entries that encode tilt are constant (they come back exactly), and the four of the turn take [-1, 1]
    each if they vary. The sample has 128 scenes. As long as nothing in it is tilted it grows to 10,000 objects (4,096
    scenes at most), so that a rare tilt is not missed.
    """
    low, high, tilted = _ranges(grammar)
    grammar.reasons.clear()
    for axis in (0, 1):
        low[axis], high[axis] = (corner[axis] for corner in grammar.scene_type.workspace)
    if not tilted:
        low[_TILT] = high[_TILT] = 0.0
    for feature in range(3, 12) if tilted else _PLANE:
        if tilted or high[feature] - low[feature] > _UPRIGHT:
            low[feature], high[feature] = -1.0, 1.0
    low[CATEGORY], high[CATEGORY] = 0.0, 1.0
    return Normalizer.from_range(low, high)


def _ranges(grammar: Grammar) -> tuple[Tensor, Tensor, bool]:
    """Smallest and largest value (D,) of each feature in a sample, and whether any object of it is tilted."""
    rng = np.random.default_rng(_SEED)
    features = grammar.scene_type.features
    low, high = torch.full((features,), torch.inf), torch.full((features,), -torch.inf)
    objects = scenes = 0
    tilted = False
    while scenes == 0 or (not tilted and objects < _OBJECTS and scenes < _SCENES):
        flat = torch.from_numpy(grammar.sample_array(rng, _STEP)).flatten(0, 1)
        present = flat[flat[:, -1] < 0.5]
        low, high = torch.minimum(low, flat.amin(dim=0)), torch.maximum(high, flat.amax(dim=0))
        tilted |= bool((present[:, _TILT].abs() > _UPRIGHT).any() or (present[:, 11] < 1 - _UPRIGHT).any())
        objects, scenes = objects + len(present), scenes + _STEP
    return low, high, tilted
