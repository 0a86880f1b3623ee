"""MuJoCo C: models in which any objects of a library can stand, their overlaps, and the motion of clusters of them."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.engines import DAMPING, Course, Moved, gravity
from scene_envs.physics.parts import (
    FRICTION,
    LevelGeometry,
    LibraryGeometry,
    angle_between,
    apply,
    matrices,
    principal_inertia,
    quaternions,
    times,
)
from scene_envs.physics.placement import Objects

TIME_STEP = 0.002
"""Length of a step, s."""
SOLREF, SOLIMP = (0.004, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0)
"""Stiffness of all contacts, that of the exported MJCF files: objects at rest sink by micrometres."""
_LOOK = 12
"""Number of steps between checks for rest."""
_STILL_WAY, _STILL_ANGLE = 1e-4, 1e-3
"""Objects are at rest when their present speed would take them less far than this (m, rad) in the whole duration."""
_FAR = 1000.0
"""Height (m) of the first body that is not used, and distance between such bodies."""
_SIZES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 2048, 4096)
"""Numbers of bodies, and of geometries per body, for which models are made."""
_ASIDE = 1e-6
"""Distance (m) by which each object is moved, in a direction of its own, before overlaps are asked for: the search
starts at the difference of two middles, and finds no overlap, or too small a one, where that is zero."""
_OVERLAP_ITERATIONS = 200
"""Iterations after which the depth of two parts has converged; with MuJoCo's 35 it may be millimetres too small."""
_MODELS = 48
"""Number of models that are kept; the one that was used longest ago goes first."""
Sizes = tuple[int, int, int, int]
"""Free bodies, geometries of each, fixed bodies, geometries of each."""


@dataclass(frozen=True, eq=False)
class _Body:
    """What a model says about the body of an asset at one level of detail, in the frame of its principal axes."""

    geometries: dict[str, Any]  # fields of its geometries, by name
    nodes: dict[str, Any]  # fields of its tree of bounding boxes, by name
    mass: float  # kg
    moments: Array  # (3,) kg m^2


_GEOMETRY_FIELDS = ("geom_dataid", "geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound")
_NODE_FIELDS = ("bvh_aabb", "bvh_child", "bvh_depth", "bvh_nodeid")


class Shapes:
    """The assets of a library as bodies of MuJoCo, and the models they are put into."""

    def __init__(self, library: LibraryGeometry) -> None:
        self.library = library
        principal = [principal_inertia(asset.asset.inertia) for asset in library.assets]
        moments = [moments for moments, _ in principal]
        self.axes = np.array([axes for _, axes in principal])  # (C, 3, 3) principal axes of each asset, columns
        spec = self._spec()
        levels = [(category, level) for category in range(len(library.assets)) for level in ("fine", "coarse")]
        for category, level in levels:
            turn = self.axes[category].T
            pose = -turn @ library.center_of_mass[category], np.roll(quaternions(turn[None])[0], 1)
            _add_body(spec, self.level(category, level).ids.tolist(), *pose)
        model = spec.compile()
        self._bodies: dict[tuple[int, str], _Body] = {}
        for number, (category, level) in enumerate(levels, start=1):
            first, count = int(model.body_geomadr[number]), int(model.body_geomnum[number])
            root, nodes = int(model.body_bvhadr[number]), int(model.body_bvhnum[number])
            tree = {name: getattr(model, name)[root : root + nodes].copy() for name in _NODE_FIELDS}
            leaf = tree["bvh_nodeid"] >= 0
            tree["bvh_nodeid"][leaf] -= first
            parts = {name: getattr(model, name)[first : first + count].copy() for name in _GEOMETRY_FIELDS}
            self._bodies[category, level] = _Body(
                parts, tree, float(library.assets[category].asset.mass), moments[category]
            )

    def level(self, category: int, level: str) -> LevelGeometry:
        """The parts of an asset at a level of detail."""
        return getattr(self.library.assets[category], level)  # type: ignore[no-any-return]

    def body(self, category: int, fine: bool) -> _Body:
        """An asset at a level of detail."""
        return self._bodies[category, "fine" if fine else "coarse"]

    def _spec(self) -> Any:
        spec = mujoco.MjSpec()
        option = spec.option
        option.timestep, option.impratio = TIME_STEP, 10.0
        option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICITFAST, mujoco.mjtCone.mjCONE_ELLIPTIC
        for index, part in enumerate(self.library.parts):
            mesh = spec.add_mesh(name=f"part{index}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
            mesh.uservert = part.vertices.ravel().tolist()
        return spec

    def model(self, sizes: Sizes) -> Any:
        """A model with places for bodies of ``sizes``."""
        spec = self._spec()
        for free, bodies, geometries in ((True, *sizes[:2]), (False, *sizes[2:])):
            for _ in range(bodies):
                body = _add_body(spec, [0] * geometries)
                if free:
                    body.add_freejoint()
        return spec.compile()


def _add_body(spec: Any, parts: Sequence[int], position: Any = (0, 0, 0), quaternion: Any = (1, 0, 0, 0)) -> Any:
    body = spec.worldbody.add_body(mass=1.0, inertia=(1.0, 1.0, 1.0), explicitinertial=True)
    for part in parts:
        geometry = body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part{part}", pos=position, quat=quaternion
        )  # fmt: skip
        geometry.friction[0] = FRICTION
        geometry.solref[:], geometry.solimp[:] = SOLREF, SOLIMP
    return body


