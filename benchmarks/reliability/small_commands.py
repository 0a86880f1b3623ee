"""Commands that take a second on an untrained prior, and the results by which two runs of one are compared."""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import io
import json
import tempfile
import time
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

_PRIORS = ("prior=PLACE/prior", "prior=PLACE/mixed")
_TRAINING = (
    "reward=object_count", "num_steps=3", "batch_size=4", "iterations=6", "slots=6", "regularisation.batch_size=2",
    "regularisation.bank_size=6", "guard.scenes=2", "guard.every=2", "logger.checkpoint_every=1",
    "logger.report_scenes=0", "progress=none", "workers=0",
)  # fmt: skip
_SEARCHING = ("objective=object_count", "objective_scale=30", "branching=3", "num_steps=3", "slots=6")


@dataclass(frozen=True)
class Command:
    """A command that goes on, or is repeated, after a kill.

    Attributes:
        words: the command and its keys; ``PLACE`` stands for a folder with small priors and scenes.
        results: files that must be those of an undisturbed run.
    """

    words: tuple[str, ...]
    results: tuple[str, ...]


_TRAINED = ("prior/model.safetensors", "log.csv")
_SEARCHED = ("best.safetensors", "metrics.json")
RESUMABLE = {
    "generate": Command(
        ("generate", "count=16", "shard_size=4", "workers=0", "verify=false", "progress=none"),
        ("scenes-00000.parquet", "scenes-00003.parquet", "metadata.json"),
    ),
    "pretrain": Command(
        ("pretrain", "data=PLACE/data", "iterations=8", "batch_size=4", "network.hidden=16", "network.depth=1",
         "network.heads=2", "logger.checkpoint_every=1", "logger.evaluate_every=3", "logger.log_every=1"),
        _TRAINED,
    ),
    "post-train": Command(("post-train", _PRIORS[0], *_TRAINING, "algorithm.gradient_steps=1"), _TRAINED),
    "post-train nft": Command(
        ("post-train", _PRIORS[1], *_TRAINING, "algorithm=nft", "guard.samples=2", "guard.action=rollback"), _TRAINED
    ),
    "post-train hold": Command(("post-train", _PRIORS[0], *_TRAINING, "regularisation.hold=1.05"), _TRAINED),
    "search": Command(("search", _PRIORS[1], *_SEARCHING, "budget=24"), _SEARCHED),
    "search count": Command(
        ("search", _PRIORS[1], *_SEARCHING, "budget=9", "planner=mcts", "count=4", "side_by_side=2"), _SEARCHED
    ),
    "search evolution": Command(("search", _PRIORS[1], *_SEARCHING, "budget=24", "planner=evolution"), _SEARCHED),
}  # fmt: skip
"""Commands that go on where they stopped."""
REPEATABLE = {
    "sample": Command(("sample", _PRIORS[1], "count=3", "num_steps=2", "workers=0", "project=true", "pictures=2"),
                      ("scenes.safetensors", "ready.safetensors")),
    "project": Command(("project", "scenes=PLACE/data", "count=6", "workers=0", "pictures=2"), ("ready.safetensors",)),
    "complete": Command(("complete", _PRIORS[1], "scenes=PLACE/data", "count=3", "num_steps=2"),
                        ("scenes.safetensors",)),
    "rearrange": Command(("rearrange", _PRIORS[1], "scenes=PLACE/data", "count=3", "num_steps=2"),
                         ("scenes.safetensors",)),
    "export": Command(("export", "scenes=PLACE/data", "count=2", "formats=[urdf,npz]", "workers=0"),
                      ("scene_001/scene.urdf",)),
    "render": Command(("render", "scenes=PLACE/data", "count=2", "modes=[depth,instance]"), ("annotations.json",)),
    "view": Command(("view", "scenes=PLACE/data", "count=2", "pictures=0"), ("viewer.html",)),
    "evaluate": Command(("evaluate", _PRIORS[1], "count=4", "measures=layout", "workers=0", "num_steps=2"),
                        ("metrics.json",)),
}  # fmt: skip
"""Commands that begin again in the folder that a kill left."""


_SHORTER = {"iterations": "3", "shard_size": "1", "budget": "6"}


def shorter(command: Command) -> Command:
    """The same command with less to do: four scenes, or three iterations, or six expansions."""
    kept = (word.partition("=")[::2] for word in command.words)
    least = _SHORTER | ({"count": "4"} if "shard_size=4" in command.words else {})
    words = tuple(f"{key}={least.get(key, value)}" if value else key for key, value in kept)
    return replace(command, words=words)


@cache
def place() -> str:
    """A folder with ``prior``, ``mixed`` and ``data``; removed with this process."""
    from agents.cli import main
    from agents.priors.testing import tiny_prior

    folder = tempfile.TemporaryDirectory(prefix="reliability-")
    atexit.register(folder.cleanup)
    tiny_prior().save(f"{folder.name}/prior")
    tiny_prior(process="mixed").save(f"{folder.name}/mixed")
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        main([*RESUMABLE["generate"].words, f"output={folder.name}/data"])
    return folder.name


def words_of(command: Command, output: Path | str) -> list[str]:
    """The words of a command that writes into ``output``."""
    return [*(word.replace("PLACE", place()) for word in command.words), f"output={output}"]


@dataclass(frozen=True)
class Undisturbed:
    """An undisturbed run of a command: its seconds, the bytes that it writes, digests of its results."""

    seconds: float
    size: int
    digests: dict[str, str] = field(default_factory=dict)


@cache
def undisturbed(command: Command, runs: int = 2) -> Undisturbed:
    """Runs the command in this process, twice so that copies of it find caches filled, and times the last run.

    Raises:
        RuntimeError: it fails, or gives two results.
    """
    from agents.cli import main

    found = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            words, err = words_of(command, folder + "/run"), io.StringIO()
            started = time.monotonic()
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
                status = main(words)
            seconds = time.monotonic() - started
            if status:
                raise RuntimeError(f"{' '.join(words)} fails: {err.getvalue()}")
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
            found.append(Undisturbed(seconds, size, digests(Path(folder) / "run", command)))
    if found[0].digests != found[-1].digests:
        raise RuntimeError(f"{' '.join(words)} gives another result each time")
    return found[-1]


def digests(folder: Path, command: Command) -> dict[str, str]:
    """Digests of the results, of logs and metrics without their times and paths."""
    found = {}
    for name in command.results:
        path = folder / name
        content = path.read_bytes() if path.exists() else b"none"
        if name.endswith(".csv"):
            rows = [line.split(",") for line in content.decode().splitlines()]
            keep = [index for index, column in enumerate(rows[0]) if "seconds" not in column] if rows else []
            content = repr([[row[index] for index in keep] for row in rows]).encode()
        elif name.endswith(".json") and path.exists():
            content = repr(_timeless(json.loads(content))).encode()
        found[name] = hashlib.sha256(content).hexdigest()
    return found


def _timeless(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _timeless(item) for key, item in value.items() if "second" not in key and "time" not in key}
    if isinstance(value, list):
        return [_timeless(item) for item in value]
    return "a path" if isinstance(value, str) and "/" in value else value
