"""Corrections of scenes during denoising: overlapping objects move apart, floating objects move down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.falls import falls
from scene_envs.physics.motion import Physics, physics_of
from scene_envs.physics.placement import Objects, flatten, object_boxes, place
from scene_envs.physics.projection import Corners, separated
from scene_envs.scene import SceneBatch

_DEEP = 5e-4
"""Overlap (m) up to which two objects are not moved; feasible objects may overlap by 1e-3 m."""
_FLOATING = 3e-4
"""Height (m) up to which an object counts as standing."""
_FALL = 0.03
"""An object higher than this (m) above all others is not moved down."""
_MIN_SPREAD = 0.02
"""Smallest standard deviation along an axis, as a share of the largest one."""
_LEVEL = np.array([1.0, 1.0, 50.0])
"""Cost of moving furniture by a metre along each axis: vertical moves are avoided."""
_CHUNK = 16
"""Scenes whose overlaps are found together."""


def corrections(batch: SceneBatch, spread: Array, movable: Mask | None = None) -> Tensor:
    """Moves (B, N, 3), m, that reduce overlap and floating: one round for each scene.

    First, overlapping pieces of generated furniture move apart along the floor, together with the objects on them.
    Then overlapping objects move apart by a least-distance problem, as in :func:`~scene_envs.physics.project`.
    Distances are measured in standard deviations of the positions, so objects move along the axes on which they are
    uncertain. Last, each object moves straight down onto the object less than 3 cm below it. Rotations and the fixed
    objects of the scene type stay.

    Args:
        batch: B scenes of N slots, on the CPU, with finite poses.
        spread: (3,) standard deviations of the positions along the axes of the world; only their ratios matter.
        movable: (B, N) bool, slots whose objects may move; None for all.

    >>> corrections(SceneBatch.empty("dimsum_table", 1), np.ones(3)).abs().max()
    tensor(0.)
    """
    physics, moves = physics_of(batch.scene_type), np.zeros((*batch.tensor.shape[:2], 3))
    movable = np.ones(batch.tensor.shape[:2], dtype=bool) if movable is None else movable
    cost = 1.0 / np.maximum(spread / max(float(spread.max()), 1e-12), _MIN_SPREAD)
    workspace = batch.scene_type.workspace
    for start in range(0, len(batch), _CHUNK):
        some, free = batch[start : start + _CHUNK], movable[start : start + _CHUNK]
        objects = _objects(physics, some, free)
        if not len(objects):
            continue
        before, at = objects.translation, (objects.scene, objects.slot)
        furniture = some.is_furniture.numpy() & free
        if furniture.any():
            objects = _furniture_apart(physics, objects, some.is_welded.numpy()[at], furniture[at], workspace)
        objects = replace(objects, translation=_apart(physics, objects, workspace, cost))
        down = falls(physics.collider, objects, _FALL)
        moves[start + objects.scene, objects.slot] = objects.translation - before
        moves[start + objects.scene, objects.slot, 2] -= np.where(down > _FLOATING, down, 0.0)
    return torch.as_tensor(moves, dtype=batch.tensor.dtype)


def _objects(physics: Physics, batch: SceneBatch, movable: Mask) -> Objects:
    """The objects of scenes; welded ones, and those that may not move, are fixed."""
    poses = batch.translations.double().numpy(), batch.rotations.double().numpy()
    return flatten(physics.library, *poses, batch.categories.numpy(), batch.is_welded.numpy() | ~movable)


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


def _furniture_apart(physics: Physics, objects: Objects, welded: Mask, movable: Mask, workspace: Corners) -> Objects:
    """The objects (n,) after overlapping ``welded`` and ``movable`` ones moved apart, with the objects on them."""
    pieces = np.flatnonzero(welded)
    furniture = replace(objects[pieces], fixed=~movable[pieces])
    moves = _apart(physics, furniture, workspace, _LEVEL) - furniture.translation
    if not moves.any():
        return objects
    holder = _holders(physics, objects, furniture)
    holder[pieces] = np.arange(len(pieces))
    shift = np.where((holder >= 0)[:, None], moves[holder], 0.0)
    return replace(objects, translation=objects.translation + shift)


def _holders(physics: Physics, objects: Objects, furniture: Objects) -> Index:
    """(n,) row of the ``furniture`` (m,) that each free object is on or in; -1 for none."""
    low, high = object_boxes(place(physics.library, furniture, "coarse"))
    at, middle = objects.translation[:, None], furniture.translation
    over = ((at[..., :2] >= low[:, :2]) & (at[..., :2] <= high[:, :2])).all(axis=2) & (at[..., 2] >= low[:, 2])
    over &= (objects.scene[:, None] == furniture.scene) & ~objects.fixed[:, None] & ~furniture.fixed
    distance = np.where(over, np.abs(at[..., :2] - middle[:, :2]).max(axis=2), np.inf)
    return np.where(over.any(axis=1), distance.argmin(axis=1), -1)
