"""Corrections of scenes during denoising: overlapping objects move apart, floating objects move down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import Collider, scene_pairs
from scene_envs.physics.motion import Physics, physics_of
from scene_envs.physics.placement import Objects, flatten, grouped_gaps, object_boxes, part_pairs, place
from scene_envs.physics.projection import Corners, separated
from scene_envs.scene import SceneBatch

_WALL_OVERLAP = 5e-4
"""Overlap (m) with a wall next to an object at which the wall does not support the object."""
_WALL = 1e-2
"""Vertical component of a face normal up to which the face counts as a wall."""
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
    """Moves (B, N, 3), m, that reduce overlap and floating: one round for each scene of a batch on the CPU.

    First, overlapping pieces of generated furniture move apart along the floor, together with the objects on them. Then
    overlapping objects move apart by a least-distance problem, as in :func:`~scene_envs.physics.project`, at distances
    in units of ``spread`` (3,), the standard deviations of positions along the world's axes (only their ratios matter).
    Last, each object moves straight down onto the object less than 3 cm below it. Rotations, fixed objects and those
    that are not ``movable`` (B, N) stay; poses must be finite.

    >>> corrections(SceneBatch.empty("dimsum_table", 1), np.ones(3)).abs().max()
    tensor(0.)
    """
    physics, moves = physics_of(batch.scene_type, "bullet"), np.zeros((*batch.tensor.shape[:2], 3))
    movable = np.ones(batch.tensor.shape[:2], dtype=bool) if movable is None else movable
    cost = 1.0 / np.maximum(spread / max(float(spread.max()), 1e-12), _MIN_SPREAD)
    workspace = batch.scene_type.workspace
    for start in range(0, len(batch), _CHUNK):
        some, free = batch[start : start + _CHUNK], movable[start : start + _CHUNK]
        poses = some.translations.double().numpy(), some.rotations.double().numpy()
        fixed = some.is_welded.numpy() | ~free
        objects = flatten(physics.library, *poses, some.categories.numpy(), fixed)
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


def falls(collider: Collider, objects: Objects, limit: float) -> Array:
    """(n,) m, distance that each free object falls until it meets another one; 0 where it exceeds ``limit``.

    Objects of one or more scenes fall straight down, without turning, the lowest first, so that each follows its
    support. The distance follows from the face planes of the fine parts, and is at most the true one.
    """
    low, high = object_boxes(place(collider.library, objects, "coarse"))
    first, second = scene_pairs(objects)
    upper, lower = np.concatenate([first, second]), np.concatenate([second, first])
    meets: Mask = ~objects.fixed[upper] & (low[lower, 2] < low[upper, 2]) & (low[upper, 2] < high[lower, 2] + limit)
    meets &= (low[lower, :2] <= high[upper, :2]).all(axis=1) & (low[upper, :2] <= high[lower, :2]).all(axis=1)
    upper, lower = upper[meets], lower[meets]
    room = _rooms(collider, objects, upper, lower, limit)
    fall = np.zeros(len(objects))
    order = np.argsort(upper, kind="stable")
    start = np.searchsorted(upper[order], np.arange(len(objects) + 1))
    for row in np.argsort(low[:, 2], kind="stable"):
        some = order[start[row] : start[row + 1]]
        if len(some):
            reach = float((room[some] + fall[lower[some]]).min())
            fall[row] = reach if reach < limit else 0.0
    return fall


def _rooms(collider: Collider, objects: Objects, upper: Index, lower: Index, limit: float) -> Array:
    """(P,) m, vertical distance of two objects, infinite where one passes the other."""
    room = np.full(len(upper), np.inf)
    if not len(upper):
        return room
    used, local = np.unique(np.concatenate([lower, upper]), return_inverse=True)
    placed = place(collider.library, objects[used], "fine")
    pair, a, b = part_pairs(placed, local[: len(lower)], local[len(lower) :])
    near = (placed.low[a, :2] <= placed.high[b, :2]).all(axis=1) & (placed.low[b, :2] <= placed.high[a, :2]).all(axis=1)
    near &= (placed.low[b, 2] < placed.high[a, 2] + limit) & (placed.low[a, 2] < placed.high[b, 2])
    pair, a, b = pair[near], a[near], b[near]
    offset = objects.translation[upper] - objects.translation[lower]
    for rows, gaps, normals in grouped_gaps(collider.library, placed.parts, a, b, offset[pair]):
        speed = -normals[..., 2]  # change of a gap per metre of fall
        with np.errstate(divide="ignore", invalid="ignore"):
            when = -gaps / speed
        at_wall = ((np.abs(speed) < _WALL) & (gaps >= -_WALL_OVERLAP)).any(axis=1)
        enter = np.where(speed < -_WALL, when, -np.inf).max(axis=1)
        leave = np.where(speed > _WALL, when, np.inf).min(axis=1)
        meets = ~at_wall & (enter < leave) & (leave > 0)
        np.minimum.at(room, pair[rows[meets]], np.maximum(enter[meets], 0.0))
    return room


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
