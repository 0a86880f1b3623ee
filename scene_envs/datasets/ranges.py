"""The fixed normalizer of a generated dataset: known before the first scene, so all shards share it."""

from __future__ import annotations

import numpy as np
import torch

from scene_envs.grammars import Grammar
from scene_envs.normalizer import Normalizer

_SAMPLE = 512
_SEED = 20_250_101


def fixed_normalizer(grammar: Grammar) -> Normalizer:
    """The normalizer of a grammar's scenes, a function of the grammar alone.

    Which features vary is read off a sample of unverified scenes, empty slots included. x and y take the
    workspace's range, rotation entries that change sign take [-1, 1], z and the others the sample's range.
    """
    scenes = grammar.sample_array(np.random.default_rng(_SEED), _SAMPLE)
    grammar.reasons.clear()
    fitted = Normalizer.fit(torch.from_numpy(scenes))
    low, high = fitted.input_min.clone(), fitted.input_max.clone()
    for axis in (0, 1):
        low[axis], high[axis] = (corner[axis] for corner in grammar.scene_type.workspace)
    rotation = torch.zeros_like(low, dtype=torch.bool)
    rotation[3:12] = True
    signed = rotation & (low < 0) & (high > 0)
    low[signed], high[signed] = -1.0, 1.0
    return Normalizer.from_range(low, high)
