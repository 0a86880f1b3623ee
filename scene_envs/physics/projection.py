"""Projection: the nearest translations at which no two objects overlap, rotations kept.

With rotations fixed, the condition that a part lies on one side of a plane with a given normal is exactly linear in the
translations. Each object pair that overlaps gets a minimum translation. The planes that separate its parts after this
translation are consistent with each other, so an object that straddles a thin wall cannot get opposite moves. The
nearest translations that satisfy all planes solve a least-distance problem. Its slack costs far more than distance, so
a crowded scene still has a best-effort solution. Exact depths check the result of every round. Once nothing overlaps,
planes are chosen anew at the solution as long as this shortens the distance moved.

The rounds end when their work budget is spent. Objects that still overlap then are spread to free places, and the
rounds continue from there. Heaps of objects are spread before the first round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls
from scipy.sparse import csr_array

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.collision import Collider, boxes_near, corner_tests, scene_pairs
from scene_envs.physics.parts import LibraryGeometry, Rows
from scene_envs.physics.placement import (
    Budget,
    Level,
    Objects,
    components,
    grouped_gaps,
    object_boxes,
    part_pairs,
    place,
)

CLEARANCE = 2e-5
"""Gap (m) that planes ask for, so that rounding does not leave an overlap."""
REACH = 0.02
"""Objects nearer than this (m) are kept apart although they do not overlap."""
SLACK = 300.0
"""Cost of a metre of overlap relative to a metre of distance, squared in the objective."""
_MET = 1e-7
"""A plane broken by less than this (m) is met."""
_APART = 1e-6
"""Parts count as apart when the gap at their best face plane is at least minus this (m)."""
_EXACT = 200
"""Planes up to which the least-distance problem is solved exactly."""
_MAX_SOLVER_STEPS = 400
"""Steps of the first-order method that solves larger problems."""
_ITERATIONS = 1e8
"""Matrix entries that the exact method may visit."""
_ROWS_SQUARED = 25.0
"""A least-distance problem costs the square of its number of rows, divided by this, in units of work."""
_AROUND = 0.06
"""Parts further apart than this (m) are ignored when a translation is measured."""
_MAX_WALK_STEPS = 6
"""Largest number of steps of a walk; each step leaves one overlapping part."""
STILL = 1e-7
"""Subtracted from speeds, so that none is zero."""
_MAX_SWEEPS = 24
"""Parts that an object may pass one after the other on its way out of another object."""
FAR = 10.0
"""Length (m) of a way that has no end."""
DOWN = 3.0
"""Cost factor of a translation down, out of a fixed object: an object that lies in a board belongs on it."""
UP = 1.4
"""Cost factor of a vertical translation of two free objects: the lower one rests on something and cannot share it."""
BLOCKED = 20.0
"""Cost factor of a translation that leaves the workspace or ends in a fixed object."""
_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_HEAP = 3_000_000
"""A group of objects whose boxes meet may be a heap when it takes more corner tests than this."""
_DEEP = 5e-3
"""Such a group is a heap when objects whose boxes have most in common overlap deeper than this (m)."""
_LOOKED_AT = 3
"""Number of object pairs measured for this: those whose common box is the largest share of the smaller box."""
_WINDOWS = (0.3, 1.0, 4.0, 20.0)
"""Half widths (m) of the cubes around a wanted place that are searched, one after the other."""
_BINS = 16
"""Coordinates tested along each axis come from this many equal intervals, at most two from each."""
_FIXED = 1000
"""Overlapping a box of a fixed object counts as much as overlapping this many free objects."""
Corners = tuple[tuple[float, float, float], tuple[float, float, float]]
TOLERANCE = 1e-4
"""Depth (m) up to which a projected scene counts as free of overlap."""
WORK = 10_000.0
"""Units of work (pairs of convex parts, or rows solved) until a search ends."""
SEARCHES = 5
"""Limit of searches per scene: the first from the given poses, the others after overlapping objects were spread."""
_OVERLAPPING = 2_000_000
"""Limit of corner tests in overlapping object pairs; more are too much work for minimum translations."""
_ROUNDS = 30
"""Largest number of rounds of a search; objects that still overlap after them are not moved further."""
_PATIENCE = 10
"""A search also ends after more rounds than this without any improvement."""
_REFINEMENTS = 8
"""Largest number of rounds spent on shortening the distances moved in a scene that is free of overlap."""
_GAIN = 0.005
"""Relative decrease of the squared distances moved from which another refinement is made."""
_NEGLIGIBLE = 1e-8
"""Sum of squared distances moved (m^2) below which no refinement is made."""
_INSIDE = 1e-5
"""Objects stay this far (m) inside the workspace, so that rounding does not take them out."""
OUTSIDE = 0.05
"""Objects further than this (m) outside the workspace are no part of the arrangement and are not moved back inside."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Translations of one scene's objects after projection."""

    translation: Array  # (n, 3) m
    residual_depth: float  # deepest overlap that is left, m
    total_depth: float  # sum of the overlaps of object pairs that are left, m
    overlapping: Mask  # (n,) bool, objects that still overlap another one
    heap: bool = False  # whether the objects were a heap, which was spread before the first round


