"""MuJoCo C: models in which any bodies of a library can stand, exact overlaps, and the motion of clusters."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from scene_envs.arrays import Array, Index, Mask, ranges
from scene_envs.physics.engines import DAMPING, LOOK, STILL_ANGLE, STILL_WAY, Course, Engine, Moved, gravity
from scene_envs.physics.parts import FRICTION, apply, matrices, padded, quaternions
from scene_envs.physics.placement import Objects, boxes_meet

TIMESTEP = 0.002
"""Length of a step, s, also in exported MJCF files."""
SOLREF, SOLIMP = (0.004, 1.6), (0.98, 0.99, 0.001, 0.5, 2.0)
"""Softness of all contacts, also in exported MJCF files. Objects at rest sink by micrometres, instead of 0.1 mm with
MuJoCo's defaults. Contacts are damped more than critically, so that overlaps within the limits close in 20 ms, as in
Bullet: with critical damping they close in 4 ms, and the objects hop."""
_FAR = 1e5
"""Height (m) of the first body that is not used, and distance between such bodies."""
_SIZES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 2048, 4096)
"""Numbers of bodies, and of geometries per body, for which models are made."""
_MODELS = 32
"""Number of models that are kept; the one that was used longest ago goes first."""
_ITERATIONS = 200
"""Largest number of iterations of the narrowphase where depths are asked for: more change nothing."""
_THICKNESS = 1e-7
"""A part without extent in some direction gets this one (m) to both sides, since MuJoCo wants a volume."""
_SAME = 1e-6
"""Bodies are moved by up to this (m) in each direction before MuJoCo is asked for their overlaps: it does not notice
the overlap of two meshes with one centre and parallel faces."""
_ROUNDING = 1e-9
"""Overlap (m) that may be a rounding error of bodies that touch."""
_CERTAIN = 3.5e-6
"""Largest difference (m) of MuJoCo's depth and the width of both parts along its normal at which the width is taken as
the depth: the true depth is between the two."""
_ARENA, _ROOMS = 1 << 19, (1, 16)
"""Bytes for the contacts of each body of a model, at least for eight; where they do not suffice, the work is done again
with a model of more room."""
_CONTACTS = 20
"""Contacts whose step costs at least as much as that of a free object, one unit of work."""
_PAIRS = 512
"""Pairs of parts that MuJoCo measures together."""
_CONTACT_BYTES, _SEARCH_BYTES = 1 << 10, 1 << 23
"""Memory for the contact of a pair, and for the search for its depth."""
_CORNERS = (8, 16, 32)
"""Numbers of corners up to which parts share padded arrays."""
_BLOCK = 1 << 16
"""Pairs of parts whose boxes are compared together."""
_TOO_MANY = 600_000
"""Pairs of parts of one scene in the common boxes of their bodies above which overlaps are not measured: they may take
more than a second."""
Sizes = tuple[int, int, int, int]
"""Free bodies, geometries of each, fixed bodies, geometries of each."""
_FULL = [int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL)]
_BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BADQ{name}")) for name in ("POS", "VEL", "ACC")]
_GEOMETRY = ("geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound")
_NODE = ("bvh_aabb", "bvh_child", "bvh_depth", "bvh_nodeid")


@dataclass(frozen=True)
class _Body:
    """The parts of a body, and where their frame is in the body's."""

    parts: Sequence[int]  # numbers of the parts
    rotation: Array  # (3, 3)
    translation: Array  # (3,) m


