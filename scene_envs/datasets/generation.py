"""Generation of a dataset from a grammar: sharded, seeded, parallel, resumable.

A shard depends on its :class:`Job` and the grammar alone.
"""

from __future__ import annotations

import itertools
import math
import os
import pickle
import sys
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_envs.datasets.files import (
    METADATA,
    encode_shard,
    make_metadata,
    read_metadata,
    read_notes,
    read_rows,
    shard_name,
    write_bytes,
    write_metadata,
)
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import CorruptFileError, InvalidInputError, PhysicsError, unknown_name
from scene_envs.files import storage_error, sweep
from scene_envs.grammars import Grammar, get_grammar
from scene_envs.grammars.grammar import GRAMMARS
from scene_envs.normalizer import Normalizer
from scene_envs.physics.engines import engine_name
from scene_envs.progress import Progress
from scene_envs.scene import CATEGORY, SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type, register_scene_type
from scene_envs.workers import Task, WorkerFailure, WorkerPool, import_main, main_module, require_ray

BACKENDS = ("processes", "ray")
"""Backends that make shards."""
_SETTINGS = ("grammar", "seed", "count", "shard_size", "verified")
MAX_PENETRATION = 1e-3
"""Deepest overlap (m) of any pair of objects in a kept scene."""
MAX_DISPLACEMENT = 1e-2
"""Largest motion (m) of any object of a kept scene while it settles."""
DURATION = 0.5
"""Time (s) for which a scene settles."""
KEPT = ""
"""The verdict on a scene that is kept."""
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
_MAX_CHUNK = 32
"""Largest number of scenes judged at a time."""
_CHUNK_SECONDS = 0.5
"""Approximate time of a chunk, so that slow grammars report often; chunks do not change the result."""
_MAX_FRUITLESS = 2000
"""Number of scenes rejected in a row at which generation stops with an error."""
_UNFIT = "outside the normalizer"
_EVERY = 30.0
"""Seconds between lines where there is no terminal."""
Report = Callable[[int, int, dict[str, int]], None]
"""Called with (scenes kept, scenes tried, reasons) since the last call."""


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
    physics: str = "auto",
) -> GenerationReport:
    """Write ``count`` scenes with three prompts each into the folder ``output``.

    Each shard depends on (grammar, seed, shard index) alone, so the result depends neither on the number of workers nor
    on their machines. A run killed at any point gives the same files when it is started again: finished shards are
    kept, and unfinished ones are made again.

    Args:
        scene_type: Name of a grammar (built-in ones are called like their scene type).
        count: Number of scenes to write.
        output: Dataset folder; made when missing.
        seed: Seed of all random numbers, not negative.
        workers: Number of spawned processes; 0 runs in this one. With Ray: CPUs of the cluster that is started here.
        verify: Whether to keep only scenes that pass :func:`~scene_envs.datasets.generation.judge_scenes`.
        shard_size: Number of scenes per parquet file.
        progress: True for a live bar (a line every 30 s where there is no terminal), False for none, or a style of
            :class:`~scene_envs.progress.Progress`.
        backend: ``"processes"`` of this machine, or ``"ray"``.
        address: Address of a running Ray cluster; None starts one on this machine.
        physics: Engine that verifies, as for :func:`~scene_envs.physics.feasibility`.

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
    if verify:
        settings["physics"] = physics = engine_name(physics)
    normalizer = _prepare(folder, grammar, settings)
    sizes = [min(shard_size, count - first) for first in range(0, count, shard_size)]
    jobs = [Job(index, size, seed, verify, folder / shard_name(index), physics) for index, size in enumerate(sizes)]
    left = [job for job in jobs if not _is_made(job, len(normalizer.scale))]
    with generation_progress(
        f"Generating {scene_type}", count - sum(job.size for job in left), count, progress
    ) as report:
        if left:
            _make(left, scene_type, grammar, normalizer, report, workers, backend, address)
    reasons: Counter[str] = Counter()
    tried = 0
    for job in jobs:
        notes = read_notes(job.path)
        reasons.update(notes["reasons"])
        tried += notes["tried"]
    return GenerationReport(folder, count, tried, dict(reasons.most_common()), perf_counter() - start)


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

        def written(job: Job) -> Generator[tuple[int, int, dict[str, int]]]:
            write_bytes(job.path, (yield from make_shard(job, grammar, normalizer)))

        for progress in itertools.chain.from_iterable(map(written, jobs)):
            report(*progress)
        return
    is_ray = backend == "ray"
    factory, scene_type = GRAMMARS[name], get_scene_type(grammar.scene_type)
    made = factory, replace(scene_type), normalizer.state()  # a copy of the scene type, without built assets
    inputs = _pickled(factory, made, is_ray)

    def done(task: Task, shard: Any) -> None:
        if isinstance(shard, WorkerFailure):
            raise PhysicsError(
                f"{task.name} {shard}, twice; finished shards are kept. When memory ran out, run again to resume, with "
                "fewer workers"
            ) from shard
        write_bytes(task.body.path, shard)

    with WorkerPool(
        f"{__name__}:ShardMaker",
        (inputs, {} if is_ray else main_module()),
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
    """Answers of a worker of a generation: the bytes of whole shards. ``inputs`` are the pickled maker of the grammar,
    its scene type and the normalizer's state; ``main`` is the parent's main module, empty on another machine.
    """

    def __init__(self, inputs: bytes, main: dict[str, Any]) -> None:
        torch.set_num_threads(1)
        import_main(main)
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
        return make_shard(job, self._grammar, self._normalizer)


def _prepare(folder: Path, grammar: Grammar, settings: dict[str, Any]) -> Normalizer:
    """Make the folder and its metadata, or check that they fit ``settings``; returns the normalizer."""
    scene_type: SceneType = get_scene_type(grammar.scene_type)
    path = folder / METADATA
    try:
        sweep(folder)
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
    write_metadata(folder, make_metadata(scene_type, normalizer, **settings))
    return normalizer


def _is_made(job: Job, features: int) -> bool:
    """Whether the shard exists; raises CorruptFileError when it is damaged or has another number of scenes."""
    if not job.path.is_file():
        return False
    notes = read_notes(job.path)
    if notes["rows"] != job.size or "checksums" not in notes:
        held = f"holds {notes['rows']} scenes, expected {job.size} with checksums"
        raise CorruptFileError(f"{str(job.path)!r} {held}; delete it and run again")
    for _ in read_rows(job.path, features):  # compares the checksums
        pass
    return True


def fixed_normalizer(grammar: Grammar) -> Normalizer:
    """The normalizer of a grammar's scenes, a function of the grammar alone.

    x and y take the workspace's range, one-hots [0, 1], and z the range of a sample of unverified scenes, empty slots
    included. All nine rotation entries take [-1, 1] if any object of the sample is tilted; else the four that encode
    tilt are constant, and the four of the turn take [-1, 1] each if they vary. The sample of 128 scenes grows to 10,000
    objects (4,096 scenes at most) while nothing is tilted, so that a rare tilt is not missed.
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


