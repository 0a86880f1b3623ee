"""Minimum translations: the shortest straight moves that free overlapping object pairs.

A convex part that moves along a straight line overlaps another convex part during one interval, which follows from the
face planes of both. A translation frees an object pair when it lies outside the intervals of all pairs of their parts:
next to the other object, above it, or in its hollow.
"""

from __future__ import annotations

import numpy as np

from scene_envs.arrays import Array, Index
from scene_envs.physics.budget import Budget
from scene_envs.physics.collision import Collider
from scene_envs.physics.placement import Objects, object_boxes, part_pairs, place
from scene_envs.physics.planes import CLEARANCE
from scene_envs.physics.separation import grouped_gaps

_AROUND = 0.06
"""Parts further apart than this (m) are ignored when a translation is measured."""
_OWN = 4
"""Face directions tried per object pair from its deepest parts, and from its shallowest, besides the common ones."""
_STEPS = 6
"""Largest number of steps of a walk; each step leaves one overlapping part."""
_DOWN = 3.0
"""Cost factor of a translation down, out of a fixed object: an object that lies in a board belongs on it."""
_UP = 1.4
"""Cost factor of a vertical translation of two free objects: the lower one rests on something and cannot share it."""
_BLOCKED = 20.0
"""Cost factor of a translation that leaves the workspace or ends in a fixed object."""
_REPEATED = 2.5
"""Cost factor of a direction for each time that it was tried and did not help."""
_SAME_DIRECTION = 0.7
"""Cosine above which two directions count as the same."""
_AXES = np.concatenate([np.eye(3), -np.eye(3)])

Tried = dict[tuple[int, int], list[Array]]
"""The directions tried for each object pair so far."""


def minimum_translations(
    collider: Collider,
    objects: Objects,
    first: Index,
    second: Index,
    bounds: tuple[Array, Array],
    tried: Tried,
    budget: Budget,
    cost: Array | None = None,
) -> Array:
    """(P, 3) m: translations that free overlapping object pairs when they are added to the offsets of the pairs.

    Args:
        collider: Geometry of the assets.
        objects: Objects of one scene.
        first, second: (P,) object rows.
        bounds: Lowest and highest translations (n, 3), (n, 3) m.
        tried: Directions that did not help; the directions of the returned translations are added to them.
        budget: Work budget, charged with one unit per pair of parts.
        cost: (3,) cost of a metre along each axis of the world; None for 1.
    """
    placed = place(collider.library, objects, "fine")
    pair, a, b = part_pairs(placed, first, second)
    near = ((placed.low[a] <= placed.high[b] + _AROUND) & (placed.low[b] <= placed.high[a] + _AROUND)).all(axis=1)
    pair, a, b = pair[near], a[near], b[near]
    budget.spend(len(pair))
    offset = objects.translation[second] - objects.translation[first]
    groups = list(grouped_gaps(collider.library, placed.parts, a, b, offset[pair]))
    walk = _walk(objects, first, second, pair, groups, bounds)
    directions = _directions(len(first), pair, groups, offset, walk)
    lengths = _lengths(len(first), pair, groups, directions)
    costs = lengths * _weights(collider, objects, first, second, directions, lengths, bounds)
    if cost is not None:
        costs *= np.linalg.norm(directions * cost, axis=-1)
    for row, key in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        for old in tried.get(key, ()):
            costs[row, directions[row] @ old > _SAME_DIRECTION] *= _REPEATED
    best = costs.argmin(axis=1)
    line = np.arange(len(first))
    for row, key in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
        tried.setdefault(key, []).append(directions[row, best[row]])
    return directions[line, best] * (lengths[line, best] + CLEARANCE)[:, None]  # type: ignore[no-any-return]


def _directions(count: int, pair: Index, groups: list[tuple[Index, Array, Array]], offset: Array, walk: Array) -> Array:
    """(P, D, 3) directions to try.

    They are the axes, the level directions away from and toward the other object, face normals of the overlapping
    parts, and the direction of ``walk``.
    """
    directions = np.zeros((count, 9 + 2 * _OWN, 3))
    directions[:, :6] = _AXES
    level = offset * np.array([1.0, 1.0, 0.0])
    length = np.linalg.norm(level, axis=1, keepdims=True)
    level = np.where(length > 1e-6, level / np.maximum(length, 1e-6), np.array([1.0, 0.0, 0.0]))
    directions[:, 6], directions[:, 7] = level, -level
    directions[:, 8:] = level[:, None]
    rows = np.concatenate([group[0] for group in groups])
    depth, direction = np.empty(len(rows)), np.empty((len(rows), 3))
    start = 0
    for _, gaps, normals in groups:
        best = gaps.argmax(axis=1)
        line = np.arange(len(best))
        depth[start : start + len(best)], direction[start : start + len(best)] = -gaps[line, best], normals[line, best]
        start += len(best)
    inside = depth > 0
    owner, depth, direction = pair[rows][inside], depth[inside], direction[inside]
    # The deepest parts first, then the shallowest.
    for base, order in ((8, np.lexsort((-depth, owner))), (8 + _OWN, np.lexsort((depth, owner)))):
        _, leading, members = np.unique(owner[order], return_index=True, return_counts=True)
        rank = np.arange(len(order)) - np.repeat(leading, members)
        top = order[rank < _OWN]
        directions[owner[top], base + rank[rank < _OWN]] = direction[top]
    length = np.linalg.norm(walk, axis=1)
    directions[length > 0, -1] = walk[length > 0] / length[length > 0, None]
    return directions


