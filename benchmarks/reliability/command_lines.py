"""Trials of command lines that no command expects."""

from __future__ import annotations

import contextlib
import io
import os
import random
import re
import shutil
import signal
import tempfile
from collections.abc import Sequence
from functools import cache

from benchmarks.reliability.copies import Started, complete
from benchmarks.reliability.figures import Figures
from benchmarks.reliability.small_commands import REPEATABLE, RESUMABLE, place, shorter, undisturbed

NASTY = (
    "", "0", "-1", "1e999", "nan", "-inf", "null", "true", "9" * 30, "9" * 5000, "a", "a" * 300, "../" * 40, "/",
    "/proc", "[]", "[[[[[[[[1]]]]]]]]", "{}", "{name: }", "{a: {b: {c: 1}}}", "[1,2", "${oc.env:HOME}", "${x}",
    "'", '"', "\\", "a=b", "1,2,3", "é\u202e😀", "\x01", "\n", "*", "~", "!!python/object:os.system", "1_000", "0x10",
    "1e3", ".5", "None", "[null]", "{name: nft}", "{_target_: os.system}", "./mine.py:x", "PLACE", "PLACE/data",
    "PLACE/prior/config.json", "PLACE/data/scenes-00000.parquet", "/dev/null", "cuda:99", "dimsum_table", "[" * 500,
    "object_count", "2", "\ud800", "{" * 60 + "}" * 60, "1:2", "0.5*object_count", "a\tb", "%s", "[a,,b]",
)  # fmt: skip
"""Values that no key expects, or that some treat in their own way."""
_SMALL = {
    "count": "1", "num_steps": "3", "workers": "0", "pictures": "0", "slots": "6", "budget": "2", "branching": "2",
    "iterations": "1", "batch_size": "2", "algorithm.gradient_steps": "1", "regularisation.bank_size": "6",
    "regularisation.batch_size": "2", "guard.scenes": "2", "logger.report_scenes": "0", "progress": "none",
    "reward": "object_count", "objective": "object_count", "prior": "PLACE/mixed", "scenes": "PLACE/data",
    "data": "PLACE/data", "measures": "layout", "network.hidden": "16", "network.depth": "1", "network.heads": "2",
    "formats": "npz", "shard_size": "1", "verify": "false",
}  # fmt: skip
"""Values that make a command quick."""
_SLOW = ("demo", "package-prior")
"""Commands that run in full whatever their keys are; their lines are read and not run."""
_IMPORTING = ("post-train", "search", "sample", "export", "view", "evaluate")
"""Commands that spend more time on imports than on work."""
_RUN_SECONDS, _END_SECONDS = 6.0, 30.0


def fuzzed_lines(count: int, seed: int = 0, ran: float = 0.25) -> Figures:
    """Lines with values, keys and words that no command expects; each must be done, or refused in the project's words.

    Args:
        count: lines.
        seed: of the lines.
        ran: share that is run, in a copy of this process; the others are read, as with ``--cfg job``. A line that is
            no mistake and works for long is ended by SIGTERM, and must say so.
    """
    rng, figures = random.Random(seed), Figures()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(count):
            run = rng.random() < ran
            line = _line(rng, f"{folder}/{number}", run)
            figures.tried += 1
            if run:
                if line[0] in _IMPORTING:  # imports here what the copy then need not import
                    undisturbed(shorter((RESUMABLE | REPEATABLE)[line[0]]), runs=1)
                status, err = _run_in_copy(line)
            else:
                status, err = _read_here(line)
            _judge(line, status, err, figures)
            shutil.rmtree(f"{folder}/{number}", ignore_errors=True)
    return figures


def two_ways(count: int, seed: int = 0) -> Figures:
    """Lines that run in a copy of this process and in an interpreter of their own; both must say the same."""
    rng, figures = random.Random(seed), Figures()
    with tempfile.TemporaryDirectory() as folder:
        while figures.tried < count:
            line = _line(rng, f"{folder}/run", True)
            if not _can_be_arguments(line):
                continue
            found = []
            for fresh in (False, True):
                done = complete(line, fresh, 60.0)
                found.append((done.status, _plain(done.told)))
                shutil.rmtree(f"{folder}/run", ignore_errors=True)
            figures.tried += 1
            if found[0] != found[1]:
                figures.different += 1
                figures.note(f"{_shown(line)}: {found}")
    return figures


