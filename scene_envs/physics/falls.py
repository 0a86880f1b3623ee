"""Distances that objects fall straight down until they meet another object."""

from __future__ import annotations

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import Collider, scene_pairs
from scene_envs.physics.placement import Objects, object_boxes, part_pairs, place
from scene_envs.physics.separation import grouped_gaps

_WALL_OVERLAP = 5e-4
"""Overlap (m) with a wall next to an object at which the wall does not support the object."""
_WALL = 1e-2
"""Vertical component of a face normal up to which the face counts as a wall."""


def falls(collider: Collider, objects: Objects, limit: float) -> Array:
    """(n,) m, distance that each free object falls until it meets another one; 0 where it exceeds ``limit``.

    Objects (n,) of one or more scenes fall straight down, without turning, the lowest ones first, so that an object
    follows its support. Fixed objects do not fall. The distance follows from the face planes of the fine parts, and is
    at most the true one.
    """
    low, high = object_boxes(place(collider.library, objects, "coarse"))
    upper, lower = _over(objects, low, high, limit)
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


def _over(objects: Objects, low: Array, high: Array, limit: float) -> tuple[Index, Index]:
    """Pairs (P,), (P,) of a free object and one that its box may fall on."""
    first, second = scene_pairs(objects)
    upper, lower = np.concatenate([first, second]), np.concatenate([second, first])
    meets: Mask = ~objects.fixed[upper] & (low[lower, 2] < low[upper, 2]) & (low[upper, 2] < high[lower, 2] + limit)
    meets &= (low[lower, :2] <= high[upper, :2]).all(axis=1) & (low[upper, :2] <= high[lower, :2]).all(axis=1)
    return upper[meets], lower[meets]


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
