"""Physics workers on a Ray cluster, on this machine or on many."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.physics.pool import START_UP, PhysicsPool
from scene_envs.physics.worker import answer

_users = 0
"""Number of pools of this process that use the connection to Ray; one of these pools made it."""


class RayPhysicsPool(PhysicsPool):
    """A :class:`PhysicsPool` whose workers are actors of a Ray cluster, as many as it has CPUs.

    Order, retries, timeouts and results are those of a pool of processes. The cluster is the one that this process is
    connected to, or else the one that ``RAY_ADDRESS`` names. Without either it is a cluster on this machine, which ends
    with the last pool. Actors are spread over the machines of the cluster. Each machine needs this package.

    Args:
        timeout: seconds that a chunk of up to eight scenes may take.

    Raises:
        MissingDependencyError: Ray is not installed.
        InvalidInputError: there is no cluster at ``RAY_ADDRESS``.
    """

    def __init__(self, timeout: float = 60.0) -> None:
        super().__init__(0, timeout)
        self._closed = True  # until there is a cluster
        try:
            import ray
        except ImportError as error:
            raise MissingDependencyError("workers='ray' needs Ray: pip install 'scene-envs[ray]'") from error
        self._ray: Any = ray
        self._has_connection = False
        self._connect()
        self.workers = max(1, int(ray.cluster_resources().get("CPU", 1)))
        self._closed = False

    def _connect(self) -> None:
        global _users
        if self._ray.is_initialized() and not _users:
            return  # other code made the connection
        if not _users:
            options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "configure_logging": False}
            try:
                self._ray.init(include_dashboard=None if "RAY_ADDRESS" in os.environ else False, **options)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise InvalidInputError(
                    f"cannot connect to a Ray cluster (RAY_ADDRESS={os.environ.get('RAY_ADDRESS', '')!r}): {error}"
                ) from error
        _users += 1
        self._has_connection = True

    def close(self) -> None:
        """End all workers, and the connection to Ray with the last pool that uses it."""
        global _users
        super().close()
        if getattr(self, "_has_connection", False):
            self._has_connection = False
            _users -= 1
            if not _users:
                self._ray.shutdown()

    def _start(self) -> _RayWorker:
        return _RayWorker(self._ray)

    def _answering(self, waiting: Sequence[Any], timeout: float) -> list[Any]:
        references = [worker.reply for worker in waiting]
        done, _ = self._ray.wait(references, num_returns=1, timeout=timeout)
        return [worker for worker in waiting if worker.reply in done]


class _RayWorker:
    """One actor and the reference to its next reply."""

    end = "an actor of Ray"
    is_alive = True  # an actor that ended is noticed by :meth:`receive`

    def __init__(self, ray: Any) -> None:
        self._ray = ray
        # no CPU is reserved: a pool that has nothing to do must not keep another pool from starting workers
        options = {"num_cpus": 0, "max_restarts": 0, "scheduling_strategy": "SPREAD"}
        self.actor = ray.remote(_Actor).options(**options).remote([path or os.getcwd() for path in sys.path])
        self.reply = self.actor.answer.remote(("hello",))
        self.known: set[int] = set()
        self.is_ready = False
        self.task: Any = None
        self.deadline = time.monotonic() + START_UP

    @property
    def process_id(self) -> int:
        """Id of the actor's process in the operating system of its machine."""
        return int(self._ray.get(self.actor.process_id.remote()))

    def send(self, message: tuple[Any, ...]) -> None:
        """Give the actor a message; an actor that died is noticed by :meth:`receive`."""
        self.reply = self.actor.answer.remote(message)

    def receive(self) -> tuple[str, Any]:
        """The reply to the last message; raises EOFError when the actor died."""
        try:
            kind, body = self._ray.get(self.reply)
        except self._ray.exceptions.RayError as error:
            raise EOFError(str(error)) from error
        if kind == "done":  # arrays of the object store are read-only
            body = {name: part.copy() if isinstance(part, np.ndarray) else part for name, part in body.items()}
        return kind, body

    def stop(self) -> None:
        """End the actor, whatever it does."""
        with contextlib.suppress(Exception):
            self._ray.kill(self.actor)


class _Actor:
    """A worker of the pool inside an actor."""

    def __init__(self, paths: Sequence[str]) -> None:
        sys.path.extend(path for path in paths if path not in sys.path)  # for machines that share a disk
        self.scene_types: dict[int, Any] = {}

    def process_id(self) -> int:
        """Id of this process in the operating system."""
        return os.getpid()

    def answer(self, message: tuple[Any, ...]) -> tuple[str, Any]:
        """The reply to one message."""
        return ("ready", None) if message == ("hello",) else answer(self.scene_types, message)
