"""Overlap and motion of whole batches with MuJoCo Warp, on a GPU or a CPU, without leaving the device of the scenes.

Scenes with different objects are worlds of one model: mesh, pose and mass of every geometry and body are set per world,
and a mesh number of -1 is no geometry. For overlaps, a world is one pair of objects, in the frame of the first; for
motion, it is one scene. Needs the extra ``gpu`` (mujoco-warp).
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array
from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.physics.mujoco import TIMESTEP, add_parts, scene_spec
from scene_envs.physics.parts import library_geometry
from scene_envs.rotations import matrix_to_quaternion, quaternion_to_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

_LOGGER = logging.getLogger(__name__)
_PAIR_CELLS = 1 << 26
"""Object pairs whose boxes are compared at a time."""
_PART_PAIRS = {"cuda": 1 << 19, "cpu": 1 << 15}
"""Most pairs of parts whose depths are computed at a time (6 kB each); a single object pair may not have more."""
_PAIR_WORLDS = {"cuda": 1 << 14, "cpu": 1 << 10}
"""Most object pairs of a launch, and rows of the arrays per world: kernels depend on the number of rows."""
_SCENE_WORLDS = {"cuda": 1024, "cpu": 32}
"""Most scenes of a launch."""
_BODIES = (4, 8, 16, 24, 32, 48, 64, 96, 128)
"""Numbers of free bodies of a model; kernels depend on it."""
_ROOM, _MOST_ROOM = 1 << 10, 1 << 14
"""Contacts of a scene for which there is room at first, and at most: a scene with more is simulated again."""
_CONTACTS = 384
"""Contacts, or pairs of near parts, per scene of a launch for which there is room at first."""
_MODELS = 8
"""Models kept at a time."""
_CHECK = 10
"""Steps between looks at the counters."""
_ASIDE = (4.8e-7, 6.0e-7, 6.4e-7)
_ASKEW = ((1.0, -1.8e-6, -1.9e-6), (1.8e-6, 1.0, -1.4e-6), (1.9e-6, 1.4e-6, 1.0))
"""The second object of a pair is moved by the first (m), by which depths are corrected, and its parts are turned by the
second (3e-6 rad): the search for the depth misses parts with one centre and parallel faces."""


@dataclass(frozen=True)
class Overlaps:
    """Object pairs of a batch that overlap, on the device of the scenes; pairs of welded objects do not count.

    Attributes:
        scene: (P,) int64, row of the scene; ascending, then by ``first`` and ``second``.
        first: (P,) int64, slot of one object.
        second: (P,) int64, slot of the other, a greater number.
        depth: (P,) m, deepest overlap of any two fine convex parts of the two objects.
        normal: (P, 3) unit vector, world frame, along which the second object leaves that overlap.
        valid: (B,) bool; False where a pose is not finite, or one pair has too many pairs of parts. No pair is listed.
    """

    scene: Tensor
    first: Tensor
    second: Tensor
    depth: Tensor
    normal: Tensor
    valid: Tensor


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
        device = torch.device(device)
        if device.type == "cuda" and not torch.cuda.is_available():
            raise InvalidInputError(f"device {str(device)!r} was asked for, but torch finds no CUDA GPU; use 'cpu'")
        self._mjw, self._wp = _modules()
        self._stream = torch.cuda.Stream(device) if device.type == "cuda" else None
        self.scene_type = scene_type
        self.device = device if self._stream is None else self._stream.device
        with self._scope():
            self._library = _Library(self._mjw, scene_type, self.device)
        self._models: dict[Any, tuple[Any, Any]] = {}

    @contextmanager
    def _scope(self) -> Iterator[None]:
        """Torch and Warp launch on one stream of the device, which can be captured, after and before all other work."""
        wp = self._wp
        with torch.no_grad(), wp.ScopedDevice(wp.device_from_torch(self.device)):
            if self._stream is None:
                yield
                return
            outside = torch.cuda.current_stream(self.device)
            self._stream.wait_stream(outside)
            with torch.cuda.stream(self._stream), wp.ScopedStream(wp.stream_from_torch(self._stream)):
                yield
            outside.wait_stream(self._stream)

    def overlaps(self, batch: SceneBatch) -> Overlaps:
        """Overlapping object pairs of every scene and their depths; independent of slots and of other scenes."""
        with self._scope():
            state = _State(batch, self._library)
            scene, one, two = self._near(state)
            keys = torch.cat([~state.welded[..., None], state.category[..., None], state.pose], dim=-1)
            apart = keys[scene, one] - keys[scene, two]  # welded first, then by category and pose, not by slots
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
                    "%d of %d scenes are invalid: a pose is not finite, or one pair of objects has more than "
                    "%d near pairs of parts",
                    *(missing, len(batch), _PART_PAIRS[self.device.type]),
                )
            kept = (depth > 0) & valid[scene]
            return Overlaps(scene[kept], one[kept], two[kept], depth[kept], normal[kept].float(), valid)

    def _near(self, state: _State) -> tuple[Tensor, Tensor, Tensor]:
        """Scene and slots (P,) of the object pairs whose boxes meet, in order."""
        center = state.translation + _turned(state.rotation, self._library.center[state.category])
        half = (state.rotation.abs() * self._library.half[state.category][..., None, :]).sum(dim=-1)
        low, high = center - half, center + half
        count, slots = state.category.shape
        step = max(1, _PAIR_CELLS // max(1, slots * slots))
        found = [torch.empty(0, 3, dtype=torch.long, device=self.device)]
        for start in range(0, count, step):
            rows = slice(start, start + step)
            meets = state.present[rows, :, None] & state.present[rows, None, :]
            meets &= ~(state.welded[rows, :, None] & state.welded[rows, None, :])
            for axis in range(3):
                below = low[rows, :, None, axis] <= high[rows, None, :, axis]
                meets &= below & below.transpose(1, 2)
            some = meets.triu(diagonal=1).nonzero()
            some[:, 0] += start
            found.append(some)
        scene, one, two = torch.cat(found).unbind(dim=1)
        return scene, one, two

    def _depths(self, state: _State, scene: Tensor, one: Tensor, two: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depth (P,) m, normal (P, 3) in the world from ``one`` to ``two``, and whether (P,) a pair was left out."""
        turn = state.rotation[scene, one]
        relative = turn.transpose(1, 2) @ state.rotation[scene, two]
        moved = _turned(turn.transpose(1, 2), state.translation[scene, two] - state.translation[scene, one])
        first, second = state.category[scene, one], state.category[scene, two]
        depth = torch.zeros(len(scene), dtype=torch.float64, device=self.device)
        normal = torch.zeros(len(scene), 3, dtype=torch.float64, device=self.device)
        lost = torch.zeros(len(scene), dtype=torch.bool, device=self.device)
        open_rows = _chunks(len(scene), _PAIR_WORLDS[self.device.type], self.device)
        while open_rows:
            rows = open_rows.pop()
            found = self._launch_pairs(first[rows], second[rows], relative[rows], moved[rows])
            if found is not None:
                depth[rows], normal[rows] = found
            elif len(rows) > 1:
                open_rows += rows.chunk(2)[::-1]
            else:
                lost[rows] = True
        return depth, _turned(turn, normal), lost

    def _launch_pairs(
        self, first: Tensor, second: Tensor, rotation: Tensor, translation: Tensor
    ) -> tuple[Tensor, Tensor] | None:
        """Depth and normal of pairs in the frame of the first object; None where there are too many pairs of parts."""
        library, wp = self._library, self._wp
        count, parts = len(first), library.mesh.shape[1]
        worlds, most = 1 << (count - 1).bit_length(), _PAIR_WORLDS[self.device.type]
        host, model = self._model(parts, (parts,), multiple=False)
        with self._compiling("overlaps"):
            categories = torch.stack([first, second], dim=1)
            part = torch.arange(parts, device=self.device).repeat(2)
            library.fill(wp, model, categories.repeat_interleave(parts, dim=1), part, most)
            aside = torch.tensor(_ASIDE, dtype=torch.float64, device=self.device)
            position, turn = library.position[categories], library.rotation[categories]  # (P, 2, K, ...)
            other = _turned(rotation[:, None], position[:, 1]) + translation[:, None] + aside
            placed = torch.stack([position[:, 0], other], 1)
            askew = torch.tensor(_ASKEW, dtype=torch.float64, device=self.device)
            turned = torch.stack([turn[:, 0], askew @ rotation[:, None] @ turn[:, 1]], 1)
            limit = 16 * worlds
            while True:
                data = self._mjw.make_data(host, nworld=worlds, naconmax=limit, njmax=1)
                wp.to_torch(data.geom_xpos)[:count] = placed.flatten(1, 2).float()
                wp.to_torch(data.geom_xmat)[:count] = turned.flatten(1, 2).float()
                self._mjw.collision(model, data)
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
        number = pair[:, 0] * 2 * parts + pair[:, 1]  # of equal depths, the first pair of parts gives the normal
        depth = torch.zeros(worlds, dtype=torch.float64, device=self.device).scatter_reduce(0, world, deep, "amax")
        best = deep == depth[world]
        chosen = torch.full((worlds,), 4 * parts * parts, device=self.device)
        chosen = chosen.scatter_reduce(0, world[best], number[best], "amin")
        best &= number == chosen[world]
        normal = torch.zeros(worlds, 3, dtype=torch.float64, device=self.device)
        normal[world[best]] = away[best]
        return depth[:count], normal[:count]

    def simulate(self, batch: SceneBatch, duration: float) -> tuple[Tensor, Tensor, Tensor]:
        """Motion of every scene under gravity; independent of slots.

        Args:
            batch: B scenes of N slots; welded objects stay where they are.
            duration: Simulated time, s, above 0; steps of 2 ms.

        Returns:
            Translations (B, N, 3) m and rotations (B, N, 3, 3) float32 at the end, and validity (B,) bool: False, and
            poses unchanged, where a pose is not finite, the simulation diverged, or more contacts arose than fit.
        """
        with self._scope():
            state = _State(batch, self._library)
            translation, rotation = state.translation.clone(), state.rotation.clone()
            valid, plan = torch.zeros_like(state.valid), _Plan(state, self._library)
            steps = max(1, round(duration / TIMESTEP))
            open_rows = [(rows, _ROOM) for rows in _chunks(len(batch), _SCENE_WORLDS[self.device.type], self.device)]
            while open_rows:
                rows, room = open_rows.pop()
                moved = self._launch_scenes(plan, rows, room, steps)
                if moved is None:  # one scene that is too much alone stays invalid
                    open_rows += [(half, room) for half in rows.chunk(2)[::-1] if len(rows) > 1]
                    continue
                center, turn, finite, crowded = moved
                if room < _MOST_ROOM and bool(crowded.any()):
                    open_rows.append((rows[crowded], 4 * room))
                valid[rows] = state.valid[rows] & finite & ~crowded
                row, column = ((plan.category[rows, plan.fixed :] >= 0) & valid[rows, None]).nonzero().unbind(dim=1)
                scene, slot = rows[row], plan.free[rows[row], column]
                translation[scene, slot], rotation[scene, slot] = center[row, column], turn[row, column]
            if lost := int((state.valid & ~valid).sum()):
                _LOGGER.warning("%d of %d scenes are invalid: diverged, or more contacts than fit", lost, len(batch))
        return translation.float(), rotation.float(), valid

    def _launch_scenes(
        self, plan: _Plan, rows: Tensor, room: int, steps: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor] | None:
        """Asset frames (w, S, 3), (w, S, 3, 3) of the free objects after some steps, whether (w,) they are finite, and
        whether (w,) a scene had more than ``room`` contacts; None where there were too many in all.
        """
        wp, library, most = self._wp, self._library, _SCENE_WORLDS[self.device.type]
        category = plan.category[rows]
        count, fixed = category.shape[0], plan.fixed
        host, m = self._model(*plan.sizes, multiple=True)
        free = category[:, fixed:]
        library.fill(wp, m, category[:, plan.column], plan.part, most)
        library.fill_bodies(wp, m, free, most)
        present, free = free >= 0, free.clamp(min=0)
        turn = plan.rotation[rows, fixed:] @ library.axes[free]
        center = plan.translation[rows, fixed:] + _turned(plan.rotation[rows, fixed:], library.center_of_mass[free])
        aside, askew = plan.aside, plan.askew
        start = torch.cat([center + aside, matrix_to_quaternion(askew @ turn)], dim=-1)
        column, part = plan.column[: plan.fixed_geometries], plan.part[: plan.fixed_geometries]
        owner = plan.rotation[rows][:, column]
        which = category[:, column].clamp(min=0)
        placed = plan.translation[rows][:, column] + _turned(owner, library.position[which, part])
        turned = owner @ library.rotation[which, part]
        limit = _PART_PAIRS[self.device.type]
        contacts = min(limit, count * _CONTACTS)
        while True:
            data = self._mjw.make_data(host, nworld=count, naconmax=contacts, njmax=3 * room, njmax_nnz=36 * room)
            wp.to_torch(data.geom_xpos)[:, : len(column)] = placed.float()
            wp.to_torch(data.geom_xmat)[:, : len(column)] = turned.float()
            qpos = wp.to_torch(data.qpos).unflatten(1, (-1, 7))
            qpos[present] = start[present].float()
            with self._compiling("motion", m.nv):
                peak, crowded = self._steps(m, data, steps, contacts)
            if peak <= contacts:
                break
            if contacts == limit:
                return None
            contacts = min(limit, 2 * peak)
        end = qpos.double()
        turn = askew.transpose(-1, -2) @ quaternion_to_matrix(end[..., 3:]) @ library.axes[free].transpose(-1, -2)
        center = end[..., :3] - aside - _turned(turn, library.center_of_mass[free])
        return center, turn, end.isfinite().all(dim=-1).all(dim=-1), crowded

    def _steps(self, m: Any, data: Any, steps: int, contacts: int) -> tuple[int, Tensor]:
        """Advance all worlds: the most part pairs or contacts of a step, and worlds (w,) of too many constraints. Ends
        early where there are more than ``contacts``.
        """
        wp, mjw = self._wp, self._mjw
        counters = [wp.to_torch(counter) for counter in (data.ncollision, data.nacon)]
        overflow, flags = wp.to_torch(data.overflow), int(mjw.OverflowType.NEFC | mjw.OverflowType.NJMAX_NNZ)
        peak, seen = torch.zeros_like(counters[0]), torch.zeros_like(overflow)
        graph, state = None, [wp.to_torch(array) for array in (data.qpos, data.qvel, data.qacc_warmstart, data.time)]
        if self._stream is not None and steps > 1:
            before = [array.clone() for array in state]
            mjw.step(m, data)  # loads the kernels, which a capture cannot do
            for array, kept in zip(state, before, strict=True):
                array.copy_(kept)
            overflow.zero_()
            with wp.ScopedCapture(stream=wp.stream_from_torch(self._stream)) as capture:
                mjw.step(m, data)
            graph = capture.graph
        for index in range(steps):
            if graph is None:
                mjw.step(m, data)
            else:
                wp.capture_launch(graph)
            peak = torch.maximum(peak, torch.maximum(*counters))
            seen |= overflow
            if index % _CHECK == 0 and int(peak) > contacts:
                break
        return int(peak), (seen & flags) != 0

    def _model(self, fixed: int, parts: tuple[int, ...], *, multiple: bool) -> tuple[Any, Any]:
        """A model on the host and on the device with the meshes of the library; see :func:`_template`."""
        key = fixed, parts, multiple
        if key not in self._models:
            if len(self._models) >= _MODELS:
                self._models.clear()
            host = _template(fixed, parts, multiple=multiple)
            model = self._mjw.put_model(host)
            self._library.lend_meshes(model)
            model.opt.warn_overflow = 0
            self._models[key] = host, model
        return self._models[key]

    @contextmanager
    def _compiling(self, *what: str | int) -> Iterator[None]:
        """Say once per machine that kernels are compiled now."""
        folder = Path(self._wp.config.kernel_cache_dir or ".")
        mark = folder / "-".join(map(str, ("scene_envs", self._mjw.__version__, self.device.type, *what)))
        if not mark.exists():
            _LOGGER.info("MuJoCo Warp compiles its kernels, once, about a minute; they are kept in %s", folder)
        yield
        mark.touch()


