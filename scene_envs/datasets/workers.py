"""Generation of shards in this process or in spawned processes of this machine."""

from __future__ import annotations

import os
import pickle
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, fields
from multiprocessing import get_context
from pathlib import Path
from queue import Empty
from threading import Thread
from time import sleep
from typing import Any

import torch

from scene_envs.datasets import store
from scene_envs.datasets.progress import Report
from scene_envs.datasets.shards import Job, make_shard, shard_journal
from scene_envs.errors import InvalidInputError, PhysicsError
from scene_envs.grammars import Grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType, register_scene_type
from scene_envs.worker_processes import no_current_folder

_RESTARTS = 3


@dataclass(frozen=True)
class Work:
    """Inputs of every worker, picklable.

    Attributes:
        factory: makes the grammar.
        scene_type: of the grammar; registered in the worker before the grammar is made.
        normalizer_state: of the dataset.
    """

    factory: Callable[[], Grammar]
    scene_type: SceneType
    normalizer_state: dict[str, Any]

    @classmethod
    def of(cls, factory: Callable[[], Grammar], scene_type: SceneType, normalizer: Normalizer) -> Work:
        """The inputs, with a copy of the scene type that holds its data alone (no built assets)."""
        plain = SceneType(**{field.name: getattr(scene_type, field.name) for field in fields(scene_type)})
        return cls(factory, plain, normalizer.state())

    def start(self) -> tuple[Grammar, Normalizer]:
        """The grammar and normalizer, in the worker."""
        torch.set_num_threads(1)
        register_scene_type(self.scene_type)
        return self.factory(), Normalizer.from_state(self.normalizer_state)


def write_shard_of(job: Job, grammar: Grammar, normalizer: Normalizer, report: Report) -> None:
    """Make one shard and write it where it belongs; raises StorageError."""
    journal = shard_journal(job)
    store.write_bytes(Path(job.path), make_shard(job, grammar, normalizer, report, journal))
    journal.remove()


def run_processes(jobs: Sequence[Job], work: Work, workers: int, report: Report) -> None:
    """Make the shards of ``jobs`` in ``workers`` spawned processes.

    Raises:
        InvalidInputError: the grammar's function cannot be sent to a process, or not be imported there.
        PhysicsError: worker processes keep dying.
        StorageError: a file cannot be written.
    """
    try:
        payload = pickle.dumps(work)
    except (pickle.PicklingError, AttributeError) as error:
        raise InvalidInputError(
            f"the grammar's function cannot be sent to worker processes ({error}); "
            "define it at the top level of a module, or use workers=0"
        ) from error
    main = sys.modules["__main__"]
    if work.factory.__module__ == "__main__" and not Path(getattr(main, "__file__", None) or "").is_file():
        raise InvalidInputError(
            "the grammar's function stands in a notebook or at a prompt, where worker processes cannot import it; "
            "define it in a module, or use workers=0"
        )
    context = get_context("spawn")
    for _ in range(_RESTARTS):
        with no_current_folder():  # the first semaphore starts a process that tracks semaphores
            queue, stop = context.Queue(), context.Event()
        left = [job for job in jobs if not Path(job.path).is_file()]
        executor = ProcessPoolExecutor(workers, context, _start_worker, (payload, queue, stop))
        try:
            with no_current_folder():  # the processes start when they are given work
                futures = [executor.submit(_work, job) for job in left]
            _follow(futures, queue, report)
            return
        except BrokenProcessPool:
            continue  # the next round resumes the unfinished shards
        finally:
            stop.set()  # after an error, the other workers end with their chunk
            executor.shutdown(cancel_futures=True)
            queue.close()
    raise PhysicsError(
        f"worker processes died {_RESTARTS} times while generating; finished shards are kept. When memory ran out, run "
        "again to resume, with fewer workers; a script must call generate under `if __name__ == '__main__':`"
    )


def _follow(futures: list[Future[int]], queue: Any, report: Report) -> None:
    """Pass on the workers' reports until every future is done; raises what a worker raised."""
    pending = set(futures)
    while pending:
        with suppress(Empty):
            report(*queue.get(timeout=0.2))
        for future in [future for future in pending if future.done()]:
            future.result()
            pending.discard(future)


# -- in the worker ------------------------------------------------------------------------------------

_worker: dict[str, Any] = {}


class _Stopped(Exception):
    """The run is over; nobody waits for this shard."""


def _start_worker(payload: bytes, queue: Any, stop: Any) -> None:
    queue.cancel_join_thread()  # reports that nobody reads must not hold the process
    Thread(target=_exit_with_parent, args=(os.getppid(),), daemon=True).start()
    _worker.update(queue=queue, stop=stop)
    try:
        _worker["grammar"], _worker["normalizer"] = pickle.loads(payload).start()
    except (ImportError, AttributeError) as error:
        _worker["error"] = f"worker processes cannot import what the grammar needs ({error}); use workers=0"


def _exit_with_parent(parent: int) -> None:
    """End this worker when the process that started it is gone (it may have been killed)."""
    while os.getppid() == parent:
        sleep(1.0)
    os._exit(1)


def _work(job: Job) -> int:
    if "error" in _worker:
        raise InvalidInputError(_worker["error"])

    def report(*message: Any) -> None:
        if _worker["stop"].is_set():
            raise _Stopped
        _worker["queue"].put(message)

    write_shard_of(job, _worker["grammar"], _worker["normalizer"], report)
    return job.index
