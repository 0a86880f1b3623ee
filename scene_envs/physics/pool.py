"""Physics in worker processes of this machine or on a Ray cluster."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import accumulate
from typing import Any

from scene_envs.assets.base import Asset, AssetLibrary
from scene_envs.errors import WORKERS
from scene_envs.physics.engines import engine_name
from scene_envs.physics.kernels import KERNELS, Chunk
from scene_envs.physics.parts import library_geometry
from scene_envs.scene_types import SceneType
from scene_envs.workers import Task, WorkerFailure, WorkerPool

_LOGGER = logging.getLogger(__name__)
_ENVIRONMENT = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""One thread for each worker: there are as many workers as a user wants threads."""


class KernelRunner:
    """Answers of a physics worker, which receives scene types once and chunks of poses and categories afterwards."""

    def __init__(self) -> None:
        self._scene_types: dict[int, SceneType] = {}

    def __call__(self, message: tuple[Any, ...]) -> dict[str, Any] | None:
        """Take in a scene type, or run a kernel."""
        if message[0] == "scene_type":
            _, key, scene_type, assets = message
            scene_type.__dict__["library"] = AssetLibrary(assets)  # what the cached property would hold
            self._scene_types[key] = scene_type
            library_geometry(scene_type.library.assets)  # geometry is built before the first chunk's clock starts
            return None
        kernel, scene_type, arrays, options = message
        return KERNELS[kernel](Chunk(self._scene_types.get(scene_type, scene_type), *arrays), **options)


class PhysicsPool(WorkerPool):
    """Spawned processes that do physics on chunks of scenes.

    Results come in order and do not depend on the number of workers. A chunk whose worker dies or exceeds
    ``timeout`` is tried once more, scene by scene; scenes that fail again are invalid and the others are not
    affected. The pool stays usable: lost workers are replaced.

    Args:
        workers: number of processes; 0 computes in this process.
        timeout: seconds that a chunk of up to eight scenes may take.
        physics: engine that computes overlap and motion.

    >>> with PhysicsPool(workers=0) as pool:
    ...     pool.workers
    0
    """

    def __init__(self, workers: int | None = 1, timeout: float = 60.0, physics: str = "auto", **options: Any) -> None:
        self.engine = engine_name(physics)
        options = {"environment": _ENVIRONMENT, **options}
        super().__init__(f"{__name__}:KernelRunner", workers=workers, timeout=timeout, **options)
        self._scene_types: dict[tuple[SceneType, tuple[int, ...]], tuple[int, tuple[Asset, ...]]] = {}

    def run(self, kernel: str, chunks: Sequence[Chunk], options: Mapping[str, Any]) -> list[dict[str, Any] | None]:
        """Run a kernel of ``scene_envs.physics.kernels.KERNELS`` with its options on chunks of one scene type.

        Returns one result per *scene*, in order: a row of each array of the kernel, or None where the scene failed
        twice. Raises SceneEnvsError where the kernel refuses (a missing dependency, an unknown asset).
        """
        firsts = accumulate(map(len, chunks), initial=0)
        tasks = [
            self._task(kernel, chunk, {**options, "engine": self.engine}, first)
            for chunk, first in zip(chunks, firsts, strict=False)
        ]
        rows: list[dict[str, Any] | None] = []
        for result in self.map(tasks):
            if isinstance(result, WorkerFailure):
                _LOGGER.warning("physics of scene %d %s twice; the scene is invalid", len(rows), result)
                rows.append(None)
            else:
                count = len(result["valid"])
                rows += [{name: values[index] for name, values in result.items()} for index in range(count)]
        return rows

    def _task(self, kernel: str, chunk: Chunk, options: dict[str, Any], first: int) -> Task:
        scene_type: Any = chunk.scene_type
        once = None
        if self.workers:
            own = scene_type.library.assets  # other objects once a file of a model has changed
            entry = (scene_type, tuple(map(id, own)))
            key, _ = self._scene_types.setdefault(entry, (len(self._scene_types), own))
            once, scene_type = (key, partial(_scene_type_message, key, scene_type)), key
        arrays = (chunk.translations, chunk.rotations, chunk.categories, chunk.units, chunk.calm)
        return Task(
            (kernel, scene_type, arrays, options),
            f"physics of scenes {first} to {first + len(chunk) - 1}",
            once,
            lambda: [self._task(kernel, chunk[row : row + 1], options, first + row) for row in range(len(chunk))],
        )


def _scene_type_message(key: int, scene_type: SceneType) -> tuple[Any, ...]:
    no_mesh: Any = None  # workers draw nothing, so meshes are not sent to them
    assets = tuple(dataclasses.replace(asset, visual=no_mesh) for asset in scene_type.library)
    return "scene_type", key, dataclasses.replace(scene_type), assets


def make_pool(workers: int | str, timeout: float = 60.0, physics: str = "auto") -> PhysicsPool:
    """A pool of processes of this machine, or with ``"ray"`` of actors of a Ray cluster, as many as it has CPUs.

    The cluster is the one that this process is connected to, or else the one that ``RAY_ADDRESS`` names. Without either
    it is a cluster on this machine, which ends with the last pool. Actors are spread over the machines of the cluster.
    Each machine needs this package. Order, retries, timeouts and results are those of a pool of processes.

    Args:
        workers: number of processes, 0 for this one alone, or ``"ray"``.
        timeout: seconds for a chunk, as :class:`PhysicsPool` takes it.
        physics: engine that computes overlap and motion.

    Raises:
        InvalidInputError: ``workers`` is neither a whole number nor ``"ray"``, or no cluster is at ``RAY_ADDRESS``.
        MissingDependencyError: Ray is not installed.

    >>> make_pool(0).workers
    0
    """
    WORKERS.check("", "workers", workers, False)
    number = None if isinstance(workers, str) else workers
    return PhysicsPool(number, timeout, physics, ray=number is None)
