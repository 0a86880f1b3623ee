"""Corrections of scenes while they are denoised: objects come apart where they overlap, and down where they float."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.falls import falls
from scene_envs.physics.motion import Physics, physics_of
from scene_envs.physics.placement import Objects, flatten
from scene_envs.physics.projection import Corners, separated
from scene_envs.scene import SceneBatch

_DEEP = 5e-4
"""Overlap (m) up to which two objects are left as they are; feasible objects may overlap by 1e-3 m."""
_FLOATING = 3e-4
"""Height (m) up to which an object counts as standing."""
_FALL = 0.03
"""An object higher than this (m) above everything is left as it is."""
_LEAST = 0.02
"""Least standard deviation along an axis, as a share of the largest one."""
_CHUNK = 16
"""Scenes whose overlaps are found together."""


def corrections(batch: SceneBatch, spread: Array, movable: Mask | None = None) -> Tensor:
    """Moves (B, N, 3), m, after which objects overlap and float less: one round for each scene.

    Overlapping objects come apart by a least-distance problem, as in :func:`~scene_envs.physics.project`. Distances are
    measured in standard deviations of the positions, so objects move along the axes on which they are uncertain rather
    than along the others. Then each object comes straight down onto what is less than 3 cm below it. Rotations and
    welded objects stay.

    Args:
        batch: B scenes of N slots, on the CPU, with finite poses.
        spread: (3,) standard deviation of the positions along the axes of the world; only its ratios matter.
        movable: (B, N) bool, slots whose objects may move; None for all. Welded objects never move.

    >>> corrections(SceneBatch.empty("dimsum_table", 1), np.ones(3)).abs().max()
    tensor(0.)
    """
    physics, moves = physics_of(batch.scene_type), np.zeros((*batch.tensor.shape[:2], 3))
    cost = 1.0 / np.maximum(spread / max(float(spread.max()), 1e-12), _LEAST)
    for start in range(0, len(batch), _CHUNK):
        rows = slice(start, start + _CHUNK)
        objects = _objects(physics, batch[rows], None if movable is None else movable[rows])
        if len(objects):
            after = _apart(physics, objects, batch.scene_type.workspace, cost)
            down = falls(physics.collider, replace(objects, translation=after), _FALL)
            after[:, 2] -= np.where(down > _FLOATING, down, 0.0)
            moves[start + objects.scene, objects.slot] = after - objects.translation
    return torch.as_tensor(moves, dtype=batch.tensor.dtype)


def _objects(physics: Physics, batch: SceneBatch, movable: Mask | None) -> Objects:
    """The objects of scenes; those that may not move are fixed."""
    categories = batch.categories.numpy()
    welded = np.isin(categories, np.array(batch.scene_type.welded_categories, dtype=np.int64))
    fixed = welded if movable is None else welded | ~movable
    return flatten(
        physics.library, batch.translations.double().numpy(), batch.rotations.double().numpy(), categories, fixed
    )


def _apart(physics: Physics, objects: Objects, workspace: Corners, cost: Array) -> Array:
    """(n, 3) m, translations after one round of projection of each scene in which objects overlap."""
    pairs = physics.collider.pairs(objects)
    after = objects.translation.copy()
    for scene in np.unique(objects.scene[pairs.first[pairs.depth > _DEEP]]):
        rows: Index = np.flatnonzero(objects.scene == scene)
        own = pairs.among(rows)
        deep = own.depth > _DEEP
        after[rows] = separated(physics.collider, objects[rows], own.first[deep], own.second[deep], workspace, cost)
    return after