def judge_scenes(batch: SceneBatch, physics: str = "auto") -> list[str]:
    """Reason why each scene is rejected: ``"outside workspace"``, ``"penetration"``, … or :data:`KEPT`.

    Runs in the calling process. Scenes are judged in the constructed poses; settling only tests them. The verdict on
    a scene does not depend on the others of the batch. ``physics`` names the engine.
    """
    from scene_envs.physics import feasibility

    batch = batch.to("cpu")
    inside = (batch.in_workspace | batch.is_empty).all(dim=1)
    verdicts = ["outside workspace"] * len(batch)
    candidates = torch.nonzero(inside).flatten()
    if not len(candidates):
        return verdicts
    chosen = batch[candidates]
    result = feasibility(
        chosen,
        max_penetration=MAX_PENETRATION,
        max_displacement=MAX_DISPLACEMENT,
        max_rotation=math.inf,
        duration=DURATION,
        physics=physics,
    )
    shallow = (result.depth <= MAX_PENETRATION).all(dim=1)
    still = ((result.displacement <= MAX_DISPLACEMENT) | ~chosen.is_free).all(dim=1)
    judged = (column.tolist() for column in (candidates, result.valid, shallow, still))
    for index, valid, clear, calm in zip(*judged, strict=True):
        verdicts[index] = (
            "physics failed" if not valid else "penetration" if not clear else KEPT if calm else "moved while settling"
        )
    return verdicts


@dataclass(frozen=True)
class Job:
    """Specification of one shard."""

    index: int  # index of the shard
    size: int  # number of scenes in the shard
    seed: int  # seed of the dataset
    verify: bool  # whether to keep only scenes that pass ``judge_scenes``
    path: Path  # path of the shard's file
    physics: str = "auto"  # engine that verifies