@dataclass(frozen=True, eq=False)
class Planes(Rows):
    """Half-spaces: ``direction . (x_second - x_first) >= bound``; object -1 is the world's origin."""

    first: Index  # (Q,) object rows, or -1
    second: Index  # (Q,) object rows
    direction: Array  # (Q, 3) unit
    bound: Array  # (Q,) m


def project_objects(collider: Collider, objects: Objects, workspace: Corners) -> Projection:
    """Project the free objects of one scene; those in the ``workspace`` (m) or close to it end inside it."""
    home = objects.translation
    bounds = _bounds(home, objects, workspace)
    chosen, start, best = heaps(collider, objects), objects, None
    wanted, heap = home, bool(chosen.any())
    for _ in range(SEARCHES):
        if chosen.any():
            wanted = np.where(chosen[:, None], _spread(collider.library, start, chosen, home, bounds), wanted)
        found = replace(_search(collider, replace(objects, translation=wanted), bounds), heap=heap)
        if best is None or found.total_depth < best.total_depth:
            best = found
        if found.residual_depth <= TOLERANCE:
            return found
        chosen, start = found.overlapping & ~objects.fixed, replace(objects, translation=found.translation)
    assert best is not None
    return best


def _search(collider: Collider, objects: Objects, bounds: tuple[Array, Array]) -> Projection:
    """The nearest translations without overlap that a bounded number of rounds finds."""
    home, walls, budget = objects.translation, _walls(bounds), Budget(WORK)
    best, best_way = None, np.inf
    waited = refinements = 0
    current = replace(objects, translation=nearest(objects, home, walls, budget))
    for _ in range(_ROUNDS):
        first, second, measured = _measure(collider, current, budget)
        way = float(((current.translation - home) ** 2).sum())
        is_free = measured.residual_depth <= 0.5 * TOLERANCE
        gain = best_way - way
        waited += 1
        if best is None or (measured.total_depth < best.total_depth and not is_free and best_way == np.inf):
            best, waited = measured, 0
        if is_free and way < best_way:
            best, best_way = measured, way
        if is_free:
            refinements += 1
            if refinements > _REFINEMENTS or way < _NEGLIGIBLE or gain < _GAIN * way:
                break
        elif (
            waited > _PATIENCE or best_way < np.inf
        ):  # a refinement that overlaps: the last result without overlap is kept
            break
        if budget.is_spent or corner_tests(collider.library, current, first, second).sum() > _OVERLAPPING:
            break
        near_first, near_second = pairs = scene_pairs(current)
        near = boxes_near(*object_boxes(place(collider.library, current, "coarse")), *pairs, REACH)
        near_first, near_second = near_first[near], near_second[near]
        extra = np.zeros((len(near_first), 3))
        if len(first):
            rows = np.searchsorted(near_first * len(home) + near_second, first * len(home) + second)
            extra[rows] = _minimum_translations(collider, current, first, second, bounds, budget)
        planes = _separating_planes("coarse", collider, current, near_first, near_second, extra, home, budget)
        current = replace(current, translation=nearest(current, home, planes + walls, budget))
    assert best is not None
    inside = np.clip(best.translation, *bounds)  # slack may have let some leave the workspace
    if (np.abs(inside - best.translation) <= 0.9 * _INSIDE).all():
        return best
    return _measure(collider, replace(objects, translation=inside), budget)[2]


