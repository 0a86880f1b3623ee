"""Generation of a dataset from a grammar: sharded, seeded, parallel, resumable."""

from __future__ import annotations

import os
import pickle
import sys
from collections import Counter
from dataclasses import dataclass, fields
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.datasets.files import (
    METADATA,
    make_metadata,
    read_metadata,
    read_notes,
    remove_partial,
    shard_name,
    verify,
    write_bytes,
)
from scene_envs.datasets.shards import Job, Report, generation_progress, make_shard, shard_journal, write_shard
from scene_envs.errors import CorruptFileError, InvalidInputError, PhysicsError, unknown_name
from scene_envs.files import storage_error, with_digest, write_json
from scene_envs.grammars import Grammar, get_grammar
from scene_envs.grammars.grammar import grammar_factory
from scene_envs.normalizer import Normalizer
from scene_envs.scene import CATEGORY
from scene_envs.scene_types import SceneType, get_scene_type, register_scene_type
from scene_envs.workers import Task, WorkerFailure, WorkerPool, import_main, main_module, require_ray

_OBJECTS = 10_000
"""Smallest number of objects in a sample without tilted objects, unless it takes more than ``_SCENES`` scenes."""
_SCENES = 4096
_STEP = 128
"""Scenes drawn at a time, until one holds a tilted object."""
_SEED = 20_250_101
_UPRIGHT = 1e-6
"""A rotation entry that encodes tilt counts as zero below this."""
_TILT = [5, 8, 9, 10]
"""Features of a rotation that are zero when the object only turns about z: xz, yz, zx, zy."""
_PLANE = [3, 4, 6, 7]
"""Features of a rotation about z: xx, xy, yx, yy."""


def fixed_normalizer(grammar: Grammar) -> Normalizer:
    """The normalizer of a grammar's scenes, a function of the grammar alone.

    x and y take the workspace's range, one-hots [0, 1], and z the range of a sample of unverified scenes, empty slots
    included. If any object of the sample is tilted, all nine rotation entries take [-1, 1]. If objects only turn about
    z, the four entries that encode tilt are constant (they come back exactly), and the four of the turn take [-1, 1]
    each if they vary. The sample has 128 scenes. As long as nothing in it is tilted it grows to 10,000 objects (4,096
    scenes at most), so that a rare tilt is not missed.
    """
    low, high, tilted = _ranges(grammar)
    grammar.reasons.clear()
    for axis in (0, 1):
        low[axis], high[axis] = (corner[axis] for corner in grammar.scene_type.workspace)
    if not tilted:
        low[_TILT] = high[_TILT] = 0.0
    for feature in range(3, 12) if tilted else _PLANE:
        if tilted or high[feature] - low[feature] > _UPRIGHT:
            low[feature], high[feature] = -1.0, 1.0
    low[CATEGORY], high[CATEGORY] = 0.0, 1.0
    return Normalizer.from_range(low, high)


def _ranges(grammar: Grammar) -> tuple[Tensor, Tensor, bool]:
    """Smallest and largest value (D,) of each feature in a sample, and whether any object of it is tilted."""
    rng = np.random.default_rng(_SEED)
    features = grammar.scene_type.features
    low, high = torch.full((features,), torch.inf), torch.full((features,), -torch.inf)
    objects = scenes = 0
    tilted = False
    while scenes == 0 or (not tilted and objects < _OBJECTS and scenes < _SCENES):
        flat = torch.from_numpy(grammar.sample_array(rng, _STEP)).flatten(0, 1)
        present = flat[flat[:, -1] < 0.5]
        low, high = torch.minimum(low, flat.amin(dim=0)), torch.maximum(high, flat.amax(dim=0))
        tilted |= bool((present[:, _TILT].abs() > _UPRIGHT).any() or (present[:, 11] < 1 - _UPRIGHT).any())
        objects, scenes = objects + len(present), scenes + _STEP
    return low, high, tilted


BACKENDS = ("processes", "ray")
"""Backends that make shards."""
_SETTINGS = ("grammar", "seed", "count", "shard_size", "verified")


