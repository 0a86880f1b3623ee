"""Generation of shards on a Ray cluster, on this machine or on many."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from scene_envs.datasets import store
from scene_envs.datasets.progress import Report
from scene_envs.datasets.shards import Job, make_shard
from scene_envs.datasets.workers import Work
from scene_envs.errors import InvalidInputError, MissingDependencyError, PhysicsError, SceneEnvsError

_POLL = 0.2


def run_ray(jobs: Sequence[Job], work: Work, workers: int, address: str | None, report: Report) -> None:
    """Make the shards of ``jobs`` as Ray tasks of one CPU each.

    Workers send shards back through Ray and this process writes them, so machines need no common disk. A worker that
    dies is replaced by Ray, which makes its shard again.

    Args:
        jobs: the shards.
        work: what every worker needs. Functions at the top level of an importable module are imported by the workers;
            others are sent to them.
        workers: CPUs of the cluster that is started when there is none.
        address: of a running cluster; None takes the one this process is connected to, or starts one on this machine.
        report: told of the progress.

    Raises:
        MissingDependencyError: Ray is not installed.
        InvalidInputError: there is no cluster at ``address``.
        PhysicsError: a worker died over and over.
        StorageError: a file cannot be written.
    """
    try:
        import ray
        from ray.util.queue import Queue
    except ImportError as error:
        raise MissingDependencyError("backend='ray' needs Ray: pip install 'scene-envs[ray]'") from error
    with _cluster(ray, workers, address):
        queue = Queue(actor_options={"num_cpus": 0})
        task = ray.remote(num_cpus=1, max_retries=3)(_ray_shard)
        payload = ray.put(pickle.dumps((sys.path, ray.cloudpickle.dumps(work))))
        limit = 2 * max(1, int(ray.cluster_resources().get("CPU", 1)))
        waiting = list(reversed(jobs))
        running: dict[Any, Job] = {}
        try:
            while waiting or running:
                while waiting and len(running) < limit:
                    job = waiting.pop()
                    running[task.remote(job, payload, queue)] = job
                done, _ = ray.wait(list(running), timeout=_POLL)
                for reference in done:
                    job = running.pop(reference)
                    store.write_bytes(Path(job.path), _result(ray, reference, job))
                for message in _messages(queue):
                    report(*message)
        finally:
            for reference in running:
                with suppress(Exception):
                    ray.cancel(reference, force=True)
            with suppress(Exception):
                queue.shutdown(force=True)


@contextmanager
def _cluster(ray: Any, workers: int, address: str | None) -> Iterator[None]:
    """Context with a connection to Ray; a connection that is opened here is closed here."""
    if ray.is_initialized():
        yield
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR", "configure_logging": False}
    try:
        if address is None:
            ray.init(num_cpus=max(1, workers), include_dashboard=False, **options)
        else:
            ray.init(address=address, **options)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise InvalidInputError(f"cannot connect to a Ray cluster at address={address!r}: {error}") from error
    try:
        yield
    finally:
        ray.shutdown()


def _result(ray: Any, reference: Any, job: Job) -> bytes:
    try:
        return bytes(ray.get(reference))
    except ray.exceptions.RayTaskError as error:
        cause = error.cause if isinstance(getattr(error, "cause", None), Exception) else error
        if isinstance(cause, SceneEnvsError):
            raise cause from error
        if isinstance(cause, ImportError):
            raise InvalidInputError(
                f"a Ray worker cannot import what the grammar needs ({cause}); install it on every machine"
            ) from error
        raise
    except ray.exceptions.RayError as error:
        raise PhysicsError(
            f"the Ray worker of shard {job.index} died ({type(error).__name__}; out of memory?); finished shards are "
            "kept, run again to resume"
        ) from error


def _messages(queue: Any) -> list[Any]:
    waiting = queue.qsize()
    return list(queue.get_nowait_batch(waiting)) if waiting else []


# -- in the worker ------------------------------------------------------------------------------------

_started: dict[bytes, Any] = {}


def _ray_shard(job: Job, payload: bytes, queue: Any) -> bytes:
    if payload not in _started:
        _started.clear()
        paths, work = pickle.loads(payload)
        sys.path.extend(path for path in paths if path not in sys.path)  # where machines share a disk
        _started[payload] = pickle.loads(work).start()
    grammar, normalizer = _started[payload]
    return make_shard(job, grammar, normalizer, lambda *message: queue.put(message))