def _measure(collider: Collider, objects: Objects, budget: Budget) -> tuple[Index, Index, Projection]:
    """Object pairs whose fine parts overlap deeper than half the tolerance, and the overlap of the whole scene."""
    pairs = collider.pairs(objects)
    budget.spent += len(pairs.contacts.gap)
    deep = pairs.depth > 0.5 * TOLERANCE
    first, second = pairs.first[deep], pairs.second[deep]
    overlapping = np.isin(np.arange(len(objects)), np.concatenate([first, second]))
    residual, total = float(pairs.depth.max(initial=0.0)), float(pairs.depth.sum())
    return first, second, Projection(objects.translation, residual, total, overlapping)


def _bounds(home: Array, objects: Objects, workspace: Corners) -> tuple[Array, Array]:
    """Lowest and highest translations (n, 3); infinite for fixed objects and for objects far outside."""
    low, high = np.array(workspace[0]), np.array(workspace[1])
    loose = objects.fixed | ((home < low - OUTSIDE) | (home > high + OUTSIDE)).any(axis=1)
    return np.where(loose[:, None], -np.inf, low + _INSIDE), np.where(loose[:, None], np.inf, high - _INSIDE)


def _walls(bounds: tuple[Array, Array]) -> Planes:
    """The bounds as half-spaces."""
    low, high = (np.nonzero(np.isfinite(limit)) for limit in bounds)
    row, axis = np.concatenate([low[0], high[0]]), np.concatenate([low[1], high[1]])
    sign = np.repeat([1.0, -1.0], [len(low[0]), len(high[0])])
    limits = np.concatenate([bounds[0][low], -bounds[1][high]])
    direction = np.zeros((len(row), 3))
    direction[np.arange(len(row)), axis] = sign
    return Planes(np.full(len(row), -1, dtype=np.int64), row, direction, limits)


def heaps(collider: Collider, objects: Objects) -> Mask:
    """(n,) free objects of one scene in groups that overlap so much that exact tests would take too long. Objects
    nested as intended meet as many others but hardly overlap, so they are no heap.
    """
    low, high = object_boxes(place(collider.library, objects, "coarse"))
    first, second = scene_pairs(objects)
    meet = ((low[first] < high[second]) & (low[second] < high[first])).all(axis=1)
    first, second = first[meet], second[meet]
    free = ~objects.fixed
    both = free[first] & free[second]
    group = components(len(objects), first[both], second[both])
    owner = group[np.where(free[first], first, second)]
    tests = np.bincount(owner, weights=corner_tests(collider.library, objects, first, second), minlength=len(objects))
    chosen = np.zeros(len(objects), dtype=bool)
    for number in np.flatnonzero(tests > _HEAP):
        a, b = first[owner == number], second[owner == number]
        common = np.prod(np.minimum(high[a], high[b]) - np.maximum(low[a], low[b]), axis=1)
        smaller = np.minimum(np.prod(high[a] - low[a], axis=1), np.prod(high[b] - low[b], axis=1))
        most = np.argsort(-common / np.maximum(smaller, 1e-12), kind="stable")[:_LOOKED_AT]
        looked_at = objects[np.unique(np.concatenate([a[most], b[most]]))]
        if collider.pairs(looked_at).depth.max(initial=0.0) > _DEEP:
            chosen |= free & (group == number)
    return chosen


def _separating_planes(
    level: Level,
    collider: Collider,
    objects: Objects,
    first: Index,
    second: Index,
    extra: Array,
    home: Array,
    budget: Budget,
) -> Planes:
    """Planes that keep object pairs (P,) of one scene apart; ``budget`` is charged with one unit per plane.

    Every pair of parts gets the face plane that separates the two now with the least move away from ``home`` (n, 3) m:
    of coarse parts where they are already apart, of fine ones elsewhere. ``extra`` (P, 3) m is added to the offset of
    each pair: the minimum translation of those that overlap.
    """
    placed = place(collider.library, objects, level)
    pair, a, b = part_pairs(placed, first, second)
    move = extra[pair]
    near = (placed.low[a] <= placed.high[b] + move + REACH).all(axis=1)
    near &= (placed.low[b] + move <= placed.high[a] + REACH).all(axis=1)
    pair, a, b = pair[near], a[near], b[near]
    budget.spent += len(pair)
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
    planes = Planes(first[pair], second[pair], direction, bound)
    nested = np.unique(pair[best < -_APART])
    if level == "fine" or not len(nested):
        return planes
    some = first[nested], second[nested], extra[nested]
    return planes[~np.isin(pair, nested)] + _separating_planes("fine", collider, objects, *some, home, budget)