class _Models:
    """Models with places for bodies of given kinds, and what each kind puts into its place."""

    def __init__(self, parts: Sequence[Array], bodies: Sequence[_Body]) -> None:
        self._parts = parts
        self._stages: dict[tuple[Sizes, int], _Stage] = {}
        spec = scene_spec(parts)
        for body in bodies:
            add_parts(_add_body(spec), body.parts, body.translation, np.roll(quaternions(body.rotation[None])[0], 1))
        model = spec.compile()
        self.geometries = {name: getattr(model, name).copy() for name in _GEOMETRY}
        self.first, self.count = model.body_geomadr[1:].astype(np.int64), model.body_geomnum[1:].astype(np.int64)
        self.nodes = {name: getattr(model, name).copy() for name in _NODE}
        self.root, self.tree = model.body_bvhadr[1:].astype(np.int64), model.body_bvhnum[1:].astype(np.int64)
        leaf = self.nodes["bvh_nodeid"] >= 0
        owner = np.repeat(np.arange(len(bodies)), self.tree)
        self.nodes["bvh_nodeid"][: len(owner)] -= np.where(leaf[: len(owner)], self.first[owner], 0)

    def compile(self, sizes: Sizes, room: int) -> Any:
        """A model with places for bodies of ``sizes``."""
        spec = scene_spec(self._parts)
        # a row of a contact has twelve numbers at most: sparse rows are a tenth to a quarter faster from two bodies on
        spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        spec.memory = room * _ARENA * max(8, sizes[0])
        for free, bodies, geometries in ((True, *sizes[:2]), (False, *sizes[2:])):
            for _ in range(bodies):
                body = _add_body(spec)
                add_parts(body, [0] * geometries)
                if free:
                    body.add_freejoint()
        return spec.compile()

    def stage(self, kind: Index, fixed: Mask, room: int) -> _Stage:
        """The smallest stage with this ``room`` for contacts in which bodies of the given ``kind`` (n,) fit."""
        counts = self.count[kind]
        needed = [(~fixed).sum(), counts[~fixed].max(initial=0), fixed.sum(), counts[fixed].max(initial=0)]
        sizes: Any = tuple(next((size for size in (0, *_SIZES) if size >= count), int(count)) for count in needed)
        stage = self._stages.pop((sizes, room), None) or _Stage(self, sizes, room)
        self._stages[sizes, room] = stage  # the last used one is the last
        if len(self._stages) > _MODELS:
            del self._stages[next(iter(self._stages))]
        return stage


class _Stage:
    """A model and its state, into which bodies are put."""

    def __init__(self, models: _Models, sizes: Sizes, room: int) -> None:
        self._models, self._free = models, sizes[0]
        self.model = models.compile(sizes, room)
        self.data = mujoco.MjData(self.model)
        self.model.geom_sameframe[:] = 0
        self._warnings = self.data.warning.number  # a view
        self._fields = {name: getattr(self.model, name) for name in (*_GEOMETRY, *_NODE)}  # views of the model's arrays
        self._first, self._root = self.model.body_geomadr.astype(np.int64), self.model.body_bvhadr.astype(np.int64)
        self._idle = np.zeros((sizes[0], 7))
        self._idle[:, 2] = _FAR * (1 + np.arange(sizes[0]))
        self._idle[:, 3] = 1.0

    def place(self, kind: Index, fixed: Mask, position: Array, quaternion: Array) -> None:
        """Put bodies of a ``kind`` (n,) into the model, at ``position`` (n, 3) m and ``quaternion`` (n, 4), w first."""
        model, models = self.model, self._models
        number = 1 + np.where(fixed, self._free + np.cumsum(fixed), np.cumsum(~fixed)) - 1
        counts, sizes = models.count[kind], models.tree[kind]
        target, source = ranges(self._first[number], counts)[1], ranges(models.first[kind], counts)[1]
        for name in _GEOMETRY:
            self._fields[name][target] = models.geometries[name][source]
        owner, target = ranges(self._root[number], sizes)
        source = ranges(models.root[kind], sizes)[1]
        for name in _NODE:
            self._fields[name][target] = models.nodes[name][source]
        leaf = models.nodes["bvh_nodeid"][source] >= 0
        self._fields["bvh_nodeid"][target[leaf]] += self._first[number][owner[leaf]].astype(np.int32)
        for field in (model.body_geomnum, model.body_contype, model.body_conaffinity):
            field[:] = 0
        model.body_geomnum[number], model.body_bvhnum[number] = counts, sizes
        model.body_contype[number] = model.body_conaffinity[number] = 1
        model.body_pos[number[fixed]], model.body_quat[number[fixed]] = position[fixed], quaternion[fixed]
        state = self._idle.copy()
        free = int((~fixed).sum())
        state[:free, :3], state[:free, 3:] = position[~fixed], quaternion[~fixed]
        mujoco.mj_resetData(model, self.data)
        self.data.qpos[:] = state.ravel()

    def weigh(self, mass: Array, moments: Array) -> None:
        """Set ``mass`` (m,) kg and principal ``moments`` (m, 3) kg m^2 of the free bodies."""
        model, count = self.model, len(mass)
        model.body_mass[1 : 1 + count] = model.body_subtreemass[1 : 1 + count] = mass
        model.body_inertia[1 : 1 + count] = moments
        # MuJoCo copies the mass matrix of a body that moves freely in the frame of its principal axes from here.
        model.dof_M0[: 6 * count] = np.concatenate([np.repeat(mass[:, None], 3, axis=1), moments], axis=1).ravel()
        weights = np.stack([1.0 / mass, (1.0 / moments).mean(axis=1)], axis=1)
        model.body_invweight0[1 : 1 + count] = weights
        model.dof_invweight0[: 6 * count] = np.repeat(weights, 3, axis=1).ravel()

    @property
    def is_full(self) -> bool:
        """Whether contacts were left out for want of room."""
        return bool(self._warnings[_FULL].any())

    @property
    def is_lost(self) -> bool:
        """Whether the simulation diverged."""
        return bool(self._warnings[_BAD].any())

    def run(self, count: int, duration: float, course: Course) -> Array:
        """Positions and orientations (count, 7) of the first free bodies at the end of a simulation, or at rest."""
        model, data = self.model, self.data
        model.opt.gravity[:] = gravity(course.tilt)
        steps, velocity = max(1, round(duration / TIMESTEP)), data.qvel.reshape(-1, 6)[:count]
        limits = np.repeat((STILL_WAY / duration, STILL_ANGLE / duration), 3)
        for done in range(0, steps, LOOK):
            ahead = min(LOOK, steps - done)
            mujoco.mj_step(model, data, ahead)
            course.budget.spent += ahead * max(count, data.ncon / _CONTACTS)
            if course.budget.is_spent or self.is_full or (np.abs(velocity) < limits).all():
                break
            if course.settling is not None:
                velocity *= (1.0 - DAMPING) ** (ahead * TIMESTEP)
        return data.qpos.reshape(-1, 7)[:count].copy()  # type: ignore[no-any-return]


