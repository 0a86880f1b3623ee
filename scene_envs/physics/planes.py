"""Separating planes between the objects of one scene, and the nearest translations that satisfy all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csr_array

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.budget import Budget
from scene_envs.physics.collision import Collider, scene_pairs
from scene_envs.physics.placement import Objects, object_boxes, part_pairs, place
from scene_envs.physics.rows import Rows
from scene_envs.physics.separation import grouped_gaps
from scene_envs.physics.support import components

CLEARANCE = 2e-5
"""Gap (m) that planes ask for, so that rounding does not leave an overlap."""
_REACH = 0.02
"""Objects nearer than this (m) are kept apart although they do not overlap."""
_SLACK = 300.0
"""Cost of a metre of overlap relative to a metre of distance, squared in the objective."""
_MET = 1e-7
"""A plane broken by less than this (m) is met."""
_APART = 1e-6
"""Parts count as apart when the gap at their best face plane is at least minus this (m)."""
_EXACT = 200
"""Planes up to which the least-distance problem is solved exactly."""
_STEPS = 400
"""Steps of the first-order method that solves larger problems."""
_ITERATIONS = 1e8
"""Matrix entries that the exact method may visit."""
_ROWS_SQUARED = 25.0
"""A least-distance problem costs the square of its number of rows, divided by this, in units of work."""


@dataclass(frozen=True, eq=False)
class Planes(Rows):
    """Half-spaces: ``direction . (x_second - x_first) >= bound``; object -1 is the world's origin."""

    first: Index  # (Q,) object rows, or -1
    second: Index  # (Q,) object rows
    direction: Array  # (Q, 3) unit
    bound: Array  # (Q,) m


def near_pairs(collider: Collider, objects: Objects) -> tuple[Index, Index]:
    """Object pairs of one scene whose boxes are within reach of each other: (P,), (P,)."""
    low, high = object_boxes(place(collider.library, objects, "coarse"))
    first, second = scene_pairs(objects)
    near = ((low[first] <= high[second] + _REACH) & (low[second] <= high[first] + _REACH)).all(axis=1)
    return first[near], second[near]


def separating_planes(
    collider: Collider, objects: Objects, first: Index, second: Index, extra: Array, home: Array, budget: Budget
) -> Planes:
    """Planes that keep object pairs apart.

    Every pair of parts gets a face plane that separates the two parts now. Among several such planes the one with the
    least move away from home is taken. Coarse parts are used where they are already apart, fine ones elsewhere.

    Args:
        collider: Geometry and exact distances.
        objects: Objects of one scene, at their current translations.
        first, second: (P,) object rows.
        extra: (P, 3) vector added to the offset of each pair, m: the minimum translation, for pairs that overlap.
        home: (n, 3) wanted translations of the objects, m.
        budget: Work budget, charged with one unit per plane.
    """
    coarse, apart = _planes_at("coarse", collider, objects, first, second, extra, home)
    budget.spend(len(coarse.pair))
    nested = np.unique(coarse.pair[~apart])
    if not len(nested):
        return coarse.planes(np.ones(len(coarse.pair), dtype=bool))
    kept = coarse.planes(~np.isin(coarse.pair, nested))
    fine, apart = _planes_at("fine", collider, objects, first[nested], second[nested], extra[nested], home)
    budget.spend(len(fine.pair))
    return kept + fine.planes(np.ones(len(fine.pair), dtype=bool))


@dataclass(frozen=True, eq=False)
class _PartPlanes:
    """One plane per near pair of parts; ``pair`` (Q,) is the index of the object pair."""

    pair: Index
    first: Index
    second: Index
    direction: Array
    bound: Array

    def planes(self, rows: Mask) -> Planes:
        """As half-spaces for the objects."""
        return Planes(self.first[rows], self.second[rows], self.direction[rows], self.bound[rows])


def _planes_at(
    level: str, collider: Collider, objects: Objects, first: Index, second: Index, extra: Array, home: Array
) -> tuple[_PartPlanes, Mask]:
    placed = place(collider.library, objects, level)  # type: ignore[arg-type]
    pair, a, b = part_pairs(placed, first, second)
    move = extra[pair]
    near = ((placed.low[a] <= placed.high[b] + move + _REACH) & (placed.low[b] + move <= placed.high[a] + _REACH)).all(
        axis=1
    )
    pair, a, b = pair[near], a[near], b[near]
    offset = objects.translation[second] - objects.translation[first] + extra
    away = (home[second] - home[first] - offset)[pair]
    offset = offset[pair]
    direction, bound, best = np.empty((len(pair), 3)), np.empty(len(pair)), np.empty(len(pair))
    for rows, gaps, normals in grouped_gaps(collider.library, placed.parts, a, b, offset):
        largest = gaps.max(axis=1)
        at_home = gaps + np.einsum("qki,qi->qk", normals, away[rows])
        separates = gaps >= np.minimum(largest, 0.0)[:, None] - _APART
        chosen = np.where(separates, at_home, -np.inf).argmax(axis=1)
        line = np.arange(len(rows))
        direction[rows], best[rows] = normals[line, chosen], largest
        bound[rows] = np.einsum("qi,qi->q", direction[rows], offset[rows]) - gaps[line, chosen] + CLEARANCE
    return _PartPlanes(pair, first[pair], second[pair], direction, bound), best >= -_APART


