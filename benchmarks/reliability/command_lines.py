"""Trials of command lines with values that no key expects."""

from __future__ import annotations

import contextlib
import io
import random
import shutil
import tempfile
from collections.abc import Iterator, Sequence

from benchmarks.reliability.figures import Figures

NASTY = (
    "", "0", "-1", "1e999", "nan", "-inf", "null", "true", "9" * 30, "9" * 5000, "a", "a" * 300, "../" * 40, "/",
    "/proc", "[]", "[[[[[[[[1]]]]]]]]", "{}", "{name: }", "{a: {b: {c: 1}}}", "[1,2", "${oc.env:HOME}", "${x}",
    "'", '"', "\\", "a=b", "1,2,3", "é\u202e😀", "\x00", "\n", "*", "~", "!!python/object:os.system", "1_000", "0x10",
    "1e3", ".5", "None",
)  # fmt: skip
"""Values that no key expects, or that some treat in their own way."""


def fuzzed_lines(count: int, seed: int = 0) -> Figures:
    """Command lines with values that no key expects: each is done, or refused in the project's own words."""
    from importlib import import_module

    from agents.cli.commands import COMMANDS
    from agents.cli.keys import describe_fields, keys_of

    rng, figures = random.Random(seed), Figures()
    names = [name for name in COMMANDS if name not in ("demo", "pretrain", "evaluate", "generate")]
    keys = {
        name: [key.name for key in describe_fields(keys_of(import_module(_module(name)))) if key.name != "output"]
        for name in COMMANDS
    }
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            name = rng.choice(list(COMMANDS) if number % 2 else names)
            base = [] if number % 2 else list(_small(keys[name]))
            chosen = rng.sample(keys[name], min(len(keys[name]), rng.choice((1, 1, 2)))) or ["seed"]
            line = [name, *base, *(f"{key}={rng.choice(NASTY)}" for key in chosen)]
            line += ["--cfg", "job"] if number % 2 else [f"output={place}/{number}"]
            _judge_line(line, figures)
            shutil.rmtree(f"{place}/{number}", ignore_errors=True)
    return figures


def _small(keys: Sequence[str]) -> Iterator[str]:
    """Words that make a command quick."""
    words = {
        "count": "1", "num_steps": "1", "workers": "0", "pictures": "0", "slots": "6", "budget": "2", "branching": "2",
        "iterations": "1", "batch_size": "2", "algorithm.gradient_steps": "1", "regularisation.bank_size": "6",
        "regularisation.batch_size": "2", "guard.scenes": "2", "logger.report_scenes": "0", "logger.progress": "none",
        "reward": "object_count", "objective": "object_count",
    }  # fmt: skip
    yield from (f"{key}={value}" for key, value in words.items() if key in keys)


def _module(name: str) -> str:
    return f"agents.cli.commands.{name.replace('-', '_')}"


def _judge_line(line: list[str], figures: Figures) -> None:
    figures.tried += 1
    shown = " ".join(word if len(word) < 60 else word[:60] + "..." for word in line)
    try:
        status, err = run_here(line)
    except BaseException as error:  # nothing may come through
        figures.silent += 1
        figures.note(f"{shown}: {type(error).__name__}: {error}")
        return
    if "something unexpected" in err or "Traceback" in err or (status and not err.strip()) or len(err) > 20_000:
        figures.silent += 1
        figures.note(f"{shown}: {err[-400:]}")


def run_here(words: Sequence[str]) -> tuple[int, str]:
    """Exit status and messages of a command in this process."""
    from agents.cli import main

    err = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        status = main(list(words))
    return status, err.getvalue()