def scene_spec(parts: Sequence[Array]) -> Any:
    """A specification with the settings of exported files and meshes "part0", "part1", ... of the corners (V, 3) m of
    parts.
    """
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.impratio = TIMESTEP, 10.0
    option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
    for index, corners in enumerate(parts):
        vertices = _solid(corners).ravel().tolist()
        spec.add_mesh(name=f"part{index}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL, uservert=vertices)
    return spec


def _add_body(spec: Any) -> Any:
    return spec.worldbody.add_body(mass=1.0, inertia=(1.0, 1.0, 1.0), explicitinertial=True)


def add_parts(body: Any, parts: Sequence[int], position: Any = (0, 0, 0), quaternion: Any = (1, 0, 0, 0)) -> None:
    """Add geometries of some parts of a specification to a body, with the contacts of exported files."""
    for part in parts:
        geometry = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{part}")
        geometry.pos, geometry.quat = position, quaternion
        geometry.friction[0] = FRICTION
        geometry.solref[:], geometry.solimp[:] = SOLREF, SOLIMP


def _solid(corners: Array) -> Array:
    """The corners (V, 3) m of a part, thickened in directions in which it has no extent."""
    _, extents, axes = np.linalg.svd(np.concatenate([corners - corners.mean(axis=0), np.zeros((3, 3))]))
    for axis in axes[extents[:3] < 1e-9]:
        corners = np.concatenate([corners + _THICKNESS * axis, corners - _THICKNESS * axis])
    return corners


class Overlaps:
    """Exact overlaps of bodies, each a set of convex parts, from the corners (V, 3) m of all parts and the numbers of
    the parts of each kind of body; corners inside the hull of a part are ignored.

    A depth is wrong by less than 4 µm, and in nearly all cases by less than 0.1 µm (benchmarks/narrowphase.py). It
    depends on the two bodies alone, and on those that coincide with one of them.

    >>> cube = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    >>> overlaps = Overlaps([cube], [[0]])
    >>> apart = np.array([(0.0, 0.0, 0.0), (0.2, 0.0, 0.9)])
    >>> poses = np.array([0, 0]), np.eye(3)[None].repeat(2, 0), apart
    >>> first, second, depth, _ = overlaps(*poses, np.array([0]), np.array([1]))
    >>> first.tolist(), second.tolist(), depth.round(6).tolist()
    ([0], [1], [0.1])
    """

    def __init__(self, parts: Sequence[Array], bodies: Sequence[Sequence[int]]) -> None:
        self._parts, self._lock = parts, threading.Lock()
        self._count = np.array([len(ids) for ids in bodies])
        self._first, self._part = np.cumsum(self._count) - self._count, np.concatenate(bodies).astype(np.int64)
        spec = scene_spec(parts)
        spec.option.ccd_iterations, spec.option.disableflags = _ITERATIONS, mujoco.mjtDisableBit.mjDSBL_MULTICCD
        spec.memory = _PAIRS * _CONTACT_BYTES + _SEARCH_BYTES
        _add_body(spec)  # or there are no contacts
        for index in range(max(2 * _PAIRS, len(parts))):
            geometry = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, name=f"{index}", contype=0)
            geometry.meshname, geometry.conaffinity = f"part{index % len(parts)}", 0
        for index in range(_PAIRS):
            spec.add_pair(geomname1=f"{2 * index}", geomname2=f"{2 * index + 1}")
        self._model = model = spec.compile()
        self._data = mujoco.MjData(model)
        count = len(parts)
        self._position, self._radius = model.geom_pos[:count].copy(), model.geom_rbound[:count].copy()
        self._rotation = matrices(np.roll(model.geom_quat[:count], -1, axis=1))
        inner = [corners @ turn for corners, turn in zip(parts, self._rotation, strict=True)]
        low, high = (np.stack([side(corners, axis=0) for corners in inner]) for side in (np.min, np.max))
        self._middle = apply(self._rotation, 0.5 * (low + high))  # (P, 3) m, of the box of each part
        # (P, 3, 3) m, its half axes, columns; no two parts overlap deeper than their boxes do
        self._axes = 0.5 * self._rotation * (high - low - _ROUNDING)[:, None]
        sizes = np.array([len(corners) for corners in parts])
        self._size, self._row = np.searchsorted(_CORNERS, sizes), np.zeros(count, dtype=np.int64)
        self._corners: dict[int, Array] = {}  # (members, V, 3) m, of the parts of each size
        for size in np.unique(self._size).tolist():
            members = np.flatnonzero(self._size == size)
            self._row[members] = np.arange(len(members))
            self._corners[size] = padded([parts[index] for index in members.tolist()])

    def __call__(
        self, kind: Index, rotation: Array, translation: Array, first: Index, second: Index, scene: Index | None = None
    ) -> tuple[Index, Index, Array, Index]:
        """Rows (Q,), (Q,) of the bodies of each overlapping pair of parts and its depth (Q,) m, and the scenes in which
        these pairs are too many, of which none is listed.

        Bodies of a ``kind`` (n,) are at ``rotation`` (n, 3, 3) and ``translation`` (n, 3) m, all finite, in one scene
        or in that of the number ``scene`` (n,). The pairs of bodies in question are ``first`` (P,) and ``second`` (P,).
        """
        scene = np.zeros(len(kind), dtype=np.int64) if scene is None else scene
        if not len(first):
            return first, second, np.empty(0), first
        owner, item = ranges(self._first[kind], self._count[kind])
        part = self._part[item]
        turn = rotation[owner]
        x, y, z = np.moveaxis(np.abs(turn @ self._axes[part]), 2, 0)
        half, middle = x + y + z, translation[owner] + apply(turn, self._middle[part])
        low, high, start = middle - half, middle + half, np.cumsum(self._count[kind]) - self._count[kind]
        whole_low, whole_high = np.minimum.reduceat(low, start), np.maximum.reduceat(high, start)
        near = boxes_meet(whole_low, whole_high, whole_low, whole_high, first, second)
        order = np.lexsort((*translation.T, kind, scene))
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        swap = rank[first[near]] > rank[second[near]]  # which part is MuJoCo's first does not depend on slots
        first, second = np.where(swap, second[near], first[near]), np.where(swap, first[near], second[near])
        common_low = np.maximum(whole_low[first], whole_low[second])
        common_high = np.minimum(whole_high[first], whole_high[second])
        sides = []
        for body in (first, second):  # parts in the box that is common to both bodies
            pair, one = ranges(start[body], self._count[kind[body]])
            inside = boxes_meet(low, high, common_low, common_high, one, pair)
            sides.append((one[inside], np.bincount(pair[inside], minlength=len(first))))
        (ones, count), (others, other_count) = sides
        products = count * other_count
        lost = np.flatnonzero(np.bincount(scene[first], weights=products) > _TOO_MANY)
        products[np.isin(scene[first], lost)] = 0
        begin, other_begin = np.cumsum(count) - count, np.cumsum(other_count) - other_count
        found: list[tuple[Index, Index]] = [(np.empty(0, dtype=np.int64),) * 2]
        for rows in _blocks(products):
            pair, number = ranges(np.zeros_like(products[rows]), products[rows])
            row, column = np.divmod(number, other_count[rows][pair])
            one, other = ones[begin[rows][pair] + row], others[other_begin[rows][pair] + column]
            met = boxes_meet(low, high, low, high, one, other)
            found.append((one[met], other[met]))
        both = np.stack([np.concatenate(column) for column in zip(*found, strict=True)], axis=1)
        used, ends = np.zeros(len(part), dtype=bool), np.stack([low[:, 2], high[:, 2]])
        used[both] = True
        for size, corners in self._corners.items():  # boxes of parts that stand on others reach too far up and down
            some = np.flatnonzero(used & (self._size[part] == size))
            height = (corners[self._row[part[some]]] @ turn[some, 2, :, None])[..., 0]  # (P, V) m
            ends[:, some] = translation[owner[some], 2] + np.stack([height.min(axis=1), height.max(axis=1)])
        (bottom, top), (one, other) = ends, both.T
        both = both[np.minimum(top[one] - bottom[other], top[other] - bottom[one]) > _ROUNDING]
        body, part = owner[both], part[both]  # (Q, 2)
        aside = translation + _aside(kind, translation, scene)
        row, depth, normal = self._contacts(part, rotation[body], aside[body])
        body = body[row]
        depth = self._certain(part[row], rotation[body], translation[body], depth, normal)
        body, depth = body[depth > _ROUNDING], depth[depth > _ROUNDING]
        return body.min(axis=1), body.max(axis=1), depth, lost

    def _contacts(self, part: Index, rotation: Array, translation: Array) -> tuple[Index, Array, Array]:
        """Rows (C,) of the pairs of parts (Q, 2) at rotations (Q, 2, 3, 3) and translations (Q, 2, 3) m between which
        MuJoCo finds a contact, its depth (C,) m, and its normal (C, 3) from the first to the second.
        """
        model, data = self._model, self._data
        position = translation + apply(rotation, self._position[part])
        turn = (rotation @ self._rotation[part]).reshape(-1, 9)
        contacts = [(np.empty(0, dtype=np.int64), np.empty(0), np.empty((0, 3)))]
        for first in range(0, len(part), _PAIRS):
            rows = slice(first, first + _PAIRS)
            count = 2 * len(part[rows])
            with self._lock:
                model.geom_dataid[:count] = part[rows].ravel()
                model.geom_rbound[:count] = self._radius[part[rows]].ravel()
                data.geom_xpos[:count] = position[rows].reshape(-1, 3)
                data.geom_xpos[count:, 0] = _FAR * np.arange(len(data.geom_xpos) - count)
                data.geom_xmat[:count] = turn[2 * first : 2 * first + count]
                mujoco.mj_collision(model, data)
                contact = data.contact
                row, distance, normal = contact.geom[:, 0] // 2, contact.dist.copy(), contact.frame[:, :3].copy()
            inside = distance < 0
            contacts.append((first + row[inside].astype(np.int64), -distance[inside], normal[inside]))
        row, depth, normal = (np.concatenate(column) for column in zip(*contacts, strict=True))
        return row, depth, normal

    def _certain(self, part: Index, rotation: Array, translation: Array, depth: Array, normal: Array) -> Array:
        """Exact depth (Q,) m of pairs of parts (Q, 2) at rotations (Q, 2, 3, 3) and translations (Q, 2, 3) m.

        MuJoCo's ``depth`` (Q,) is of corners in single precision, and seldom ends too early. The width of both parts
        along its ``normal`` (Q, 3) is the true depth or more; where the two differ, the depth is computed from the hull
        of all differences of corners.
        """
        x, y, z = ((translation[:, 0] - translation[:, 1]) * normal).T
        width = x + y + z
        for side, sign in ((0, 1.0), (1, -1.0)):
            along = apply(rotation[:, side].swapaxes(1, 2), sign * normal)
            sizes = self._size[part[:, side]]
            for size, corners in self._corners.items():
                some = np.flatnonzero(sizes == size)
                reach = corners[self._row[part[some, side]]] @ along[some, :, None]
                width[some] += reach.max(axis=1)[:, 0]
        for row in np.flatnonzero(~(np.abs(width - depth) <= _CERTAIN)):
            turn = rotation[row, 0].T
            one, other = (self._parts[index] for index in part[row])
            other = other @ (turn @ rotation[row, 1]).T + turn @ (translation[row, 1] - translation[row, 0])
            try:
                hull = ConvexHull((one[:, None] - other[None]).reshape(-1, 3))
                width[row] = -hull.equations[:, 3].max()
            except (QhullError, ValueError):  # no volume
                width[row] = 0.0
        return np.maximum(width, 0.0)  # type: ignore[no-any-return]