class _Stage:
    """A model and its state, into which objects are put."""

    def __init__(self, shapes: Shapes, sizes: Sizes) -> None:
        self._shapes, self._free = shapes, sizes[0]
        self.model = model = shapes.model(sizes)
        self.data = mujoco.MjData(model)
        model.geom_sameframe[:] = 0
        self._first, self._root = model.body_geomadr.copy(), model.body_bvhadr.copy()
        self._idle = np.zeros((sizes[0], 7))
        self._idle[:, 2] = _FAR * (1 + np.arange(sizes[0]))
        self._idle[:, 3] = 1.0

    def place(self, objects: Objects, fine: Mask) -> None:
        """Put ``objects`` into the model, the free ones in the given order, at rest."""
        shapes, model = self._shapes, self.model
        position, quaternion = _centers(shapes, objects)
        model.body_geomnum[:] = 0
        model.body_contype[:] = model.body_conaffinity[:] = 0
        bodies = np.where(objects.fixed, self._free, 0) + 1
        bodies += np.where(objects.fixed, np.cumsum(objects.fixed), np.cumsum(~objects.fixed)) - 1
        for row, number in enumerate(bodies.tolist()):
            body = shapes.body(int(objects.category[row]), bool(fine[row]))
            first, root = int(self._first[number]), int(self._root[number])
            count, nodes = len(body.geometries["geom_dataid"]), len(body.nodes["bvh_nodeid"])
            for name, values in body.geometries.items():
                getattr(model, name)[first : first + count] = values
            for name, values in body.nodes.items():
                getattr(model, name)[root : root + nodes] = values
            model.bvh_nodeid[root : root + nodes] += np.where(body.nodes["bvh_nodeid"] >= 0, first, 0)
            model.body_geomnum[number], model.body_bvhnum[number] = count, nodes
            model.body_contype[number] = model.body_conaffinity[number] = 1
            if objects.fixed[row]:
                model.body_pos[number], model.body_quat[number] = position[row], quaternion[row]
                continue
            if not body.mass > 0:
                continue
            model.body_mass[number] = model.body_subtreemass[number] = body.mass
            model.body_inertia[number] = body.moments
            # the mass matrix of a body that moves freely in the frame of its principal axes is copied from here
            model.dof_M0[6 * number - 6 : 6 * number] = [*[body.mass] * 3, *body.moments]
            weights = 1.0 / body.mass, float((1.0 / body.moments).mean())
            model.body_invweight0[number] = weights
            model.dof_invweight0[6 * number - 6 : 6 * number] = np.repeat(weights, 3)
        free = ~objects.fixed
        state = self._idle.copy()
        state[: free.sum(), :3], state[: free.sum(), 3:] = position[free], quaternion[free]
        mujoco.mj_resetData(model, self.data)
        self.data.qpos[:] = state.ravel()


def _centers(shapes: Shapes, objects: Objects) -> tuple[Array, Array]:
    """Centres of mass (n, 3) m, and orientations (n, 4) of the principal axes, w first."""
    center = shapes.library.center_of_mass[objects.category]
    quaternion = quaternions(times(objects.rotation, shapes.axes[objects.category]))
    return objects.translation + apply(objects.rotation, center), np.roll(quaternion, 1, axis=1)


