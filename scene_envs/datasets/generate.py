"""Generation of a dataset from a grammar: sharded, seeded, parallel, resumable."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from scene_envs.datasets import store
from scene_envs.datasets.info import read_metadata
from scene_envs.datasets.progress import Report, generation_progress
from scene_envs.datasets.ranges import fixed_normalizer
from scene_envs.datasets.ray_workers import run_ray
from scene_envs.datasets.shards import Job, shard_journal
from scene_envs.datasets.workers import Work, run_processes, write_shard_of
from scene_envs.errors import CorruptFileError, InvalidInputError, unknown_name
from scene_envs.files import storage_error, with_digest, write_json
from scene_envs.grammars import Grammar, get_grammar
from scene_envs.grammars.catalogue import grammar_factory
from scene_envs.normalizer import Normalizer
from scene_envs.scene_types import SceneType, get_scene_type

BACKENDS = ("processes", "ray")
"""Backends that make shards."""
_SETTINGS = ("grammar", "seed", "count", "shard_size", "verified")


@dataclass(frozen=True)
class GenerationReport:
    """Result of a generation.

    Attributes:
        output: the dataset folder.
        scenes: scenes in it.
        tried: scenes that the grammar built, those rejected by physics included.
        reasons: rejected structures and scenes by reason, most frequent first.
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
    progress: bool | str = True,
    backend: str = "processes",
    address: str | None = None,
) -> GenerationReport:
    """Write ``count`` scenes with three prompts each into the folder ``output``.

    Each shard depends on (grammar, seed, shard index) alone, so the result does not depend on the number of workers or
    on where they run. A run killed at any point gives the same files when it is started again. Finished shards are
    kept, and the verdicts of an unfinished shard are reused (with Ray an unfinished shard begins anew).

    Args:
        scene_type: name of a grammar (built-in ones are called like their scene type).
        count: scenes to write.
        output: folder; made when missing.
        seed: any non-negative integer.
        workers: spawned processes; 0 runs in this one. With Ray: CPUs of the cluster that is started here.
        verify: keep only scenes that pass :func:`~scene_envs.datasets.verification.verify_scenes`.
        shard_size: scenes per parquet file.
        progress: True for a live bar (a line every 30 s where there is no terminal), False for none, or a style of
            :class:`~scene_envs.progress.Progress`.
        backend: ``"processes"`` of this machine, or ``"ray"``.
        address: of a running Ray cluster; None starts one on this machine.

    Raises:
        InvalidInputError: a bad argument, ``output`` holds a dataset made with other settings, or workers cannot import
            the grammar.
        UnknownNameError: no grammar, or no backend, of that name.
        CorruptFileError: a shard found in ``output`` cannot be read.
        PhysicsError: worker processes keep dying, or nothing passes verification.
        StorageError: the disk is full, or the folder may not be written to.
        MissingDependencyError: Ray is asked for and not installed.
    """
    if count < 1 or shard_size < 1 or workers < 0 or seed < 0:
        raise InvalidInputError(
            f"generate needs count >= 1, shard_size >= 1, workers >= 0 and seed >= 0, "
            f"got count={count}, shard_size={shard_size}, workers={workers}, seed={seed}"
        )
    if backend not in BACKENDS:
        raise unknown_name("backend", backend, BACKENDS)
    start = perf_counter()
    grammar = get_grammar(scene_type)
    folder = Path(output)
    settings = {"grammar": scene_type, "seed": seed, "count": count, "shard_size": shard_size, "verified": verify}
    normalizer = _prepare(folder, grammar, settings)
    sizes = [min(shard_size, count - first) for first in range(0, count, shard_size)]
    jobs = [Job(index, size, seed, verify, str(folder / store.shard_name(index))) for index, size in enumerate(sizes)]
    left = [job for job in jobs if not _is_made(job)]
    with generation_progress(
        f"Generating {scene_type}", count - sum(job.size for job in left), count, progress
    ) as report:
        if left:
            _make(left, scene_type, grammar, normalizer, report, workers, backend, address)
    return _report(folder, jobs, count, perf_counter() - start)


def _make(
    jobs: list[Job],
    name: str,
    grammar: Grammar,
    normalizer: Normalizer,
    report: Report,
    workers: int,
    backend: str,
    address: str | None,
) -> None:
    work = Work.of(grammar_factory(name), get_scene_type(grammar.scene_type), normalizer)
    if backend == "ray":
        run_ray(jobs, work, workers, address, report)
    elif workers:
        run_processes(jobs, work, min(workers, len(jobs)), report)
    else:
        for job in jobs:
            write_shard_of(job, grammar, normalizer, report)


def _prepare(folder: Path, grammar: Grammar, settings: dict[str, Any]) -> Normalizer:
    """Make the folder and its metadata, or check that they fit ``settings``; returns the normalizer."""
    scene_type: SceneType = get_scene_type(grammar.scene_type)
    path = folder / store.METADATA
    try:
        store.remove_partial(folder)
        if path.exists():
            info = read_metadata(path)
            differing = [key for key in _SETTINGS if info.metadata.get(key) != settings[key]]
            if differing:
                was = {key: info.metadata.get(key) for key in differing}
                now = {key: settings[key] for key in differing}
                raise InvalidInputError(
                    f"{str(folder)!r} holds a dataset made with {was}, this call asks for {now}; "
                    "choose another output folder, or the same settings to resume"
                )
            return info.normalizer
        if folder.is_dir() and any(folder.glob("*.parquet")):
            raise InvalidInputError(
                f"{str(folder)!r} holds parquet files but no {store.METADATA}; choose an empty folder"
            )
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InvalidInputError(f"output {str(folder)!r} is a file, not a folder; give another") from None
    except OSError as error:
        raise storage_error(folder, error) from error
    normalizer = fixed_normalizer(grammar)
    write_json(path, with_digest(store.make_metadata(scene_type, normalizer, **settings)), indent=2)
    return normalizer


def _is_made(job: Job) -> bool:
    """Whether the shard is there; raises CorruptFileError when it is damaged or has another number of scenes."""
    path = Path(job.path)
    if not path.is_file():
        return False
    rows = store.read_notes(path)["rows"]
    if rows != job.size:
        raise CorruptFileError(f"{job.path!r} holds {rows} scenes, expected {job.size}; delete it and run again")
    store.verify(path)
    return True


def _report(folder: Path, jobs: list[Job], count: int, seconds: float) -> GenerationReport:
    reasons: Counter[str] = Counter()
    tried = 0
    for job in jobs:
        shard_journal(job).remove()
        notes = store.read_notes(Path(job.path))
        reasons.update(notes["reasons"])
        tried += notes["tried"]
    return GenerationReport(folder, count, tried, dict(reasons.most_common()), seconds)
