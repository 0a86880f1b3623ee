"""Falls: how far objects can come straight down before they meet what is below them."""

from __future__ import annotations

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import Collider, scene_pairs
from scene_envs.physics.placement import Objects, object_boxes, part_pairs, place
from scene_envs.physics.separation import grouped_gaps

_BESIDE = 5e-4
"""Overlap (m) with a wall beside an object that does not hold it up."""
_WALL = 1e-2
"""Vertical component of a face normal up to which the face counts as a wall."""


def falls(collider: Collider, objects: Objects, limit: float) -> Array:
    """(n,) m, how far each free object falls until it meets another one; 0 where that is further than ``limit``.

    Objects fall straight down, without turning, the lowest ones first, so that an object also follows what it stands
    on. The distance follows from the face planes of the fine parts, and is at most the true one.

    Args:
        collider: geometry of the assets.
        objects: of one or more scenes; fixed ones do not fall.
        limit: m.
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
    """Pairs (P,), (P,) of a free object and one that its box may come down on."""
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
        speed = -normals[..., 2]  # of a gap, per metre of fall
        with np.errstate(divide="ignore", invalid="ignore"):
            when = -gaps / speed
        beside = ((np.abs(speed) < _WALL) & (gaps >= -_BESIDE)).any(axis=1)
        enter = np.where(speed < -_WALL, when, -np.inf).max(axis=1)
        leave = np.where(speed > _WALL, when, np.inf).min(axis=1)
        meets = ~beside & (enter < leave) & (leave > 0)
        np.minimum.at(room, pair[rows[meets]], np.maximum(enter[meets], 0.0))
    return room
