"""Projection: the nearest translations at which no two objects overlap, rotations kept.

With rotations fixed, "this part lies on that side of a plane with normal d" is exactly linear in the
translations. Each overlapping object pair gets one direction, shared by all its parts, so that a thin wall
that is straddled cannot ask for opposite moves; the nearest point under those planes is a least-distance
problem, solved exactly (Lawson and Hanson 1974, ch. 23) with slack that costs far more than distance, so
that a crowded scene has a best effort. FCL has the last word after every round.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from scene_envs.physics.collision import Collider, scene_pairs
from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.placement import Objects, object_boxes, part_pairs, place
from scene_envs.physics.separation import separations

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Pair = tuple[int, int]

TOLERANCE = 1e-4
"""Depth (m) up to which a projected scene counts as free of overlap."""
_CLEARANCE = 2e-5
"""Gap (m) that planes ask for, so that rounding does not leave an overlap."""
_REACH = 5e-3
"""Part pairs nearer than this (m) are kept apart although they do not overlap yet."""
_SLACK = 300.0
"""How much more a metre of overlap costs than a metre of distance, squared in the objective."""
_ROUNDS = 16
_PATIENCE = 3
"""Rounds after which a pair that still overlaps is separated vertically: up, there is always room."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """Near pairs of coarse parts of one scene.

    Attributes:
        first: (Q,) object rows.
        second: (Q,) object rows, larger.
        part_first: (Q,) part of the first object in the library.
        part_second: (Q,) part of the second.
        gap: (Q,) m along ``direction``.
        direction: (Q, 3) unit, from the first part to the second.
    """

    first: Index
    second: Index
    part_first: Index
    part_second: Index
    gap: Array
    direction: Array


@dataclass(frozen=True, eq=False)
class Projection:
    """Translations (n, 3) m after projection, and the deepest overlap that is left, m."""

    translation: Array
    residual_depth: float


class Planes:
    """Separating planes of one scene: for part pairs, ``direction . (x_second - x_first) >= bound``.

    Args:
        library: geometry of the assets.
        objects: the objects of the scene; their rotations stay as they are.
    """

    def __init__(self, library: LibraryGeometry, objects: Objects) -> None:
        self.library, self.objects = library, objects
        self.direction: dict[Pair, Array] = {}
        self._bounds: dict[tuple[int, int, int, int], float] = {}

    def add(self, pair: Pair, parts: list[Pair]) -> None:
        """Separate these part pairs of an object pair along its direction."""
        for part in parts:
            self._bounds.setdefault((*pair, *part), self.bound(pair, part, self.direction[pair]))

    def redirect(self, pair: Pair, direction: Array) -> None:
        """Give an object pair another direction, for all its part pairs."""
        self.direction[pair] = direction
        for key in [key for key in self._bounds if key[:2] == pair]:
            self._bounds[key] = self.bound(pair, key[2:], direction)

    def bound(self, pair: Pair, parts: Pair, direction: Array) -> float:
        """How far apart two objects must be along ``direction`` for these parts to be separate, m."""
        first, second = (
            self.library.parts[part].vertices @ (self.objects.rotation[row].T @ direction)
            for row, part in zip(pair, parts, strict=True)
        )
        return float(first.max() - second.min())

    def nearest(self, origin: Array) -> Array:
        """Translations (n, 3) nearest to ``origin`` that satisfy the planes, as well as they can be."""
        if not self._bounds:
            return origin
        keys = list(self._bounds)
        rows = np.arange(len(keys))
        first, second = np.array([key[0] for key in keys]), np.array([key[1] for key in keys])
        normal = np.stack([self.direction[key[:2]] for key in keys])
        bound = np.array([self._bounds[key] for key in keys]) + _CLEARANCE
        needed = bound - np.einsum("ij,ij->i", normal, origin[second] - origin[first])
        jacobian = np.zeros((len(keys), len(origin), 3))
        jacobian[rows, second] += normal
        jacobian[rows, first] -= normal
        jacobian[:, self.objects.fixed] = 0.0
        return origin + _least_distance(jacobian.reshape(len(keys), -1), needed).reshape(-1, 3)


def _least_distance(matrix: Array, needed: Array) -> Array:
    """The shortest x with ``matrix @ x + s >= needed``, slack s costing ``_SLACK`` squared.

    Lawson and Hanson's least-distance programme through non-negative least squares on its dual.
    """
    used = np.flatnonzero(np.abs(matrix).max(axis=0) > 0)
    if not len(used) or needed.max() <= 0:
        return np.zeros(matrix.shape[1])
    elastic = np.hstack([matrix[:, used], np.eye(len(needed)) / _SLACK])
    system = np.vstack([elastic.T, needed])
    target = np.zeros(len(system))
    target[-1] = 1.0
    multipliers, _ = nnls(system, target, maxiter=30 * len(needed))
    residual = system @ multipliers - target
    x = np.zeros(matrix.shape[1])
    x[used] = -residual[: len(used)] / residual[-1]
    return x


def project_objects(library: LibraryGeometry, collider: Collider, objects: Objects) -> Projection:
    """Project the objects of one scene.

    Args:
        library: geometry of the assets.
        collider: measures overlap.
        objects: one scene; fixed objects do not move.
    """
    planes = Planes(library, objects)
    best = Projection(objects.translation, np.inf)
    current = objects
    for round_number in range(_ROUNDS):
        overlapping, residual = _overlapping(collider, current)
        if residual < best.residual_depth:
            best = Projection(current.translation, residual)
        if not overlapping:
            break
        contacts = near_contacts(library, current)
        _update(planes, contacts, current, overlapping, vertical=round_number >= _PATIENCE)
        current = replace(current, translation=planes.nearest(objects.translation))
    return best


def near_contacts(library: LibraryGeometry, objects: Objects) -> Contacts:
    """All part pairs of one scene nearer than ``_REACH``."""
    placed = place(library, objects, "coarse")
    low, high = object_boxes(placed)
    first, second = scene_pairs(objects)
    near = ((low[first] <= high[second] + _REACH) & (low[second] <= high[first] + _REACH)).all(axis=1)
    first, second = first[near], second[near]
    pair, a, b = part_pairs(placed, first, second)
    near = ((placed.low[a] <= placed.high[b] + _REACH) & (placed.low[b] <= placed.high[a] + _REACH)).all(axis=1)
    pair, a, b = pair[near], a[near], b[near]
    gap, direction = separations(library, placed.parts, a, b)
    near = gap < _REACH
    pair, a, b, gap, direction = pair[near], a[near], b[near], gap[near], direction[near]
    part = placed.parts.part
    return Contacts(first[pair], second[pair], part[a], part[b], gap, direction)


def _overlapping(collider: Collider, objects: Objects) -> tuple[set[Pair], float]:
    """Object pairs whose fine parts overlap beyond the tolerance, and the deepest overlap."""
    pairs = collider.pairs(objects)
    deep = pairs.depth > 0.5 * TOLERANCE
    found = set(zip(pairs.first[deep].tolist(), pairs.second[deep].tolist(), strict=True))
    return found, float(pairs.depth.max(initial=0.0))


def _update(planes: Planes, contacts: Contacts, objects: Objects, overlapping: set[Pair], *, vertical: bool) -> None:
    """Add planes for overlapping pairs, and for pairs that touch or nearly do."""
    rows: dict[Pair, list[int]] = {}
    for row, pair in enumerate(zip(contacts.first.tolist(), contacts.second.tolist(), strict=True)):
        rows.setdefault(pair, []).append(row)
    for pair, members in rows.items():
        deepest = min(members, key=lambda row: contacts.gap[row])
        if pair in overlapping:
            if vertical and pair in planes.direction:
                planes.redirect(pair, _upward(objects, pair))
            elif pair not in planes.direction:
                planes.direction[pair] = _shortest_way(planes, contacts, objects, pair, members)
            inside = [row for row in members if contacts.gap[row] < _CLEARANCE]
            planes.add(pair, [_parts(contacts, row) for row in inside])
        elif pair not in planes.direction and contacts.gap[deepest] > -_CLEARANCE:
            # Apart now; keep it so. (Coarse parts that overlap while fine ones do not are left alone.)
            planes.direction[pair] = contacts.direction[deepest]
            planes.add(pair, [_parts(contacts, deepest)])


def _shortest_way(planes: Planes, contacts: Contacts, objects: Objects, pair: Pair, members: list[int]) -> Array:
    """The direction along which all overlapping parts of a pair come apart with the smallest move."""
    inside = [row for row in members if contacts.gap[row] < 0] or members
    offset = objects.translation[pair[1]] - objects.translation[pair[0]]
    best, best_move = contacts.direction[inside[0]], np.inf
    for direction in np.unique(np.round(contacts.direction[inside], 9), axis=0):
        unit = direction / np.linalg.norm(direction)
        move = max(planes.bound(pair, _parts(contacts, row), unit) for row in inside) - float(unit @ offset)
        if move < best_move:
            best, best_move = unit, move
    return best


def _upward(objects: Objects, pair: Pair) -> Array:
    """Vertical, from the lower object to the higher; a fixed object counts as the lower one."""
    first, second = pair
    if objects.fixed[first] != objects.fixed[second]:
        second_is_higher = bool(objects.fixed[first])
    else:
        second_is_higher = bool(objects.translation[second, 2] >= objects.translation[first, 2])
    return np.array([0.0, 0.0, 1.0 if second_is_higher else -1.0])


def _parts(contacts: Contacts, row: int) -> Pair:
    return int(contacts.part_first[row]), int(contacts.part_second[row])