def nearest(objects: Objects, home: Array, planes: Planes, budget: Budget, cost: Array | None = None) -> Array:
    """Translations (n, 3) nearest to ``home`` that satisfy the planes as well as possible.

    Groups of objects that no plane connects are solved separately. ``budget`` is charged with the rows solved.
    ``cost`` (3,) is the cost of a metre along each axis of the world; None means 1.
    """
    if cost is not None:
        direction = planes.direction / cost
        size = np.linalg.norm(direction, axis=1)
        scaled = Planes(planes.first, planes.second, direction / size[:, None], planes.bound / size)
        return nearest(objects, home * cost, scaled, budget) / cost
    result = home.copy()
    free = ~objects.fixed
    mobile = lambda rows: (rows >= 0) & free[rows]  # noqa: E731
    moves_first, moves_second = mobile(planes.first), mobile(planes.second)
    both = moves_first & moves_second
    label = components(len(objects), planes.first[both], planes.second[both])
    owner = np.where(moves_second, label[planes.second], label[planes.first])
    start = np.where(planes.first[:, None] >= 0, home[planes.first], 0.0)
    needed = planes.bound - np.einsum("qi,qi->q", planes.direction, home[planes.second] - start)
    for block in np.unique(owner[needed > 0]):
        rows = np.flatnonzero(owner == block)
        members = np.flatnonzero((label == block) & free)
        column = np.full(len(objects) + 1, -1, dtype=np.int64)
        column[members] = np.arange(len(members))
        matrix = np.zeros((len(rows), len(members) + 1, 3))
        line = np.arange(len(rows))
        matrix[line, column[planes.second[rows]]] += planes.direction[rows]
        matrix[line, column[planes.first[rows]]] -= planes.direction[rows]
        moved = least_distance(matrix[:, :-1].reshape(len(rows), -1), needed[rows], budget)
        result[members] += moved.reshape(-1, 3)
    return result


def least_distance(matrix: Array, needed: Array, budget: Budget) -> Array:
    """The shortest x with ``matrix @ x + s >= needed``, slack s costing ``_SLACK`` squared.

    Lawson and Hanson's least-distance programme (1974, ch. 23) through non-negative least squares on its dual.
    Most rows hold anyway, so a row joins the problem only when a solution without the row violates it. Problems of
    more than ``_EXACT`` rows, and those on which the exact method fails, are solved approximately. When ``budget`` is
    spent, the last solution is returned.
    """
    x = np.zeros(matrix.shape[1])
    used = needed > 0
    broken = used
    while broken.any() and not budget.is_spent:
        used = used | broken
        rows = np.flatnonzero(used)
        budget.spend(min(len(rows), _EXACT) ** 2 / _ROWS_SQUARED)
        x = _exact(matrix[rows], needed[rows]) if len(rows) <= _EXACT else _approximate(matrix[rows], needed[rows])
        broken = ~used & (matrix @ x < needed - _MET)
    return x


def _exact(matrix: Array, needed: Array) -> Array:
    """Solution with all rows, through non-negative least squares."""
    count, width = matrix.shape
    system = np.vstack([matrix.T, np.eye(count) / _SLACK, needed])
    target = np.zeros(len(system))
    target[-1] = 1.0
    try:
        multipliers, _ = nnls(system, target, maxiter=int(min(30 * count, max(3 * count, _ITERATIONS / system.size))))
    except RuntimeError:  # out of iterations
        return _approximate(matrix, needed)
    residual = system @ multipliers - target
    return -residual[:width] / residual[-1]  # type: ignore[no-any-return]


def _approximate(matrix: Array, needed: Array) -> Array:
    """Solution after a set number of steps of accelerated projected gradient ascent on the dual.

    FISTA (Beck and Teboulle, 2009), started again whenever its momentum points downhill (O'Donoghue and Candes, 2015).
    """
    sparse = csr_array(matrix)
    transposed = csr_array(matrix.T)
    size = abs(sparse)
    step = 1.0 / (float(size.sum(axis=0).max()) * float(size.sum(axis=1).max()) + _SLACK**-2)
    multipliers = ahead = np.zeros(len(needed))
    momentum = 1.0
    for _ in range(_STEPS):
        slope = needed - sparse @ (transposed @ ahead) - ahead / _SLACK**2
        new = np.maximum(ahead + step * slope, 0.0)
        if slope @ (new - multipliers) < 0:
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        ahead = new + (momentum - 1.0) / following * (new - multipliers)
        multipliers, momentum = new, following
    return transposed @ multipliers  # type: ignore[no-any-return]
