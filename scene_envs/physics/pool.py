"""Worker processes for physics: order-preserving, with a retry when a worker dies."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import subprocess
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from scene_envs.assets import Asset
from scene_envs.errors import InvalidInputError, PhysicsError, SceneEnvsError
from scene_envs.physics.kernels import KERNELS, Chunk
from scene_envs.scene_types import SceneType
from scene_envs.worker_processes import module_command, module_environment

_LOGGER = logging.getLogger(__name__)
_NO_MESH: Any = None
"""In place of an asset's mesh: workers draw nothing, so meshes are not sent to them."""
START_UP = 120.0
"""Seconds that a worker may take to start, or to build the geometry of a scene type."""
_MOST_FAILED_STARTS = 3
_SINGLE_THREADED = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclasses.dataclass
class _Task:
    """Rows ``rows`` of a batch, to be run together."""

    rows: list[int]
    chunk: Chunk
    is_retry: bool = False


class _Worker:
    """One process and the two pipes to it."""

    def __init__(self) -> None:
        child_reads, parent_writes = os.pipe()
        parent_reads, child_writes = os.pipe()
        self.process = subprocess.Popen(
            module_command("scene_envs.physics.worker", str(child_reads), str(child_writes)),
            pass_fds=(child_reads, child_writes),
            env=module_environment() | _SINGLE_THREADED,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        os.close(child_reads)
        os.close(child_writes)
        self.outbox = Connection(parent_writes, readable=False)
        self.inbox = Connection(parent_reads, writable=False)
        self.known: set[int] = set()
        self.is_ready = False
        self.task: _Task | None = None
        self.deadline = time.monotonic() + START_UP

    def send(self, message: tuple[Any, ...]) -> None:
        """Give the process a message; a process that died is noticed by :meth:`receive`."""
        with contextlib.suppress(OSError):
            self.outbox.send(message)

    def receive(self) -> tuple[str, Any]:
        """The reply to the last message; raises EOFError or OSError when the process died."""
        return self.inbox.recv()

    @property
    def process_id(self) -> int:
        """Id of the process in the operating system."""
        return self.process.pid

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self.process.poll() is None

    @property
    def end(self) -> str:
        """How the process ended."""
        return f"exit status {self.process.returncode}"

    def stop(self) -> None:
        """End the process and close the pipes."""
        self.outbox.close()
        self.inbox.close()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


class PhysicsPool:
    """Spawned processes that do physics on chunks of scenes.

    Results come in order and do not depend on the number of workers. A chunk whose worker dies or exceeds
    ``timeout`` is tried once more, scene by scene; scenes that fail again are invalid and the others are not
    affected. The pool stays usable: lost workers are replaced.

    Args:
        workers: number of processes; 0 computes in this process.
        timeout: seconds that a chunk of up to eight scenes may take.

    >>> with PhysicsPool(workers=0) as pool:
    ...     pool.workers
    0
    """

    def __init__(self, workers: int = 1, timeout: float = 60.0) -> None:
        if workers < 0:
            raise InvalidInputError(f"workers must be 0 or more, got {workers}; 0 computes in this process")
        if not timeout > 0:
            raise InvalidInputError(f"timeout must be a positive number of seconds, got {timeout}")
        self.workers = workers
        self.timeout = timeout
        self._live: list[Any] = []  # of _Worker, or of what a subclass starts
        self._scene_types: dict[tuple[SceneType, tuple[int, ...]], tuple[int, tuple[Asset, ...]]] = {}
        self._lock = threading.Lock()
        self._closed = False
        self._failed_starts = 0

    def __enter__(self) -> PhysicsPool:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def __del__(self) -> None:
        with contextlib.suppress(Exception):
            self.close()

    def close(self) -> None:
        """End all workers; the pool cannot be used afterwards."""
        self._closed = True
        for worker in self._live:
            worker.stop()
        self._live = []

    @property
    def process_ids(self) -> list[int]:
        """Operating-system ids of the running workers."""
        return [worker.process_id for worker in self._live]

    def run(self, kernel: str, chunks: Sequence[Chunk], options: Mapping[str, Any]) -> list[dict[str, Any] | None]:
        """Run a kernel on every chunk.

        Args:
            kernel: name of a function of ``scene_envs.physics.kernels.KERNELS``.
            chunks: scenes, all of one scene type.
            options: keyword arguments of the kernel.

        Returns:
            One result per *scene*, in order; each holds one row, or is None where the scene failed twice.

        Raises:
            SceneEnvsError: the kernel refused (a missing dependency, an unknown asset).
        """
        if self._closed:
            raise PhysicsError("this PhysicsPool was closed; make a new one")
        tasks: deque[_Task] = deque()
        total = 0
        for chunk in chunks:
            tasks.append(_Task(list(range(total, total + len(chunk))), chunk))
            total += len(chunk)
        results: list[dict[str, Any] | None] = [None] * total
        if self.workers == 0:
            run_here(kernel, tasks, options, results)
            return results
        with self._lock:
            try:
                self._run_all(kernel, tasks, dict(options), results)
            except BaseException:
                self._discard_busy()
                raise
        return results

    # -- the loop -------------------------------------------------------------------------------

    def _run_all(
        self, kernel: str, tasks: deque[_Task], options: dict[str, Any], results: list[dict[str, Any] | None]
    ) -> None:
        for worker in [w for w in self._live if w.task is None and not w.is_alive]:  # ended between two calls
            self._live.remove(worker)
            worker.stop()
        while tasks or any(worker.task for worker in self._live):
            while len(self._live) < min(self.workers, len(tasks) + sum(w.task is not None for w in self._live)):
                self._live.append(self._start())
            for worker in self._live:
                if worker.is_ready and worker.task is None and tasks:
                    self._next(worker, tasks, kernel, options)
            self._collect(tasks, results)

    def _next(self, worker: Any, tasks: deque[_Task], kernel: str, options: dict[str, Any]) -> None:
        """Give an idle worker the scene type it lacks, or its next task."""
        scene_type = tasks[0].chunk.scene_type
        own = scene_type.library.assets  # other objects once a file of a model has changed
        entry = (scene_type, tuple(map(id, own)))
        key, _ = self._scene_types.setdefault(entry, (len(self._scene_types), own))
        message: tuple[Any, ...]
        if key not in worker.known:
            assets = tuple(dataclasses.replace(asset, visual=_NO_MESH) for asset in scene_type.library)
            message = ("scene_type", key, dataclasses.replace(scene_type), assets)
            worker.known.add(key)
            worker.is_ready, worker.deadline = False, time.monotonic() + START_UP
        else:
            worker.task = tasks.popleft()
            chunk = worker.task.chunk
            message = (
                "run",
                kernel,
                key,
                (chunk.translations, chunk.rotations, chunk.categories, chunk.units),
                options,
            )
            worker.deadline = time.monotonic() + self.timeout
        worker.send(message)

    def _start(self) -> Any:
        """A new worker."""
        return _Worker()

    def _answering(self, waiting: Sequence[Any], timeout: float) -> list[Any]:
        """The workers that replied or died, as soon as there are some, or none after ``timeout`` seconds."""
        ready = wait([worker.inbox for worker in waiting], timeout=timeout)
        return [worker for worker in waiting if worker.inbox in ready]

    def _collect(self, tasks: deque[_Task], results: list[dict[str, Any] | None]) -> None:
        """Wait for the next message, death or deadline."""
        waiting = [worker for worker in self._live if worker.task is not None or not worker.is_ready]
        if not waiting:
            return
        nearest = min(worker.deadline for worker in waiting) - time.monotonic()
        ready = self._answering(waiting, max(0.0, nearest))
        for worker in waiting:
            if worker in ready:
                self._receive(worker, tasks, results)
            elif time.monotonic() > worker.deadline:
                self._lose(worker, tasks, f"took longer than {self.timeout:g} s")

    def _receive(self, worker: Any, tasks: deque[_Task], results: list[dict[str, Any] | None]) -> None:
        try:
            kind, body = worker.receive()
        except (EOFError, OSError):
            self._lose(worker, tasks, "died")
            return
        if kind == "ready":
            worker.is_ready = True
            self._failed_starts = 0
            return
        task, worker.task = worker.task, None
        assert task is not None
        if kind == "done":
            _store(task, body, results)
        elif kind == "refused":
            raise body
        else:
            _retry(task, tasks, f"failed ({body})")

    def _lose(self, worker: Any, tasks: deque[_Task], how: str) -> None:
        task, started = worker.task, worker.is_ready
        self._live.remove(worker)
        worker.stop()
        if task is not None:
            _retry(task, tasks, how)
        elif not started:
            self._failed_starts += 1
            if self._failed_starts >= _MOST_FAILED_STARTS:
                raise PhysicsError(
                    f"{self._failed_starts} physics workers in a row {how} while starting "
                    f"({worker.end}); their own message is on stderr"
                )

    def _discard_busy(self) -> None:
        for worker in [w for w in self._live if w.task is not None or not w.is_ready]:
            self._live.remove(worker)
            worker.stop()


def run_here(
    kernel: str, tasks: deque[_Task], options: Mapping[str, Any], results: list[dict[str, Any] | None]
) -> None:
    """Run all tasks in this process."""
    while tasks:
        task = tasks.popleft()
        try:
            _store(task, KERNELS[kernel](task.chunk, **options), results)
        except SceneEnvsError:
            raise
        except Exception as error:
            _retry(task, tasks, f"failed ({type(error).__name__}: {error})")


def _store(task: _Task, result: dict[str, Any], results: list[dict[str, Any] | None]) -> None:
    for index, row in enumerate(task.rows):
        results[row] = {name: values[index] for name, values in result.items()}


def _retry(task: _Task, tasks: deque[_Task], how: str) -> None:
    """Try a task again, scene by scene; give up on a scene that was tried again already."""
    if task.is_retry:
        _LOGGER.warning("physics of scene %d %s twice; the scene is invalid", task.rows[0], how)
        return
    _LOGGER.warning("physics of scenes %d to %d %s; trying them once more", task.rows[0], task.rows[-1], how)
    for index, row in reversed(list(enumerate(task.rows))):
        tasks.appendleft(_Task([row], task.chunk.row(index), is_retry=True))