def nearest(objects: Objects, home: Array, planes: Planes, budget: Budget) -> Array:
    """Translations (n, 3) nearest to ``home`` that satisfy the planes as well as possible. Groups of objects that no
    plane connects are solved separately; ``budget`` is charged with the rows solved.
    """
    result = home.copy()
    free = ~objects.fixed
    moves_first, moves_second = ((rows >= 0) & free[rows] for rows in (planes.first, planes.second))
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
    """The shortest x with ``matrix @ x + s >= needed``, slack s costing ``SLACK`` squared.

    Lawson and Hanson's least-distance programme (1974, ch. 23) through non-negative least squares on its dual. Most
    rows hold anyway, so a row joins only when a solution without it violates it. Problems of more than ``_EXACT`` rows,
    and those on which the exact method fails, are solved approximately. A spent ``budget`` ends with the last solution.
    """
    x = np.zeros(matrix.shape[1])
    used = needed > 0
    broken = used
    while broken.any() and not budget.is_spent:
        used = used | broken
        rows = np.flatnonzero(used)
        budget.spent += min(len(rows), _EXACT) ** 2 / _ROWS_SQUARED
        x = _exact(matrix[rows], needed[rows]) if len(rows) <= _EXACT else _approximate(matrix[rows], needed[rows])
        broken = ~used & (matrix @ x < needed - _MET)
    return x


def _exact(matrix: Array, needed: Array) -> Array:
    """Solution with all rows, through non-negative least squares."""
    count, width = matrix.shape
    system = np.vstack([matrix.T, np.eye(count) / SLACK, needed])
    target = np.zeros(len(system))
    target[-1] = 1.0
    try:
        multipliers, _ = nnls(system, target, maxiter=int(min(30 * count, max(3 * count, _ITERATIONS / system.size))))
    except RuntimeError:  # out of iterations
        return _approximate(matrix, needed)
    residual = system @ multipliers - target
    return -residual[:width] / residual[-1]  # type: ignore[no-any-return]


def _approximate(matrix: Array, needed: Array) -> Array:
    """Solution after a set number of steps of accelerated projected gradient ascent on the dual: FISTA (Beck and
    Teboulle, 2009), started again whenever its momentum points downhill (O'Donoghue and Candes, 2015).
    """
    sparse = csr_array(matrix)
    transposed = csr_array(matrix.T)
    size = abs(sparse)
    step = 1.0 / (float(size.sum(axis=0).max()) * float(size.sum(axis=1).max()) + SLACK**-2)
    multipliers = ahead = np.zeros(len(needed))
    momentum = 1.0
    for _ in range(_MAX_SOLVER_STEPS):
        slope = needed - sparse @ (transposed @ ahead) - ahead / SLACK**2
        new = np.maximum(ahead + step * slope, 0.0)
        if slope @ (new - multipliers) < 0:
            momentum = 1.0
        following = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        ahead = new + (momentum - 1.0) / following * (new - multipliers)
        multipliers, momentum = new, following
    return transposed @ multipliers  # type: ignore[no-any-return]


def _minimum_translations(
    collider: Collider, objects: Objects, first: Index, second: Index, bounds: tuple[Array, Array], budget: Budget
) -> Array:
    """(P, 3) m: translations that free overlapping object pairs when they are added to the offsets of the pairs.
    ``budget`` is charged with one unit per pair of parts.
    """
    placed = place(collider.library, objects, "fine")
    pair, a, b = part_pairs(placed, first, second)
    near = boxes_near(placed.low, placed.high, a, b, _AROUND)
    pair, a, b = pair[near], a[near], b[near]
    budget.spent += len(pair)
    offset = objects.translation[second] - objects.translation[first]
    groups = list(grouped_gaps(collider.library, placed.parts, a, b, offset[pair]))
    directions = _directions(objects, first, second, pair, groups, bounds)
    lengths = _lengths(pair, groups, directions)
    best = (lengths * _weights(objects, first, second, directions, lengths, bounds)).argmin(axis=1)
    line = np.arange(len(first))
    return directions[line, best] * (lengths[line, best] + CLEARANCE)[:, None]  # type: ignore[no-any-return]