warp_engine = cache(WarpEngine)
"""The engine of a scene type on a device, made on first use and kept by this process."""


@cache
def _modules() -> tuple[Any, Any]:
    """The modules mujoco_warp and warp."""
    try:
        import mujoco_warp
        import warp
    except ImportError as error:
        python = f"{sys.version_info.major}.{sys.version_info.minor}"
        raise MissingDependencyError(
            f"physics on a GPU needs mujoco-warp, which is not installed for Python {python}; "
            'install it with: pip install "scene-envs[gpu]"'
        ) from error
    warp.config.log_level = warp.LOG_ERROR
    warp.init()
    return mujoco_warp, warp


class _State:
    """Poses of a batch in float64 on the device; scenes with a pose that is not finite count as empty."""

    def __init__(self, batch: SceneBatch, library: _Library) -> None:
        tensor = batch.tensor.detach().to(library.parts.device)
        self.valid = tensor.isfinite().all(dim=-1).all(dim=-1)
        self.pose = tensor[..., :12].double()
        self.translation, self.rotation = self.pose[..., :3], self.pose[..., 3:].unflatten(-1, (3, 3))
        categories = tensor[..., 12:].argmax(dim=-1)
        self.present = (categories < batch.scene_type.num_assets) & self.valid[:, None]
        self.category = torch.where(self.present, categories, 0)
        self.welded = library.welded[self.category] & self.present