class MujocoEngine:
    """MuJoCo C for one asset library; the motion of a cluster depends on that cluster alone, bit for bit.

    Models have places for some number of bodies; objects are sorted and put into the smallest in which they fit, with
    their shapes, masses, inertias and the trees of their bounding boxes. Threads take turns.
    """

    def __init__(self, library: LibraryGeometry) -> None:
        self._library = library
        self._shapes = Shapes(library)
        self._stages: dict[Sizes, _Stage] = {}
        self._lock = threading.Lock()
        counts = [[len(shape.parts) for shape in (asset.coarse, asset.fine)] for asset in library.assets]
        self._counts = np.array(counts, dtype=np.int64)

    def depths(
        self, objects: Objects, first: Index, second: Index, gap: Array, totals: bool
    ) -> tuple[Array, Array, Index]:
        """See :class:`~scene_envs.physics.collision.Depths`."""
        depth, total, count = np.zeros(len(gap)), np.zeros(len(gap)), np.zeros(len(gap), dtype=np.int64)
        for scene in np.unique(objects.scene[first]):
            pairs = np.flatnonzero(objects.scene[first] == scene)
            rows = np.unique(np.concatenate([first[pairs], second[pairs]]))
            rows = rows[_order(objects[rows], np.ones(len(rows), dtype=bool))]
            one, two, value = self._overlaps(objects[rows])
            key = np.minimum(rows[one], rows[two]) * len(objects) + np.maximum(rows[one], rows[two])
            wanted = first[pairs] * len(objects) + second[pairs]
            order = np.argsort(wanted)
            at = np.searchsorted(wanted[order], key).clip(max=len(wanted) - 1)
            known = wanted[order[at]] == key
            target = pairs[order[at[known]]]
            np.maximum.at(depth, target, value[known])
            np.add.at(total, target, value[known])
            np.add.at(count, target, 1)
        return depth, total, count

    def _overlaps(self, objects: Objects) -> tuple[Index, Index, Array]:
        """Rows (Q,), (Q,) of the objects of each overlapping pair of fine parts, and its depth (Q,) m."""
        free = replace(objects, fixed=np.zeros(len(objects), dtype=bool))
        fine = np.ones(len(objects), dtype=bool)
        with self._lock:
            stage = self._stage(free, fine)
            stage.place(free, fine)
            model, data = stage.model, stage.data
            angle = np.arange(len(objects)) * (np.pi * (3.0 - 5.0**0.5))
            aside = _ASIDE * np.stack([np.cos(angle), np.sin(angle), np.cos(2.0**0.5 * angle)], axis=1)
            data.qpos.reshape(-1, 7)[: len(objects), :3] += aside
            flags, iterations = model.opt.disableflags, model.opt.ccd_iterations
            model.opt.disableflags = flags | mujoco.mjtDisableBit.mjDSBL_MULTICCD
            model.opt.ccd_iterations = _OVERLAP_ITERATIONS
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            model.opt.disableflags, model.opt.ccd_iterations = flags, iterations
            pair = model.geom_bodyid[data.contact.geom] - 1
            apart = aside[pair[:, 1]] - aside[pair[:, 0]]
            value = (data.contact.frame[:, :3] * apart).sum(axis=1) - data.contact.dist
        kept = value > 0
        return pair[kept, 0], pair[kept, 1], value[kept]

    def simulate(self, cluster: Objects, fine: Mask, height: Index, duration: float, course: Course) -> Moved:
        """See :class:`~scene_envs.physics.engines.Engine`."""
        order = _order(cluster, fine)
        cluster, fine, count = cluster[order], fine[order], int((~cluster.fixed).sum())
        with self._lock:
            stage = self._stage(cluster, fine)
            stage.place(cluster, fine)
            model, data = stage.model, stage.data
            start = data.qpos.reshape(-1, 7)[:count].copy()
            model.opt.gravity[:] = gravity(course.tilt)
            steps = max(1, round(duration / TIME_STEP))
            for ahead in _pieces(steps):
                mujoco.mj_step(model, data, ahead)
                course.budget.spent += ahead * count
                speed = np.abs(data.qvel.reshape(-1, 6)[:count]) * duration
                if course.budget.is_spent or (
                    (speed[:, :3] < _STILL_WAY).all() and (speed[:, 3:] < _STILL_ANGLE).all()
                ):
                    break
                if course.settling is not None:
                    data.qvel *= (1.0 - DAMPING) ** (ahead * TIME_STEP)
            end = data.qpos.reshape(-1, 7)[:count].copy()
        category, rows = cluster.category[:count], order[:count]
        before, after = (np.roll(pose[:, 3:], -1, axis=1) for pose in (start, end))
        rotation, translation = cluster.rotation[np.argsort(order)], cluster.translation[np.argsort(order)]
        angle = np.zeros(len(order))
        rotation[rows] = times(matrices(after), self._shapes.axes[category].swapaxes(1, 2))
        translation[rows] = end[:, :3] - apply(rotation[rows], self._library.center_of_mass[category])
        angle[rows] = angle_between(before, after)
        return Moved(rotation, translation, angle)

    def _stage(self, objects: Objects, fine: Mask) -> _Stage:
        """The smallest stage in which the objects fit."""
        counts, free = self._counts[objects.category, fine.astype(np.int64)], ~objects.fixed
        needed = [free.sum(), counts[free].max(initial=0), (~free).sum(), counts[~free].max(initial=0)]
        sizes: Any = tuple(next((size for size in (0, *_SIZES) if size >= count), int(count)) for count in needed)
        stage = self._stages.pop(sizes, None) or _Stage(self._shapes, sizes)
        self._stages[sizes] = stage  # the last used one is the last
        if len(self._stages) > _MODELS:
            del self._stages[next(iter(self._stages))]
        return stage


def _order(objects: Objects, fine: Mask) -> Index:
    """(n,) rows in an order that does not depend on slots, the fixed ones last."""
    x, y, z = objects.translation.T
    return np.lexsort((x, y, z, fine, objects.category, objects.fixed))


def _pieces(steps: int) -> Iterator[int]:
    """Numbers of steps between checks for rest."""
    for done in range(0, steps, _LOOK):
        yield min(_LOOK, steps - done)
