"""Generation of a dataset from a grammar: sharded, seeded, parallel, resumable."""

from __future__ import annotations

import os
import pickle
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from queue import Empty
from threading import Thread
from time import perf_counter, sleep
from typing import Any

import numpy as np
import torch

from scene_envs.datasets import store
from scene_envs.datasets.prompts import describe
from scene_envs.datasets.ranges import fixed_normalizer
from scene_envs.datasets.verification import verify_scenes
from scene_envs.errors import InvalidInputError, PhysicsError
from scene_envs.grammars import Grammar, get_grammar
from scene_envs.grammars.grammar import grammar_factory
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType

Report = Callable[[int, int, dict[str, int]], None]
"""Called with (scenes kept, scenes tried, reasons) since the last call."""

_CHUNK = 32
"""Scenes built and verified at a time; does not change the result."""
_RESTARTS = 3
_SETTINGS = ("grammar", "seed", "count", "shard_size", "verified")


@dataclass(frozen=True)
class GenerationReport:
    """What a generation made.

    Attributes:
        output: the dataset folder.
        scenes: scenes in it.
        tried: scenes built by the grammar to get them (those that physics then threw away included).
        reasons: why structures and scenes were thrown away, most frequent first.
        seconds: wall time of this call; short when a run was resumed.
    """

    output: Path
    scenes: int
    tried: int
    reasons: dict[str, int]
    seconds: float


def generate(
    scene_type: str,
    count: int,
    output: str | os.PathLike[str],
    *,
    seed: int = 0,
    workers: int = 2,
    verify: bool = True,
    shard_size: int = 2000,
    progress: bool = True,
) -> GenerationReport:
    """Write ``count`` scenes with prompts into the folder ``output``.

    Each shard depends on (grammar, seed, shard index) alone, so the result does not depend on the number
    of workers, and a run killed at any point gives the same files when it is started again: finished
    shards are kept, the others are made.

    Args:
        scene_type: name of a grammar (built-in ones are called like their scene type).
        count: scenes to write.
        output: folder; made when missing.
        seed: any non-negative integer.
        workers: spawned processes; 0 runs in this one.
        verify: keep only scenes that pass :func:`~scene_envs.datasets.verification.verify_scenes`.
        shard_size: scenes per parquet file.
        progress: show a live progress bar.

    Raises:
        InvalidInputError: a bad argument, or ``output`` holds a dataset made with other settings.
        UnknownNameError: no grammar of that name.
        PhysicsError: worker processes keep dying.
    """
    if count < 1 or shard_size < 1 or workers < 0 or seed < 0:
        raise InvalidInputError(
            f"generate needs count >= 1, shard_size >= 1, workers >= 0 and seed >= 0, "
            f"got count={count}, shard_size={shard_size}, workers={workers}, seed={seed}"
        )
    start = perf_counter()
    grammar = get_grammar(scene_type)
    folder = Path(output)
    settings = {"grammar": scene_type, "seed": seed, "count": count, "shard_size": shard_size, "verified": verify}
    normalizer = _prepare(folder, grammar, settings)
    sizes = [min(shard_size, count - first) for first in range(0, count, shard_size)]
    paths = [folder / store.shard_name(index) for index in range(len(sizes))]
    jobs = [
        _Job(index, size, seed, verify, str(path))
        for index, (size, path) in enumerate(zip(sizes, paths, strict=True))
        if not path.is_file()
    ]
    done = count - sum(job.size for job in jobs)
    with _progress(f"Generating {scene_type}", done, count, progress) as report:
        if workers == 0:
            for job in jobs:
                _make_shard(job, grammar, normalizer, report)
        elif jobs:
            _run_workers(jobs, grammar_factory(scene_type), normalizer, min(workers, len(jobs)), report)
    notes = [store.read_notes(path) for path in paths]
    reasons: Counter[str] = Counter()
    for note in notes:
        reasons.update(note["reasons"])
    tried = sum(note["tried"] for note in notes)
    return GenerationReport(folder, count, tried, dict(reasons.most_common()), perf_counter() - start)


@dataclass(frozen=True)
class _Job:
    index: int
    size: int
    seed: int
    verify: bool
    path: str