def make_shard(
    job: Job, grammar: Grammar, normalizer: Normalizer
) -> Generator[tuple[int, int, dict[str, int]], None, bytes]:
    """Yield the progress after each chunk, as arguments of a ``Report``; return the bytes of the shard's parquet file.

    Candidate k has a random generator of its own, seeded by (seed, shard, k), and the shard holds the first
    ``job.size`` candidates that pass; so chunks do not change the result. Raises PhysicsError when too many candidates
    in a row fail.
    """
    kept: list[Tensor] = []
    reasons: Counter[str] = Counter()
    tried = fruitless = 0
    chunk = 1
    while len(kept) < job.size:
        start = perf_counter()
        scenes, drawn = _draw(grammar, job, tried, chunk)
        verdicts = _judge(scenes, grammar, normalizer, job)
        before, fresh, first = reasons.copy(), len(kept), tried
        for scene, why, verdict in zip(scenes, drawn, verdicts, strict=True):
            if len(kept) == job.size:
                break
            tried += 1
            reasons.update(why)
            fruitless = 0 if verdict == KEPT else fruitless + 1
            if verdict == KEPT:
                kept.append(scene)
            else:
                reasons[verdict] += 1
        yield len(kept) - fresh, tried - first, dict(reasons - before)
        if fruitless >= _MAX_FRUITLESS:
            raise PhysicsError(
                f"grammar {grammar.name!r}: {fruitless} scenes in a row were rejected; "
                f"most frequent reasons: {dict(reasons.most_common(3))}"
            )
        seconds = (perf_counter() - start) / chunk
        chunk = max(1, min(_MAX_CHUNK, 2 * chunk, int(_CHUNK_SECONDS / max(seconds, 1e-6))))
    batch = SceneBatch(torch.stack(kept), grammar.scene_type)
    prompt_sets = describe_all(batch, np.random.default_rng([job.seed, job.index, 1]))
    notes = {"tried": tried, "reasons": dict(sorted((+reasons).items()))}
    return encode_shard(normalizer.normalize(batch.tensor).numpy(), prompt_sets, notes)


def _draw(grammar: Grammar, job: Job, first: int, count: int) -> tuple[Tensor, list[Counter[str]]]:
    """Candidates ``first`` … ``first + count - 1`` (count, N, D), and the grammar's reasons for rejected structures."""
    scenes, reasons = [], []
    for candidate in range(first, first + count):
        grammar.reasons.clear()
        rng = np.random.default_rng([job.seed, job.index, 0, candidate])
        scenes.append(torch.from_numpy(grammar.sample_array(rng, 1)))
        reasons.append(Counter(grammar.reasons))
    return torch.cat(scenes), reasons


def _judge(scenes: Tensor, grammar: Grammar, normalizer: Normalizer, job: Job) -> list[str]:
    batch = SceneBatch(scenes, grammar.scene_type)
    error = (normalizer.unnormalize(normalizer.normalize(scenes)) - scenes).abs().amax(dim=(1, 2))
    fits = error < 1e-4  # False where a feature varies that is constant in the normalizer
    verdicts = judge_scenes(batch, job.physics) if job.verify else [KEPT] * len(batch)
    return [v if v != KEPT or ok else _UNFIT for v, ok in zip(verdicts, fits.tolist(), strict=True)]


@contextmanager
def generation_progress(title: str, done: int, count: int, show: bool | str) -> Iterator[Report]:
    """A live bar with scenes/s and the most frequent reasons on stderr, or lines every 30 s where that is no terminal;
    yields the function that advances it. ``done`` of ``count`` scenes exist already; ``show`` is a style, True for a
    bar, False for none.
    """
    totals: Counter[str] = Counter()
    kept = 0
    style = show if isinstance(show, str) else ("bar" if show else "none")
    with Progress(title, count, done=done, style=style, every=_EVERY) as progress:

        def report(fresh: int, tried: int, reasons: dict[str, int]) -> None:
            nonlocal kept
            kept += fresh
            totals.update(reasons)
            rate = f"{kept / max(progress.seconds, 1e-9):.1f} scenes/s"
            dropped = ", ".join(f"{name} {number}" for name, number in totals.most_common(3))
            line = f"{title}: {done + kept}/{count}, {rate}"
            progress.update(done + kept, f"{rate} [dim]{dropped}", f"{line}, {dropped}" if dropped else line)

        yield report
        progress.update(count, f"{kept / max(progress.seconds, 1e-9):.1f} scenes/s")