def _blocks(counts: Index) -> list[slice]:
    """Slices of rows whose ``counts`` (P,) are together about ``_BLOCK``."""
    number = np.cumsum(counts) // _BLOCK
    edges = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(counts)]
    return [slice(*edge) for edge in pairwise(edges)]


def _aside(kind: Index, position: Array, scene: Index) -> Array:
    """(n, 3) m, moves of up to ``_SAME`` that depend on the ``kind`` (n,) and ``position`` (n, 3) m of each body alone,
    and on its number among bodies that coincide in its ``scene`` (n,).
    """
    steps = np.array([0.6180339887, 0.7548776662, 0.8191725134])
    rank = np.zeros(len(kind), dtype=np.int64)  # of each body, larger than that of all coinciding ones before it
    if (np.diff(np.sort(position @ steps + 1e3 * scene)) < 4 * _SAME).any():  # or none coincide
        order = np.lexsort((*position.T, kind))
        place = np.argsort(order)
        near = cKDTree(np.c_[position, scene]).query_pairs(_SAME, p=np.inf, output_type="ndarray")
        for one, other in order[np.array(sorted(np.sort(place[near], axis=1).tolist()), dtype=np.int64).reshape(-1, 2)]:
            rank[other] = max(rank[other], rank[one] + 1)
    return _SAME * np.modf((1.0 + kind + 0.37 * rank)[:, None] * steps + np.abs(1e3 * position))[0]  # type: ignore[no-any-return]