def _prepare(folder: Path, grammar: Grammar, settings: dict[str, Any]) -> Normalizer:
    """Make the folder and its metadata, or check that they fit ``settings``; returns the normalizer."""
    scene_type: SceneType = grammar.scene_type
    path = folder / store.METADATA
    store.remove_partial(folder)
    if path.exists():
        metadata = store.read_metadata(path)
        differing = [key for key in _SETTINGS if metadata.get(key) != settings[key]]
        if differing:
            was = {key: metadata.get(key) for key in differing}
            now = {key: settings[key] for key in differing}
            raise InvalidInputError(
                f"{str(folder)!r} holds a dataset made with {was}, this call asks for {now}; "
                "choose another output folder, or the same settings to resume"
            )
        return Normalizer.from_state(metadata["normalizer_state"])
    if folder.is_dir() and any(folder.glob("*.parquet")):
        raise InvalidInputError(f"{str(folder)!r} holds parquet files but no {store.METADATA}; choose an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    normalizer = fixed_normalizer(grammar)
    store.write_json(path, store.make_metadata(scene_type, normalizer, **settings))
    return normalizer


def _make_shard(job: _Job, grammar: Grammar, normalizer: Normalizer, report: Report) -> None:
    """Build, verify and write one shard; a function of its job and grammar alone."""
    scenes_rng, prompts_rng = (np.random.default_rng([job.seed, job.index, stream]) for stream in (0, 1))
    grammar.reasons.clear()
    reasons: Counter[str] = Counter()
    kept: list[torch.Tensor] = []
    total = tried = 0
    while total < job.size:
        batch = SceneBatch(torch.from_numpy(grammar.sample_array(scenes_rng, _CHUNK)), grammar.scene_type)
        before = reasons.copy()
        passed = verify_scenes(batch, reasons) if job.verify else torch.ones(_CHUNK, dtype=torch.bool)
        kept.append(batch.tensor[passed])
        fresh = min(int(passed.sum()), job.size - total)
        total, tried = total + fresh, tried + _CHUNK
        report(fresh, _CHUNK, dict(reasons - before))
    scenes = torch.cat(kept)[: job.size]
    prompts = describe(SceneBatch(scenes, grammar.scene_type), prompts_rng)
    notes = {"tried": tried, "reasons": dict(sorted((+reasons + grammar.reasons).items()))}
    store.write_shard(Path(job.path), normalizer.normalize(scenes).numpy(), prompts, notes)


# -- worker processes ---------------------------------------------------------------------------------

_worker: dict[str, Any] = {}


def _start_worker(payload: bytes, queue: Any) -> None:
    torch.set_num_threads(1)
    Thread(target=_exit_with_parent, args=(os.getppid(),), daemon=True).start()
    factory, normalizer_state = pickle.loads(payload)
    _worker.update(grammar=factory(), normalizer=Normalizer.from_state(normalizer_state), queue=queue)


def _exit_with_parent(parent: int) -> None:
    """End this worker when the process that started it is gone (it may have been killed)."""
    while os.getppid() == parent:
        sleep(1.0)
    os._exit(1)


def _work(job: _Job) -> int:
    _make_shard(job, _worker["grammar"], _worker["normalizer"], lambda *message: _worker["queue"].put(message))
    return job.index


def _run_workers(
    jobs: list[_Job], factory: Callable[[], Grammar], normalizer: Normalizer, workers: int, report: Report
) -> None:
    try:
        payload = pickle.dumps((factory, normalizer.state()))
    except (pickle.PicklingError, AttributeError) as error:
        raise InvalidInputError(
            f"the grammar's function cannot be sent to worker processes ({error}); "
            "define it at the top level of a module, or use workers=0"
        ) from error
    context = get_context("spawn")
    for _ in range(_RESTARTS):
        queue = context.Queue()
        left = [job for job in jobs if not Path(job.path).is_file()]
        executor = ProcessPoolExecutor(workers, context, _start_worker, (payload, queue))
        try:
            futures = [executor.submit(_work, job) for job in left]
            _follow(futures, queue, report)
            return
        except BrokenProcessPool:
            continue  # the shards that were under way are made again
        finally:
            executor.shutdown(wait=False, cancel_futures=True)
            queue.close()
    raise PhysicsError(
        f"worker processes died {_RESTARTS} times while generating (out of memory?); finished shards are kept, "
        "run again to resume, with fewer workers"
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
    while not queue.empty():  # a worker cannot exit before its last reports are read
        queue.get()


@contextmanager
def _progress(title: str, done: int, count: int, show: bool) -> Iterator[Report]:
    """A live bar with scenes/s and the most frequent reasons; yields the function that advances it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:.1f} scenes/s"),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.fields[reasons]}"),
    )
    totals: Counter[str] = Counter()
    kept, start = 0, perf_counter()
    with Progress(*columns, console=Console(stderr=True), disable=not show) as bar:
        task = bar.add_task(title, total=count, completed=done, rate=0.0, reasons="")

        def report(fresh: int, tried: int, reasons: dict[str, int]) -> None:
            nonlocal kept
            kept += fresh
            totals.update(reasons)
            dropped = ", ".join(f"{name} {number}" for name, number in totals.most_common(3))
            bar.update(task, advance=fresh, rate=kept / (perf_counter() - start), reasons=dropped)

        yield report
        bar.update(task, completed=count)