@dataclass(frozen=True)
class GenerationReport:
    """Result of a generation.

    Attributes:
        output: Dataset folder.
        scenes: Number of scenes in the folder.
        tried: Number of scenes that the grammar built, those rejected by physics included.
        reasons: Numbers of rejected structures and scenes by reason, most frequent first.
        seconds: Wall time of this call, without that of an earlier, interrupted run.
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

    Each shard depends on (grammar, seed, shard index) alone, so the result depends neither on the number of workers nor
    on their machines. A run killed at any point gives the same files when it is started again. Finished shards are
    kept, and the verdicts of an unfinished shard are reused (with Ray an unfinished shard is made again).

    Args:
        scene_type: Name of a grammar (built-in ones are called like their scene type).
        count: Number of scenes to write.
        output: Dataset folder; made when missing.
        seed: Seed of all random numbers, not negative.
        workers: Number of spawned processes; 0 runs in this one. With Ray: CPUs of the cluster that is started here.
        verify: Whether to keep only scenes that pass :func:`~scene_envs.datasets.shards.judge_scenes`.
        shard_size: Number of scenes per parquet file.
        progress: True for a live bar (a line every 30 s where there is no terminal), False for none, or a style of
            :class:`~scene_envs.progress.Progress`.
        backend: ``"processes"`` of this machine, or ``"ray"``.
        address: Address of a running Ray cluster; None starts one on this machine.

    Raises:
        InvalidInputError: a bad argument, ``output`` holds a dataset made with other settings, or workers cannot import
            the grammar.
        UnknownNameError: no grammar, or no backend, of that name.
        CorruptFileError: a shard found in ``output`` cannot be read.
        PhysicsError: a shard failed twice, or nothing passes verification.
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
    jobs = [Job(index, size, seed, verify, str(folder / shard_name(index))) for index, size in enumerate(sizes)]
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
    if backend == "processes" and not workers:
        for job in jobs:
            for progress in write_shard(job, grammar, normalizer):
                report(*progress)
        return
    is_ray = backend == "ray"
    factory, scene_type = grammar_factory(name), get_scene_type(grammar.scene_type)
    plain = SceneType(
        **{field.name: getattr(scene_type, field.name) for field in fields(scene_type)}
    )  # no built assets
    inputs = _pickled(factory, (factory, plain, normalizer.state()), is_ray)

    def done(task: Task, shard: Any) -> None:
        if isinstance(shard, WorkerFailure):
            raise PhysicsError(
                f"{task.name} {shard}, twice; finished shards are kept. When memory ran out, run again to resume, with "
                "fewer workers"
            ) from shard
        if shard is not None:
            write_bytes(Path(task.body.path), shard)

    with WorkerPool(
        f"{__name__}:ShardMaker",
        (inputs, None if is_ray else main_module()),
        workers=max(1, workers) if is_ray else min(workers, len(jobs)),
        stdout=2,  # what a grammar prints goes to stderr
        ray=is_ray,
        address=address,
    ) as pool:
        pool.map([Task(job, f"shard {job.index}") for job in jobs], done=done, report=report)


def _pickled(factory: Any, inputs: tuple[Any, ...], is_ray: bool) -> bytes:
    """The inputs of workers; Ray gets functions that workers cannot import as well."""
    if is_ray:
        return require_ray().cloudpickle.dumps(inputs)  # type: ignore[no-any-return]
    main = sys.modules["__main__"]
    if factory.__module__ == "__main__" and not Path(getattr(main, "__file__", None) or "").is_file():
        raise InvalidInputError(
            "the grammar's function stands in a notebook or at a prompt, where worker processes cannot import it; "
            "define it in a module, or use workers=0"
        )
    try:
        return pickle.dumps(inputs)
    except (pickle.PicklingError, AttributeError) as error:
        raise InvalidInputError(
            f"the grammar's function cannot be sent to worker processes ({error}); "
            "define it at the top level of a module, or use workers=0"
        ) from error


class ShardMaker:
    """Answers of a worker of a generation: whole shards.

    Args:
        inputs: maker of the grammar, its scene type, and state of the normalizer, pickled.
        main: main module of the parent on the same machine, for which shards are written; None returns their bytes.
    """

    def __init__(self, inputs: bytes, main: dict[str, Any] | None) -> None:
        self._make = make_shard if main is None else write_shard
        torch.set_num_threads(1)
        import_main(main or {})
        try:
            factory, scene_type, state = pickle.loads(inputs)
            register_scene_type(scene_type)
            self._grammar, self._normalizer = factory(), Normalizer.from_state(state)
        except (ImportError, AttributeError) as error:
            raise InvalidInputError(
                f"workers cannot import what the grammar needs ({error}); install it on every machine, or use workers=0"
            ) from error

    def __call__(self, job: Job) -> Any:
        """Make a shard, with reports of the progress."""
        return self._make(job, self._grammar, self._normalizer)


def _prepare(folder: Path, grammar: Grammar, settings: dict[str, Any]) -> Normalizer:
    """Make the folder and its metadata, or check that they fit ``settings``; returns the normalizer."""
    scene_type: SceneType = get_scene_type(grammar.scene_type)
    path = folder / METADATA
    try:
        remove_partial(folder)
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
            raise InvalidInputError(f"{str(folder)!r} holds parquet files but no {METADATA}; choose an empty folder")
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InvalidInputError(f"output {str(folder)!r} is a file, not a folder; give another") from None
    except OSError as error:
        raise storage_error(folder, error) from error
    normalizer = fixed_normalizer(grammar)
    write_json(path, with_digest(make_metadata(scene_type, normalizer, **settings)), indent=2)
    return normalizer


def _is_made(job: Job) -> bool:
    """Whether the shard exists; raises CorruptFileError when it is damaged or has another number of scenes."""
    path = Path(job.path)
    if not path.is_file():
        return False
    rows = read_notes(path)["rows"]
    if rows != job.size:
        raise CorruptFileError(f"{job.path!r} holds {rows} scenes, expected {job.size}; delete it and run again")
    verify(path)
    return True


def _report(folder: Path, jobs: list[Job], count: int, seconds: float) -> GenerationReport:
    reasons: Counter[str] = Counter()
    tried = 0
    for job in jobs:
        shard_journal(job).remove()
        notes = read_notes(Path(job.path))
        reasons.update(notes["reasons"])
        tried += notes["tried"]
    return GenerationReport(folder, count, tried, dict(reasons.most_common()), seconds)
