"""Maker of one shard of a generated dataset, which depends on its job and grammar alone."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from scene_envs.datasets.store import encode_shard, write_bytes
from scene_envs.datasets.journal import Journal
from scene_envs.datasets.prompts import describe_all
from scene_envs.datasets.verification import KEPT, judge_scenes
from scene_envs.errors import PhysicsError
from scene_envs.grammars import Grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch

_MAX_CHUNK = 32
"""Largest number of scenes judged at a time."""
_CHUNK_SECONDS = 0.5
"""Approximate time of a chunk, so that slow grammars report often; chunks do not change the result."""
_MAX_FRUITLESS = 2000
"""Number of scenes rejected in a row at which generation stops with an error."""
_UNFIT = "outside the normalizer"


@dataclass(frozen=True)
class Job:
    """Specification of one shard."""

    index: int  # index of the shard
    size: int  # number of scenes in the shard
    seed: int  # seed of the dataset
    verify: bool  # whether to keep only scenes that pass ``judge_scenes``
    path: str  # path of the shard's file


def make_shard(
    job: Job, grammar: Grammar, normalizer: Normalizer, journal: Journal | None = None
) -> Generator[tuple[int, int, dict[str, int]], None, bytes]:
    """Yield the progress after each chunk, as arguments of a ``Report``; return the bytes of the shard's parquet file.

    Candidate k is drawn from a random generator of its own, seeded by (seed, shard, k), and the shard holds the first
    ``job.size`` candidates that pass. So neither the size of chunks nor an interruption changes the result.

    Args:
        job: Specification of the shard.
        grammar: Grammar that draws the candidates.
        normalizer: Normalizer of the dataset.
        journal: Verdicts of an earlier, interrupted attempt, which are not computed again; None keeps none.

    Raises:
        PhysicsError: too many candidates in a row fail.
        StorageError: the journal cannot be written.
    """
    known = journal.read() if journal is not None else []
    kept: list[Tensor] = []
    reasons: Counter[str] = Counter()
    tried = fruitless = 0
    chunk = 1
    while len(kept) < job.size:
        ahead = len(known) - tried
        start = perf_counter()
        count = min(ahead, _MAX_CHUNK) if ahead > 0 else chunk
        scenes, drawn = _draw(grammar, job, tried, count)
        digests = [hashlib.blake2b(scene.numpy().tobytes(), digest_size=6).hexdigest() for scene in scenes]
        if ahead > 0:
            entries = [line.partition(" ") for line in known[tried : tried + count]]
            if [digest for digest, _, _ in entries] != digests:  # the grammar has changed since
                known, ahead = [], 0
        if ahead > 0:
            verdicts = [verdict for _, _, verdict in entries]
        else:
            verdicts = _judge(scenes, grammar, normalizer, job.verify)
            if journal is not None:
                journal.append(
                    tried, [f"{digest} {verdict}" for digest, verdict in zip(digests, verdicts, strict=True)]
                )
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
        if ahead <= 0:
            seconds = (perf_counter() - start) / count
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


def _judge(scenes: Tensor, grammar: Grammar, normalizer: Normalizer, verify: bool) -> list[str]:
    batch = SceneBatch(scenes, grammar.scene_type)
    error = (normalizer.unnormalize(normalizer.normalize(scenes)) - scenes).abs().amax(dim=(1, 2))
    fits = error < 1e-4  # False where a feature varies that is constant in the normalizer
    verdicts = judge_scenes(batch) if verify else [KEPT] * len(batch)
    return [v if v != KEPT or ok else _UNFIT for v, ok in zip(verdicts, fits.tolist(), strict=True)]


def write_shard(job: Job, grammar: Grammar, normalizer: Normalizer) -> Generator[tuple[int, int, dict[str, int]]]:
    """Make one shard with a journal, and write it; yields as :func:`make_shard`, raises StorageError."""
    journal = shard_journal(job)
    write_bytes(Path(job.path), (yield from make_shard(job, grammar, normalizer, journal)))
    journal.remove()


def shard_journal(job: Job) -> Journal:
    """The journal of a shard, in the folder of its file."""
    path = Path(job.path)
    return Journal(path.with_name(f".{path.name}.journal"))
