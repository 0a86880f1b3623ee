"""Overlap and motion of whole batches with MuJoCo Warp, on a GPU or a CPU, without leaving the device of the scenes.

Scenes with different objects are worlds of one model: mesh, pose and mass of every geometry and body are set per world,
and a mesh number of -1 is no geometry. For overlaps, a world is one pair of objects, in the frame of the first; for
motion, it is one scene. Needs the extra ``gpu`` (mujoco-warp).
"""

from __future__ import annotations

import logging
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, fields
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array
from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.physics.parts import FRICTION, GRAVITY, principal_inertia
from scene_envs.progress import Progress
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

_LOGGER = logging.getLogger(__name__)
_PAIR_CELLS = 1 << 26
"""Object pairs whose boxes are compared at a time."""
_PART_PAIRS = {"cuda": 1 << 18, "cpu": 1 << 15}
"""Most pairs of parts whose depths are computed at a time (6 kB each); a single object pair may not have more."""
_PAIR_WORLDS = {"cuda": 1 << 14, "cpu": 1 << 10}
"""Most object pairs of a launch, and rows of the arrays per world: kernels depend on the number of rows."""
_ASIDE = (4.8e-7, 6.0e-7, 6.4e-7)
"""The second object of a pair is moved by this (m) and its depths are corrected by it: parts that lie on one axis or
have one centre are missed otherwise."""


@dataclass(frozen=True)
class Overlaps:
    """Object pairs of a batch that overlap, on the device of the scenes; pairs of welded objects do not count.

    Attributes:
        scene: (P,) int64, row of the scene; ascending, then by ``first`` and ``second``.
        first: (P,) int64, slot of one object.
        second: (P,) int64, slot of the other, a greater number.
        depth: (P,) m, deepest overlap of any two fine convex parts of the two objects.
        normal: (P, 3) unit vector, world frame, along which the second object leaves that overlap.
        valid: (B,) bool; False where a pose is not finite or a pair has too many pairs of parts. No pair is listed there.
    """

    scene: Tensor
    first: Tensor
    second: Tensor
    depth: Tensor
    normal: Tensor
    valid: Tensor


@cache
def warp_engine(scene_type: SceneType, device: str = "cuda") -> WarpEngine:
    """The engine of a scene type on a device, made on first use and kept by this process; see :class:`WarpEngine`."""
    return WarpEngine(scene_type, device)