def _directions(
    objects: Objects,
    first: Index,
    second: Index,
    pair: Index,
    groups: list[tuple[Index, Array, Array]],
    bounds: tuple[Array, Array],
) -> Array:
    """(P, D, 3) directions to try: the axes, the level directions away from and toward the other object, face normals
    of the deepest and of the shallowest overlap of parts, and the direction of a walk: the sum of several steps, each
    out of the part that is then the deepest, which leads out of corners. From fixed objects, steps down and steps out
    of the workspace are avoided.
    """
    level = (objects.translation[second] - objects.translation[first]) * [1.0, 1.0, 0.0]
    length = np.linalg.norm(level, axis=1, keepdims=True)
    level = np.where(length > 1e-6, level / np.maximum(length, 1e-6), [1.0, 0.0, 0.0])
    directions = np.stack([*np.broadcast_to(_AXES[:, None], (6, *level.shape)), level, -level, *[level] * 3], axis=1)
    free = np.where(objects.fixed[first], second, first)
    sign = np.where(objects.fixed[first], 1.0, -1.0)
    held = objects.fixed[first] | objects.fixed[second]
    walk = np.zeros((len(first), 3))
    for step in range(_MAX_WALK_STEPS):
        depth, normal = np.zeros(len(pair)), np.zeros((len(pair), 3))
        for rows, gaps, normals in groups:
            owner = pair[rows]
            now = gaps + np.einsum("qki,qi->qk", normals, walk[owner])
            cost = now.copy()
            q = np.flatnonzero(held[owner] & (now < 0).all(axis=1))
            if len(q):
                moved = normals[q] * sign[owner[q], None, None]
                here = objects.translation[free[owner[q]]] + sign[owner[q], None] * walk[owner[q]]
                there = here[:, None] - moved * now[q][..., None]
                low, high = (bound[free[owner[q]]][:, None] for bound in bounds)
                leaves = ((there < low) | (there > high)).any(axis=2)
                cost[q] *= np.where(leaves, BLOCKED, np.where(moved[..., 2] < -0.7, DOWN, 1.0))
            best = cost.argmax(axis=1)
            line = np.arange(len(rows))
            depth[rows], normal[rows] = -now[line, best], normals[line, best]
        inside = np.flatnonzero(depth > 1e-7)
        order = inside[np.lexsort((-depth[inside], pair[inside]))]
        owner, deepest, count = np.unique(pair[order], return_index=True, return_counts=True)
        if not len(owner):
            break
        if not step:
            directions[owner, -3], directions[owner, -2] = normal[order[deepest]], normal[order[deepest + count - 1]]
        walk[owner] += normal[order[deepest]] * (depth[order[deepest]] + 1e-7)[:, None]
    length = np.linalg.norm(walk, axis=1)
    directions[length > 0, -1] = walk[length > 0] / length[length > 0, None]
    return directions


def _lengths(pair: Index, groups: list[tuple[Index, Array, Array]], directions: Array) -> Array:
    """(P, D) m: length of the move in each direction until no parts overlap."""
    enter = np.empty((len(pair), directions.shape[1]))
    leave = np.empty_like(enter)
    for rows, gaps, normals in groups:
        speed = directions[pair[rows]] @ normals.swapaxes(1, 2) - STILL  # (Q, D, K)
        when = -gaps[:, None] / speed
        enter[rows] = np.where(speed < 0, when, -np.inf).max(axis=2)
        leave[rows] = np.where(speed < 0, np.inf, when).min(axis=2)
    length = np.zeros(directions.shape[:2])
    for _ in range(_MAX_SWEEPS):
        here = length[pair] + STILL
        further = (enter < here) & (leave > here)
        if not further.any():
            break
        row, column = np.nonzero(further)
        np.maximum.at(length, (pair[row], column), leave[further])
    return np.minimum(length, FAR)


def _weights(
    objects: Objects, first: Index, second: Index, directions: Array, lengths: Array, bounds: tuple[Array, Array]
) -> Array:
    """(P, D) cost factors of a metre in each direction."""
    fixed = objects.fixed[first] | objects.fixed[second]
    # The motion of the free object, or of the upper one of two.
    first_above = objects.fixed[second] | (objects.translation[first, 2] > objects.translation[second, 2])
    upper = np.where(~objects.fixed[first] & first_above, first, second)
    motion = np.where((upper == second)[:, None, None], directions, -directions)
    rise, held = motion[..., 2], fixed[:, None]
    weight = np.where(held & (rise < -0.7), DOWN, 1.0) * np.where(~held & (np.abs(rise) > 0.7), UP, 1.0)
    target = objects.translation[upper][:, None] + motion * lengths[..., None]
    low, high = (bound[upper][:, None] for bound in bounds)
    leaves = ((target < low - 1e-6) | (target > high + 1e-6)).any(axis=2)
    return np.where(leaves & (held | (rise > 0.7)), weight * BLOCKED, weight)