class _Plan:
    """Objects of a batch as columns of one model: the welded ones, then the free ones by number of parts and pose.

    ``category`` (B, F + S) is -1 where a column is empty; ``translation`` and ``rotation`` (B, F + S, ...) are their
    poses, and ``free`` (B, S) their slots. ``aside`` (S, 3) m and ``askew`` (S, 3, 3) are to be added to poses, for the
    reason of :data:`_ASIDE`. Geometry g is part ``part[g]`` of column ``column[g]``.
    """

    def __init__(self, state: _State, library: _Library) -> None:
        device = state.pose.device
        parts = library.parts[state.category]
        kind = torch.where(state.present, torch.where(state.welded, 1, 0), 2)
        keys = [*state.pose.unbind(dim=-1)[::-1], state.category, -parts, kind]
        order = torch.arange(kind.shape[1], device=device).expand_as(kind)
        for key in keys:
            order = order.gather(1, key.gather(1, order).argsort(dim=1, stable=True))
        frees, welds = (kind == 0).sum(dim=1), (kind == 1).sum(dim=1)
        most_free, self.fixed = (int(counts.max()) if len(counts) else 0 for counts in (frees, welds))
        bodies = next((size for size in _BODIES if size >= most_free), most_free)
        columns = torch.arange(self.fixed + bodies, device=device)
        is_free = columns >= self.fixed
        place = torch.where(is_free, columns - self.fixed, columns + frees[:, None])
        there = place < torch.where(is_free, frees[:, None], (frees + welds)[:, None])
        slot = order.gather(1, place.clamp(max=kind.shape[1] - 1))
        scene = torch.arange(len(kind), device=device)[:, None]
        self.category = torch.where(there, state.category[scene, slot], -1)
        self.translation, self.rotation = state.translation[scene, slot], state.rotation[scene, slot]
        self.free = slot[:, self.fixed :]
        most = torch.where(there, parts[scene, slot], 0).amax(dim=0) if len(kind) else columns
        sizes = [int(size) for size in most.tolist()]
        self.fixed_geometries = sum(sizes[: self.fixed])
        self.sizes = self.fixed_geometries, tuple(sizes[self.fixed :])
        self.column = columns.repeat_interleave(most)
        generator = torch.Generator().manual_seed(0)
        x, y, z, *aside = torch.randn(6, bodies, generator=generator, dtype=torch.float64).to(device)
        none = torch.zeros_like(x)
        turn = torch.stack([none, -z, y, z, none, -x, -y, x, none], dim=-1).reshape(-1, 3, 3)
        self.aside, self.askew = 5e-7 * torch.stack(aside, dim=-1), torch.eye(3, device=device) + 1e-6 * turn
        self.part = torch.cat([torch.arange(size, device=device) for size in sizes] or [columns])