class WarpEngine:
    """MuJoCo Warp for the scenes of one type on one device.

    The first use on a machine compiles kernels for about a minute; Warp keeps them on disk.

    Args:
        scene_type: Scene type of all batches.
        device: Torch device, such as ``"cuda:0"`` or ``"cpu"``.

    Raises:
        MissingDependencyError: mujoco-warp is not installed.
        InvalidInputError: a CUDA device is asked for and there is none.
    """

    def __init__(self, scene_type: SceneType, device: str | torch.device = "cuda") -> None:
        self.scene_type, self.device = scene_type, torch.device(device)
        if self.device.type == "cuda" and not torch.cuda.is_available():
            raise InvalidInputError(f"device {str(device)!r} was asked for, but torch finds no CUDA GPU; use 'cpu'")
        self._mujoco, self._mjw, self._wp = _modules()
        self._library = _Library(self._mujoco, self._mjw, scene_type, self.device, self._scope)
        self._models: dict[Any, Any] = {}

    @contextmanager
    def _scope(self) -> Iterator[None]:
        """Launch on the device, and on torch's current stream of it."""
        wp, cuda = self._wp, self.device.type == "cuda"
        stream = wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(self.device))) if cuda else nullcontext()
        with wp.ScopedDevice(wp.device_from_torch(self.device)), stream, torch.no_grad():
            yield

    def overlaps(self, batch: SceneBatch) -> Overlaps:
        """Overlapping object pairs of every scene and their depths; independent of slots and of other scenes."""
        state = _State(batch, self.device)
        scene, one, two = self._near(state)
        category = state.category[scene, one], state.category[scene, two]
        feature = [
            torch.cat([c.double()[:, None], state.pose[scene, slot]], dim=1)
            for c, slot in zip(category, (one, two), strict=True)
        ]
        apart = feature[0] - feature[1]  # the order within a pair is by category and pose, not by slot
        row = (apart != 0).long().argmax(dim=1, keepdim=True)
        swap = apart.gather(1, row).squeeze(1) > 0
        one, two = torch.where(swap, two, one), torch.where(swap, one, two)
        depth, normal, lost = self._depths(state, scene, one, two)
        normal = torch.where(swap[:, None], -normal, normal)
        one, two = torch.where(swap, two, one), torch.where(swap, one, two)
        valid = state.valid.clone()
        valid[scene[lost]] = False
        if missing := int((~valid).sum()):
            _LOGGER.warning(
                "%d of %d scenes are invalid: poses that are not finite, or an object pair of more than %d near part pairs",
                missing, len(batch), _PART_PAIRS[self.device.type],
            )  # fmt: skip
        kept = (depth > 0) & valid[scene]
        return Overlaps(scene[kept], one[kept], two[kept], depth[kept], normal[kept].float(), valid)

    def _near(self, state: _State) -> tuple[Tensor, Tensor, Tensor]:
        """Scene and slots (P,) of the object pairs whose boxes meet, in order."""
        center = state.translation + _turned(state.rotation, self._library.center[state.category])
        half = (state.rotation.abs() * self._library.half[state.category][..., None, :]).sum(dim=-1)
        low, high = center - half, center + half
        count, slots = state.category.shape
        step = max(1, _PAIR_CELLS // max(1, slots * slots))
        found = []
        for start in range(0, count, step):
            rows = slice(start, start + step)
            meets = state.present[rows, :, None] & state.present[rows, None, :]
            meets &= ~(state.welded[rows, :, None] & state.welded[rows, None, :])
            for axis in range(3):
                meets &= low[rows, :, None, axis] <= high[rows, None, :, axis]
                meets &= low[rows, None, :, axis] <= high[rows, :, None, axis]
            some = meets.triu(diagonal=1).nonzero()
            some[:, 0] += start
            found.append(some)
        scene, one, two = torch.cat(found or [torch.empty(0, 3, dtype=torch.long, device=self.device)]).unbind(dim=1)
        return scene, one, two

    def _depths(self, state: _State, scene: Tensor, one: Tensor, two: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depth (P,) m, normal (P, 3) in the world from ``one`` to ``two``, and whether (P,) a pair was not computed."""
        turn = state.rotation[scene, one]
        relative = turn.transpose(1, 2) @ state.rotation[scene, two]
        moved = _turned(turn.transpose(1, 2), state.translation[scene, two] - state.translation[scene, one])
        first, second = state.category[scene, one], state.category[scene, two]
        depth = torch.zeros(len(scene), dtype=torch.float64, device=self.device)
        normal = torch.zeros(len(scene), 3, dtype=torch.float64, device=self.device)
        lost = torch.zeros(len(scene), dtype=torch.bool, device=self.device)
        most = _PAIR_WORLDS[self.device.type]
        with self._scope():
            open_rows = [slice(start, min(start + most, len(scene))) for start in range(0, len(scene), most)][::-1]
            while open_rows:
                rows = open_rows.pop()
                found = self._launch_pairs(first[rows], second[rows], relative[rows], moved[rows])
                if found is not None:
                    depth[rows], normal[rows] = found
                elif rows.stop - rows.start == 1:
                    lost[rows] = True
                else:
                    middle = (rows.start + rows.stop) // 2
                    open_rows += [slice(middle, rows.stop), slice(rows.start, middle)]
        return depth, _turned(turn, normal), lost

    def _launch_pairs(
        self, first: Tensor, second: Tensor, rotation: Tensor, translation: Tensor
    ) -> tuple[Tensor, Tensor] | None:
        """Depth and normal of pairs in the frame of the first object; None where there are too many pairs of parts."""
        library, wp = self._library, self._wp
        count, parts = len(first), library.mesh.shape[1]
        worlds, most = 1 << (count - 1).bit_length(), _PAIR_WORLDS[self.device.type]
        model = self._model("pairs", lambda: _two_bodies(self._mujoco, parts))
        with self._compiling("overlaps"):
            categories = torch.stack([first, second], dim=1)
            library.fill(wp, model, _padded(library.mesh[categories].flatten(1), most, -1), categories)
            aside = torch.tensor(_ASIDE, dtype=torch.float64, device=self.device)
            position, turn = library.position[categories], library.rotation[categories]  # (P, 2, K, ...)
            other = _turned(rotation[:, None], position[:, 1]) + translation[:, None] + aside
            placed = torch.stack([position[:, 0], other], 1)
            turned = torch.stack([turn[:, 0], rotation[:, None] @ turn[:, 1]], 1)
            limit = 16 * worlds
            while True:
                data = self._mjw.make_data(model.host, nworld=worlds, naconmax=limit, njmax=1)
                wp.to_torch(data.geom_xpos)[:count] = placed.flatten(1, 2).float()
                wp.to_torch(data.geom_xmat)[:count] = turned.flatten(1, 2).float()
                self._mjw.collision(model.device, data)
                needed = max(int(wp.to_torch(data.ncollision)), int(wp.to_torch(data.nacon)))
                if needed <= limit:
                    break
                limit = 1 << (needed - 1).bit_length()
                if limit > _PART_PAIRS[self.device.type]:
                    return None
        contacts = slice(0, int(wp.to_torch(data.nacon)))
        world = wp.to_torch(data.contact.worldid)[contacts].long()
        away = wp.to_torch(data.contact.frame)[contacts, 0].double()
        deep = away @ aside - wp.to_torch(data.contact.dist)[contacts].double()
        pair = wp.to_torch(data.contact.geom)[contacts].long()
        number = pair[:, 0] * 2 * parts + pair[:, 1]  # of equal depths, that of the first pair of parts gives the normal
        depth = torch.zeros(worlds, dtype=torch.float64, device=self.device).scatter_reduce(0, world, deep, "amax")
        best = deep == depth[world]
        chosen = torch.full((worlds,), 4 * parts * parts, device=self.device)
        chosen = chosen.scatter_reduce(0, world[best], number[best], "amin")
        best &= number == chosen[world]
        normal = torch.zeros(worlds, 3, dtype=torch.float64, device=self.device)
        normal[world[best]] = away[best]
        return depth[:count], normal[:count]

    def _model(self, key: Any, build: Any) -> _Model:
        """A template model on the device, with the meshes of the library."""
        if key not in self._models:
            host = build()
            model = self._mjw.put_model(host)
            self._library.lend_meshes(model)
            model.opt.warn_overflow = 0
            self._models[key] = _Model(host, model)
        return self._models[key]

    @contextmanager
    def _compiling(self, what: str, *sizes: int, progress: str | None = None) -> Iterator[None]:
        """Say once per machine that kernels are compiled now."""
        folder = Path(self._wp.config.kernel_cache_dir or ".")
        name = "-".join(map(str, ("scene_envs", self.device.type, what, *sizes)))
        if (folder / name).exists():
            yield
            return
        _LOGGER.info("MuJoCo Warp compiles its kernels for %s, once, about a minute; they are kept in %s", what, folder)
        with Progress(f"Compiling kernels for {what}", 1, style=progress or "none") as shown:
            yield
            shown.update(1, "", "kernels compiled")
        (folder / name).touch()


@dataclass(frozen=True)
class _Model:
    host: Any  # mujoco.MjModel
    device: Any  # mujoco_warp.Model


@cache
def _modules() -> tuple[Any, Any, Any]:
    """The modules mujoco, mujoco_warp and warp."""
    try:
        import mujoco
        import mujoco_warp
        import warp
    except ImportError as error:
        python = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise MissingDependencyError(
            f'physics on a GPU needs mujoco-warp, which is not installed for Python {python}: pip install "scene-envs[gpu]"'
        ) from error
    warp.config.log_level = warp.LOG_ERROR
    warp.init()
    return mujoco, mujoco_warp, warp


class _State:
    """Poses of a batch in float64 on the device; scenes with a pose that is not finite count as empty."""

    def __init__(self, batch: SceneBatch, device: torch.device) -> None:
        tensor = batch.tensor.to(device)
        self.valid = tensor.isfinite().all(dim=-1).all(dim=-1)
        self.pose = tensor[..., :12].double()
        self.translation, self.rotation = self.pose[..., :3], self.pose[..., 3:].unflatten(-1, (3, 3))
        categories = tensor[..., 12:].argmax(dim=-1)
        self.present = (categories < batch.scene_type.num_assets) & self.valid[:, None]
        self.category = torch.where(self.present, categories, 0)
        welded = torch.tensor(batch.scene_type.welded_categories, device=device, dtype=torch.long)
        static = [c for c, asset in enumerate(batch.scene_type.library) if asset.static or asset.mass <= 0]
        welded = torch.cat([welded, torch.tensor(static, device=device, dtype=torch.long)])
        self.welded = torch.isin(self.category, welded) & self.present


class _Library:
    """Parts of all assets as meshes of MuJoCo, and tables (C, K, ...) of them, K the most parts of an asset."""

    def __init__(self, mujoco: Any, mjw: Any, scene_type: SceneType, device: torch.device, scope: Any) -> None:
        assets = tuple(scene_type.library)
        spec = mujoco.MjSpec()
        for c, asset in enumerate(assets):
            for k, part in enumerate(asset.fine):
                name = f"{c}_{k}"
                mesh = spec.add_mesh(name=name, uservert=np.asarray(part.vertices, dtype=np.float32).ravel())
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
                spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)
        host = spec.compile()
        with scope():
            self._meshes = mjw.put_model(host)
        counts = [len(asset.fine) for asset in assets]
        rotation = np.zeros((host.ngeom, 9))
        for geom in range(host.ngeom):
            mujoco.mju_quat2Mat(rotation[geom], host.geom_quat[geom])

        def table(values: Array, empty: float, dtype: torch.dtype) -> Tensor:
            out = np.full((len(assets), max(counts), *values.shape[1:]), empty, dtype=np.float64)
            for c, start in enumerate(np.cumsum(counts) - counts):
                out[c, : counts[c]] = values[start : start + counts[c]]
            return torch.tensor(out, dtype=dtype, device=device)

        self.mesh = table(host.geom_dataid, -1, torch.int32)
        self.position = table(host.geom_pos, 0, torch.float64)
        self.rotation = table(rotation.reshape(-1, 3, 3), 0, torch.float64)
        self.size = table(host.geom_size, 1, torch.float32)
        self.rbound = table(host.geom_rbound, 1, torch.float32)
        self.aabb = table(host.geom_aabb.reshape(-1, 2, 3), 1, torch.float32)
        bounds = torch.tensor(np.stack([asset.bounds for asset in assets]), device=device)
        self.center, self.half = bounds.mean(dim=1), (bounds[:, 1] - bounds[:, 0]) / 2 + 1e-6

    def lend_meshes(self, model: Any) -> None:
        """Give a model the meshes of the library."""
        names = [field.name for field in fields(model) if field.name.startswith("mesh_")]
        for name in (*names, "npolygonmax", "nmeshdegmax"):
            setattr(model, name, getattr(self._meshes, name))

    def fill(self, wp: Any, model: _Model, mesh: Tensor, categories: Tensor) -> None:
        """Set the geometries of the model per world: meshes (W, G), -1 for none, of objects (w, S) of categories."""

        def rows(table: Tensor) -> Tensor:
            return _padded(table[categories].flatten(1, 2), len(mesh), 1.0)

        m = model.device
        m.geom_dataid = wp.from_torch(mesh, dtype=wp.int32)
        m.geom_size = wp.from_torch(rows(self.size), dtype=wp.vec3)
        m.geom_rbound = wp.from_torch(rows(self.rbound), dtype=wp.float32)
        m.geom_aabb = wp.from_torch(rows(self.aabb), dtype=wp.vec3)


def _two_bodies(mujoco: Any, parts: int) -> Any:
    """A fixed and a free body of ``parts`` mesh geometries each."""
    spec = mujoco.MjSpec()
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    _add_tetrahedron(mujoco, spec)
    body = spec.worldbody.add_body(mass=1.0, inertia=[1.0, 1.0, 1.0])
    body.add_freejoint()
    for parent in (spec.worldbody, body):
        for _ in range(parts):
            parent.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="any", mass=0.0)
    return spec.compile()


def _add_tetrahedron(mujoco: Any, spec: Any) -> None:
    spec.add_mesh(name="any", uservert=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0])


def _padded(rows: Tensor, count: int, value: float) -> Tensor:
    """Rows (n, ...) as (count, ...), contiguous; the others hold ``value``."""
    out = torch.full((count, *rows.shape[1:]), value, dtype=rows.dtype, device=rows.device)
    out[: len(rows)] = rows
    return out


def _turned(rotation: Tensor, vector: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of vectors (..., 3)."""
    return (rotation * vector[..., None, :]).sum(dim=-1)
