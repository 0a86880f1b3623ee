"""Maker of one shard of a generated dataset, which depends on its job and grammar alone."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from scene_envs.datasets.files import encode_shard, write_bytes
from scene_envs.datasets.prompts import describe_all
from scene_envs.errors import PhysicsError
from scene_envs.files import storage_error
from scene_envs.grammars import Grammar
from scene_envs.normalizer import Normalizer
from scene_envs.progress import Progress
from scene_envs.scene import SceneBatch


class Journal:
    """An append-only text file with the number of a candidate and its verdict per line.

    A process may be killed while it writes, so an incomplete last line is dropped. Two processes that make the same
    shard may write by turns, because a worker may outlive its killed parent for a moment; a verdict that is written
    twice counts once. The first :meth:`append` makes the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read(self) -> list[str]:
        """The verdicts on candidates 0, 1, … so far; an incomplete last line is cut off the file.

        Raises:
            StorageError: the file cannot be read or written.
        """
        try:
            content = self.path.read_bytes()
            whole = content[: content.rfind(b"\n") + 1]
            if len(whole) < len(content):
                self.path.write_bytes(whole)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise storage_error(self.path, error) from error
        verdicts: list[str] = []
        for line in whole.decode(errors="replace").split("\n")[:-1]:
            candidate, _, verdict = line.partition(" ")
            if candidate == str(len(verdicts)):
                verdicts.append(verdict)
        return verdicts

    def append(self, first: int, verdicts: Sequence[str]) -> None:
        """Add the verdicts on candidates ``first``, ``first + 1``, …

        Raises:
            StorageError: the file cannot be written.
        """
        lines = "".join(f"{candidate} {verdict}\n" for candidate, verdict in enumerate(verdicts, start=first))
        try:
            with self.path.open("ab") as file:
                file.write(lines.encode())
        except OSError as error:
            raise storage_error(self.path, error) from error

    def remove(self) -> None:
        """Delete the file, when the shard is written."""
        self.path.unlink(missing_ok=True)


MAX_PENETRATION = 1e-3
"""Deepest overlap (m) of any pair of objects in a kept scene."""
MAX_DISPLACEMENT = 1e-2
"""Largest motion (m) of any object of a kept scene while it settles."""
DURATION = 0.5
"""Time (s) for which a scene settles."""
KEPT = ""
"""The verdict on a scene that is kept."""


def judge_scenes(batch: SceneBatch) -> list[str]:
    """Reason why each scene is rejected: ``"outside workspace"``, ``"penetration"``, … or :data:`KEPT`.

    Runs in the calling process. Scenes are judged in the constructed poses; settling only tests them. The verdict on
    a scene does not depend on the others of the batch.
    """
    inside = (batch.in_workspace | batch.is_empty).all(dim=1)
    verdicts = [KEPT if ok else "outside workspace" for ok in inside.tolist()]
    candidates = torch.nonzero(inside).flatten()
    if len(candidates):
        for index, verdict in zip(candidates.tolist(), _physics(batch[candidates]), strict=True):
            verdicts[index] = verdict
    return verdicts


def _physics(batch: SceneBatch) -> list[str]:
    from scene_envs.physics import feasibility

    result = feasibility(
        batch,
        max_penetration=MAX_PENETRATION,
        max_displacement=MAX_DISPLACEMENT,
        max_rotation=math.inf,
        duration=DURATION,
    )
    shallow = (result.depth <= MAX_PENETRATION).all(dim=1)
    still = ((result.displacement <= MAX_DISPLACEMENT) | ~batch.is_free).all(dim=1)
    return [
        "physics failed" if not valid else "penetration" if not clear else "moved while settling" if not calm else KEPT
        for valid, clear, calm in zip(result.valid.tolist(), shallow.tolist(), still.tolist(), strict=True)
    ]


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


Report = Callable[[int, int, dict[str, int]], None]
"""Called with (scenes kept, scenes tried, reasons) since the last call."""

_EVERY = 30.0
"""Seconds between lines where there is no terminal."""


@contextmanager
def generation_progress(title: str, done: int, count: int, show: bool | str) -> Iterator[Report]:
    """A live bar with scenes/s and the most frequent reasons; yields the function that advances it.

    On a terminal the bar is on stderr; elsewhere (a log file) a line is printed every 30 s.

    Args:
        title: Title of the bar.
        done: Number of scenes that exist already.
        count: Number of requested scenes.
        show: Style of the display; True for a bar, False for none.
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