class _Library:
    """Parts of all assets as meshes of MuJoCo, and tables (C, K, ...) of them, K the most parts of an asset."""

    def __init__(self, mjw: Any, scene_type: SceneType, device: torch.device) -> None:
        assets = tuple(scene_type.library)
        parts = [part.vertices for asset in assets for part in asset.fine]
        spec = scene_spec(parts)
        add_parts(spec.worldbody, range(len(parts)))
        host = spec.compile()
        self._meshes = mjw.put_model(host)
        counts = [len(asset.fine) for asset in assets]
        rotation = np.zeros((host.ngeom, 9))
        for geom in range(host.ngeom):
            mujoco.mju_quat2Mat(rotation[geom], host.geom_quat[geom])

        def table(values: Array, empty: Any, dtype: torch.dtype) -> Tensor:
            out = np.zeros((len(assets), max(counts), *values.shape[1:])) + empty
            for c, start in enumerate(np.cumsum(counts) - counts):
                out[c, : counts[c]] = values[start : start + counts[c]]
            return torch.tensor(out, dtype=dtype, device=device)

        self.mesh = table(host.geom_dataid, -1, torch.int32)
        self.position = table(host.geom_pos, 0, torch.float64)
        self.rotation = table(rotation.reshape(-1, 3, 3), np.eye(3), torch.float64)
        self.size = table(host.geom_size, 1, torch.float32)
        self.rbound = table(host.geom_rbound, 1, torch.float32)
        self.aabb = table(host.geom_aabb.reshape(-1, 2, 3), 1, torch.float32)
        geometry = library_geometry(assets)
        masses = geometry.mass, geometry.center_of_mass, geometry.moments, geometry.axes
        self.mass, self.center_of_mass, self.moments, self.axes = (torch.tensor(x, device=device) for x in masses)
        inverse = self.axes.transpose(1, 2)[:, None]  # the frame of a free body is that of its inertia
        self.inner_position = _turned(inverse, self.position - self.center_of_mass[:, None]).float()
        self.inner_quaternion = matrix_to_quaternion(inverse @ self.rotation).float()
        self.parts = torch.tensor(counts, device=device)
        self.welded = torch.tensor(geometry.static, device=device)
        self.welded[list(scene_type.welded_categories)] = True
        bounds = torch.tensor(np.stack([asset.bounds for asset in assets]), device=device)
        self.center, self.half = bounds.mean(dim=1), (bounds[:, 1] - bounds[:, 0]) / 2 + 1e-6

    def lend_meshes(self, model: Any) -> None:
        """Give a model the meshes of the library."""
        names = [field.name for field in fields(model) if field.name.startswith("mesh_")]
        for name in (*names, "npolygonmax", "nmeshdegmax"):
            setattr(model, name, getattr(self._meshes, name))

    def fill_bodies(self, wp: Any, model: Any, category: Tensor, rows: int) -> None:
        """Set masses of free bodies of category (w, S), or -1, in ``rows`` worlds; a body's frame is its inertia's."""
        missing, category = category < 0, category.clamp(min=0)
        mass = self.mass[category].masked_fill(missing, 1.0)
        moments = self.moments[category].masked_fill(missing[..., None], 1.0)
        inverse = torch.stack([1 / mass, (1 / moments).mean(dim=-1)], dim=-1)

        def put(name: str, values: Tensor, dtype: Any, world: float | None = None) -> None:
            if world is not None:  # the world is body 0
                values = torch.cat([torch.full_like(values[:, :1], world), values], dim=1)
            setattr(model, name, wp.from_torch(_padded(values.float(), rows, 1.0), dtype=dtype))

        put("body_mass", mass, wp.float32, 0.0)
        put("body_inertia", moments, wp.vec3, 0.0)
        put("body_invweight0", inverse, wp.vec2, 0.0)
        put("body_subtreemass", mass, wp.float32, 0.0)
        wp.to_torch(model.body_subtreemass)[: len(mass), 0] = mass.sum(dim=1).float()
        put("dof_invweight0", inverse.repeat_interleave(3, dim=-1).flatten(1), wp.float32)

    def fill(self, wp: Any, model: Any, category: Tensor, part: Tensor, rows: int) -> None:
        """Set geometries of a model in ``rows`` >= w worlds: part number (G,) of assets of category (w, G), or -1."""

        def take(table: Tensor, empty: float) -> Tensor:
            chosen = table[category.clamp(min=0), part]
            missing = (category < 0).reshape(*category.shape, *[1] * (chosen.ndim - 2))
            return _padded(chosen.masked_fill(missing, empty), rows, empty)

        model.geom_dataid = wp.from_torch(take(self.mesh, -1), dtype=wp.int32)
        model.geom_size = wp.from_torch(take(self.size, 1), dtype=wp.vec3)
        model.geom_rbound = wp.from_torch(take(self.rbound, 1), dtype=wp.float32)
        model.geom_aabb = wp.from_torch(take(self.aabb, 1), dtype=wp.vec3)
        model.geom_pos = wp.from_torch(take(self.inner_position, 0), dtype=wp.vec3)
        model.geom_quat = wp.from_torch(take(self.inner_quaternion, 0.5), dtype=wp.quat)