def _can_be_arguments(line: list[str]) -> bool:
    """Whether a process can be started with these words: half a surrogate pair has no bytes."""
    try:
        return all(isinstance(os.fsencode(word), bytes) for word in line)
    except UnicodeEncodeError:
        return False


@cache
def _keys(name: str) -> tuple[str, ...]:
    from agents.cli.commands import load_command
    from agents.cli.keys import describe_fields, keys_of

    module = load_command(name)
    return tuple(key.name for key in describe_fields(keys_of(module)) if key.name != "output")


def _line(rng: random.Random, output: str, run: bool) -> list[str]:
    from agents.cli.commands import COMMANDS

    name = rng.choice([name for name in COMMANDS if not run or name not in _SLOW])
    keys = _keys(name)
    chosen = rng.sample(keys, min(len(keys), rng.choice((1, 1, 2)))) or ["seed"]
    odd = [f"{key}={rng.choice(NASTY)}" for key in chosen]
    base = [f"{key}={value}" for key, value in _SMALL.items() if key in keys and key not in chosen]
    line = [*base, *odd]
    if keys and "output" in _all_keys(name):
        line.append(f"output={output}")
    if rng.random() < 0.25:
        _spoil(line, rng)
    line = [word.replace("PLACE", place()) for word in line]
    return [name if rng.random() > 0.02 else _twisted(name, rng), *line, *([] if run else ["--cfg", "job"])]


@cache
def _all_keys(name: str) -> tuple[str, ...]:
    from agents.cli.commands import load_command
    from agents.cli.keys import describe_fields, keys_of

    module = load_command(name)
    return tuple(key.name for key in describe_fields(keys_of(module)))


def _spoil(line: list[str], rng: random.Random) -> None:
    """Twist, double or drop a word, or add one that is no key and value; output, iterations and count stay."""
    places = [place for place, word in enumerate(line) if not word.startswith(("output=", "iterations=", "count="))]
    kind = rng.choice(("twist", "twist", "add", "double", "drop"))
    if kind == "add" or not places:
        line.insert(0, rng.choice((
            "=", "==", "a", "=1", "x.y=1", "++seed=1", "~seed", "+new=1", "hydra.run.dir=/tmp", "--help=",
            "--config-dir", "--config=/dev/null", "--nothing", "-x", "+experiment=none", "seed", "seed=", "adapter=",
            "adapter=/", "\udcff=1", "scene@x=1", "/seed=1", "seed=1,2", "--config-dir=/proc", "recipe=none", "é=1",
            "a" * 5000, ".=1", "..=2",
        )))  # fmt: skip
    elif kind == "twist":
        spot = rng.choice(places)
        line[spot] = _twisted(line[spot], rng)
    elif kind == "double":
        line.insert(0, line[rng.choice(places)])
    else:
        del line[rng.choice(places)]


def _twisted(word: str, rng: random.Random) -> str:
    spot = rng.randrange(len(word) + 1)
    return rng.choice(
        (word[:spot], word[:spot] + chr(rng.randrange(1, 0x250)) + word[spot:], word[spot:] + word[:spot])
    )


def _run_in_copy(line: Sequence[str]) -> tuple[int | None, str]:
    started = Started(line)
    status = started.wait(_RUN_SECONDS)
    if status is None:
        started.send(signal.SIGTERM)
        status = started.wait(_END_SECONDS)
        if status is None:
            started.end()
    return status, started.told


def _read_here(line: Sequence[str]) -> tuple[int | None, str]:
    from agents.cli import main

    err = io.StringIO()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
            return main(list(line)), err.getvalue()
    except BaseException as error:  # no exception may come through
        return None, f"{type(error).__name__}: {error}"


def _judge(line: Sequence[str], status: int | None, err: str, figures: Figures) -> None:
    unclear = "something unexpected" in err or "Traceback" in err or len(err) > 20_000
    if status not in (0, 1, 2, 143) or unclear or (status and not err.strip()):
        figures.silent += 1
        figures.note(f"{_shown(line)}: status {status}: {err[-400:]}")


def _shown(line: Sequence[str]) -> str:
    return ascii(" ".join(word if len(word) < 60 else word[:60] + "..." for word in line))


def _plain(err: str) -> str:
    """Messages without numbers of processes, times and progress."""
    told = [line for line in err.splitlines() if line.startswith("scene-envs: ")]
    return re.sub(r"\d+", "0", "\n".join(told))