class MujocoEngine(Engine):
    """MuJoCo C. Models have places for some number of bodies; objects are sorted and put into the smallest in which
    they fit, with their shapes, masses, inertias and the trees of their bounding boxes.
    """

    step = TIMESTEP

    @cached_property
    def _models(self) -> _Models:
        """Two kinds of body for each asset, of coarse and of fine parts, in the frame of its principal axes."""
        bodies = []
        for category, asset in enumerate(self._library.assets):
            turn = self._library.axes[category].T
            shift = -turn @ self._library.center_of_mass[category]
            bodies += [_Body(level.ids.tolist(), turn, shift) for level in (asset.coarse, asset.fine)]
        return _Models([part.vertices for part in self._library.parts], bodies)

    def simulate(self, cluster: Objects, fine: Mask, height: Index, duration: float, course: Course) -> Moved:
        """See :class:`~scene_envs.physics.engines.Engine`."""
        x, y, z = cluster.translation.T
        order = np.lexsort((x, y, z, fine, cluster.category, cluster.fixed))  # does not depend on slots
        count = int((~cluster.fixed).sum())
        some, category = cluster[order], cluster.category[order[:count]]
        position, start = self._frames(some)
        kind = 2 * some.category + fine[order]
        for room in _ROOMS:
            budget = replace(course.budget)
            with self._lock:
                stage = self._models.stage(kind, some.fixed, room)
                stage.place(kind, some.fixed, position, start[:, [3, 0, 1, 2]])
                stage.weigh(self._library.mass[category], self._library.moments[category])
                end = stage.run(count, duration, replace(course, budget=budget))
                lost = stage.is_full or stage.is_lost
            if not stage.is_full:
                break
        course.budget.spent = budget.spent
        after = start.copy()
        position[:count], after[:count] = np.nan if lost else end[:, :3], end[:, [4, 5, 6, 3]]
        back = np.argsort(order)
        return self._moved(cluster.category, position[back], start[back], after[back])