def _template(fixed: int, parts: tuple[int, ...], *, multiple: bool) -> Any:
    """Model of ``fixed`` mesh geometries of the world, and free bodies of ``parts`` each; ``multiple`` is several
    contacts per pair of geometries.
    """
    spec = scene_spec([np.concatenate([np.zeros((1, 3)), np.eye(3)])])
    if not multiple:
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    add_parts(spec.worldbody, [0] * fixed)
    for count in parts:
        body = spec.worldbody.add_body(mass=1.0, inertia=[1.0, 1.0, 1.0], explicitinertial=True)
        body.add_freejoint()
        add_parts(body, [0] * count)
    return spec.compile()


def _chunks(count: int, most: int, device: torch.device) -> list[Tensor]:
    """Numbers below ``count`` in runs of at most ``most``, the first run last."""
    return list(torch.arange(count, device=device).split(most))[::-1] if count else []


def _padded(rows: Tensor, count: int, value: float) -> Tensor:
    """Rows (n, ...) as (count, ...), contiguous; the others hold ``value``."""
    out = torch.full((count, *rows.shape[1:]), value, dtype=rows.dtype, device=rows.device)
    out[: len(rows)] = rows
    return out


def _turned(rotation: Tensor, vector: Tensor) -> Tensor:
    """Rotations (..., 3, 3) of vectors (..., 3)."""
    return (rotation * vector[..., None, :]).sum(dim=-1)