def _spread(
    library: LibraryGeometry, objects: Objects, chosen: Mask, wanted: Array, bounds: tuple[Array, Array]
) -> Array:
    """Translations (n, 3) m, near the ``wanted`` ones (n, 3), at which the boxes of the chosen objects meet no other,
    or as few as possible where there is no room. Objects that are not chosen stay.
    """
    coarse = place(library, objects, "coarse")
    low, high = object_boxes(coarse)
    rows = np.flatnonzero(chosen)
    order = rows[np.argsort(-np.prod(high[rows] - low[rows], axis=1), kind="stable")]
    low_of, high_of = low[order] - objects.translation[order], high[order] - objects.translation[order]
    owner = np.repeat(np.arange(len(objects)), coarse.count)
    boards, others = objects.fixed[owner], ~objects.fixed & ~chosen
    lows = np.concatenate([coarse.low[boards], low[others], np.empty((len(order), 3))])
    highs = np.concatenate([coarse.high[boards], high[others], np.empty((len(order), 3))])
    weight = np.ones(len(lows), dtype=np.int64)
    weight[: int(boards.sum())] = _FIXED
    count = len(lows) - len(order)
    result = objects.translation.copy()
    for row, box_low, box_high in zip(order, low_of, high_of, strict=True):
        limits = (bounds[0][row], bounds[1][row])
        blocked = (lows[:count] - box_high - CLEARANCE, highs[:count] - box_low + CLEARANCE)
        result[row] = _free_place(np.clip(wanted[row], *limits), *blocked, weight[:count], limits)
        lows[count], highs[count] = result[row] + box_low, result[row] + box_high
        count += 1
    return result


def _free_place(wanted: Array, low: Array, high: Array, weight: Index, limits: tuple[Array, Array]) -> Array:
    """The place (3,) near ``wanted`` that lies in the fewest of the blocked open boxes ``low``, ``high`` (M, 3), in
    none if there is such a place. A box counts as ``weight`` (M,) boxes.
    """
    found = wanted
    for reach in _WINDOWS:
        start, end = np.maximum(wanted - reach, limits[0]), np.minimum(wanted + reach, limits[1])
        near = ((low < end) & (high > start)).all(axis=1)
        lines = [
            _lines(np.concatenate([low[near, axis], high[near, axis]]), wanted[axis], start[axis], end[axis])
            for axis in range(3)
        ]
        spans = [
            map(slice, np.searchsorted(line, a, "right").tolist(), np.searchsorted(line, b).tolist())
            for line, a, b in zip(lines, low[near].T, high[near].T, strict=True)
        ]
        crowd = np.zeros(list(map(len, lines)), dtype=np.int32)
        for *span, load in zip(*spans, weight[near].tolist(), strict=True):
            crowd[tuple(span)] += load
        x, y, z = ((line - middle) ** 2 for line, middle in zip(lines, wanted, strict=True))
        least = crowd.min()
        way = np.where(crowd == least, x[:, None, None] + y[:, None] + z, np.inf)
        best = np.unravel_index(int(way.argmin()), way.shape)
        found = np.array([line[index] for line, index in zip(lines, best, strict=True)])
        if least == 0:
            break
    return found


def _lines(faces: Array, wanted: float, start: float, end: float) -> Array:
    """Ascending coordinates to test: the wanted one, both ends, and faces between them, thinned evenly."""
    inside = np.sort(faces[(faces > start) & (faces < end)])
    bins = np.minimum((inside - start) / max(end - start, 1e-12) * _BINS, _BINS - 1).astype(np.int64)
    lowest = np.searchsorted(bins, np.arange(_BINS))
    highest = np.searchsorted(bins, np.arange(_BINS), "right") - 1
    used = highest >= lowest
    return np.unique(np.concatenate([[wanted, start, end], inside[lowest[used]], inside[highest[used]]]))