def _walk(
    objects: Objects,
    first: Index,
    second: Index,
    pair: Index,
    groups: list[tuple[Index, Array, Array]],
    bounds: tuple[Array, Array],
) -> Array:
    """(P, 3) m: sum of several steps, each out of the part that is then the deepest; leads out of corners.

    From fixed objects, steps down and steps out of the workspace are avoided.
    """
    free = np.where(objects.fixed[first], second, first)
    sign = np.where(objects.fixed[first], 1.0, -1.0)
    held = objects.fixed[first] | objects.fixed[second]
    walk = np.zeros((len(first), 3))
    for _ in range(_STEPS):
        depth, direction = np.zeros(len(pair)), np.zeros((len(pair), 3))
        for rows, gaps, normals in groups:
            owner = pair[rows]
            now = gaps + np.einsum("qki,qi->qk", normals, walk[owner])
            cost = now.copy()
            q = np.flatnonzero(held[owner] & (now < 0).all(axis=1))
            if len(q):
                step = normals[q] * sign[owner[q], None, None]
                here = objects.translation[free[owner[q]]] + sign[owner[q], None] * walk[owner[q]]
                there = here[:, None] - step * now[q][..., None]
                low, high = (bound[free[owner[q]]][:, None] for bound in bounds)
                leaves = ((there < low) | (there > high)).any(axis=2)
                cost[q] *= np.where(leaves, _BLOCKED, np.where(step[..., 2] < -0.7, _DOWN, 1.0))
            best = cost.argmax(axis=1)
            line = np.arange(len(rows))
            depth[rows], direction[rows] = -now[line, best], normals[line, best]
        order = np.lexsort((-depth, pair))
        owner, leading = np.unique(pair[order], return_index=True)
        deepest = order[leading]
        inside = depth[deepest] > 1e-7
        if not inside.any():
            break
        walk[owner[inside]] += (direction[deepest] * (depth[deepest] + 1e-7)[:, None])[inside]
    return walk


def _lengths(count: int, pair: Index, groups: list[tuple[Index, Array, Array]], directions: Array) -> Array:
    """(P, D) m: length of the move in each direction until no parts overlap."""
    enter = np.full((len(pair), directions.shape[1]), np.inf)
    leave = np.full_like(enter, -np.inf)
    for rows, gaps, normals in groups:
        speed = np.einsum("qki,qdi->qkd", normals, directions[pair[rows]])
        with np.errstate(divide="ignore", invalid="ignore"):
            when = -gaps[..., None] / speed
        never = ((np.abs(speed) < 1e-9) & (gaps[..., None] >= 0)).any(axis=1)
        enter[rows] = np.where(speed < -1e-9, when, -np.inf).max(axis=1)
        leave[rows] = np.where(speed > 1e-9, when, np.inf).min(axis=1)
        enter[rows] = np.where(never, np.inf, enter[rows])
    order = np.argsort(pair, kind="stable")
    enter, leave, owner = enter[order], leave[order], pair[order]
    present, starts = np.unique(owner, return_index=True)
    length = np.zeros((count, directions.shape[1]))
    for _ in range(24):
        here = length[owner]
        inside = (enter < here + 1e-7) & (leave > here + 1e-7)
        further = np.where(inside, leave, 0.0)
        new = np.maximum(length[present], np.maximum.reduceat(further, starts, axis=0))
        if (new <= length[present] + 1e-9).all():
            break
        length[present] = new
    return np.where(np.isfinite(length), length, 10.0)


def _weights(
    collider: Collider,
    objects: Objects,
    first: Index,
    second: Index,
    directions: Array,
    lengths: Array,
    bounds: tuple[Array, Array],
) -> Array:
    """(P, D) cost factors of a metre in each direction."""
    weight = np.ones(lengths.shape)
    fixed = objects.fixed[first] | objects.fixed[second]
    # The motion of the free object, or of the upper one of two.
    upper = np.where(
        objects.fixed[first],
        second,
        np.where(
            objects.fixed[second] | (objects.translation[first, 2] > objects.translation[second, 2]), first, second
        ),
    )
    motion = np.where((upper == second)[:, None, None], directions, -directions)
    weight[fixed[:, None] & (motion[..., 2] < -0.7)] *= _DOWN
    weight[~fixed[:, None] & (np.abs(motion[..., 2]) > 0.7)] *= _UP
    target = objects.translation[upper][:, None] + motion * lengths[..., None]
    low, high = bounds
    leaves = ((target < low[upper][:, None] - 1e-6) | (target > high[upper][:, None] + 1e-6)).any(axis=2)
    weight[leaves & (fixed[:, None] | (motion[..., 2] > 0.7))] *= _BLOCKED
    if objects.fixed.any():
        low, high = object_boxes(place(collider.library, objects, "coarse"))
        boards = place(collider.library, objects[objects.fixed], "coarse")
        rise = np.where(motion[..., 2] > 0.7, lengths, 0.0)  # (P, D)
        over = (boards.low[None, :, :2] < high[upper][:, None, :2]) & (
            boards.high[None, :, :2] > low[upper][:, None, :2]
        )
        above = over.all(axis=2) & (boards.low[None, :, 2] > 0.5 * (low[upper] + high[upper])[:, None, 2])
        room = np.where(above, boards.low[None, :, 2] - high[upper][:, None, 2], np.inf).min(axis=1)
        weight[(rise > np.maximum(room, 0.0)[:, None]) & ~fixed[:, None]] *= _BLOCKED
    return weight
