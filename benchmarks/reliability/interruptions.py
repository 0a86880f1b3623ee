"""Trials that disturb a running command: kills, full disks, a second writer."""

from __future__ import annotations

import random
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from benchmarks.reliability.copies import Started, complete
from benchmarks.reliability.figures import Figures
from benchmarks.reliability.small_commands import (
    REPEATABLE,
    RESUMABLE,
    Command,
    Undisturbed,
    digests,
    undisturbed,
    words_of,
)

ALL = RESUMABLE | REPEATABLE
_LATE = 60.0
"""Seconds after which a command counts as hanging; undisturbed commands take about one second."""


def kills(
    count: int, seed: int = 0, number: signal.Signals = signal.SIGKILL, fresh: bool = False,
    commands: Mapping[str, Command] = RESUMABLE,
) -> Figures:  # fmt: skip
    """Commands that are signalled at random moments until they end; results are compared with an undisturbed run's.

    Args:
        count: signals that met a running command.
        seed: of the moments, and of the command to begin with.
        number: the signal.
        fresh: whether every command starts in an interpreter of its own, instead of in a copy of this process.
        commands: by name.
    """
    figures, rng, names = Figures(), random.Random(f"{seed} {number}"), list(commands)
    trial = seed
    with tempfile.TemporaryDirectory() as place:
        while figures.tried < count:
            name = names[trial % len(names)]
            trial += 1
            until = min(count, figures.tried + 4)
            _kill_until_done(name, commands[name], Path(place) / str(trial), number, rng, fresh, figures, until)
    return figures


def _kill_until_done(
    name: str, command: Command, folder: Path, number: signal.Signals, rng: random.Random, fresh: bool,
    figures: Figures, until: int,
) -> None:  # fmt: skip
    expected, words = undisturbed(command), words_of(command, folder)
    while figures.tried < until:
        started = Started(words, fresh)
        seconds = expected.seconds + 5.0 * fresh
        if started.wait(rng.uniform(0.0, 1.1) * seconds) is not None:
            break
        started.send(number)
        status = started.wait(_LATE)
        figures.tried += 1
        _judge_end(name, started, number, status, figures)
    if (started := complete(words, fresh, 4 * _LATE)).status != 0:
        figures.lost += 1
        figures.note(f"{name} did not go on, status {started.status}: {started.told[-400:]}")
        return
    _compare(name, command, folder, expected, figures)


def _judge_end(name: str, started: Started, number: signal.Signals, status: int | None, figures: Figures) -> None:
    told = started.told
    if status is None:
        started.end()
        figures.silent += 1
        figures.note(f"{name}: still works {_LATE:.0f} s after {number.name}")
    elif number == signal.SIGTERM and status not in (143, 0, -signal.SIGTERM):
        figures.silent += 1
        figures.note(f"{name}: SIGTERM gave exit status {status}: {told[-400:]}")
    elif "Traceback" in told or "something unexpected" in told:
        figures.silent += 1
        figures.note(f"{name}: {told[-400:]}")
    if orphans := started.orphans():
        figures.silent += 1
        figures.note(f"{name}: processes {orphans} lived on after {number.name}")


def _compare(name: str, command: Command, folder: Path, expected: Undisturbed, figures: Figures) -> None:
    found = digests(folder, command)
    if found != expected.digests:
        figures.different += 1
        figures.note(f"{name}: {[file for file in found if found[file] != expected.digests[file]]} differ")
    left = [path.name for path in folder.rglob(".*") if path.name.endswith((".partial", ".lock"))]
    if left:
        figures.silent += 1
        figures.note(f"{name} left {left}")


def full_disks(count: int, seed: int = 0) -> Figures:
    """Commands on a disk of random size: each must say one sentence, leave no empty file, and go on with more room."""
    rng, figures, names = random.Random(seed), Figures(), list(ALL)
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            name = names[(seed + number) % len(names)]
            command, expected = ALL[name], undisturbed(ALL[name])
            size = int(rng.uniform(0.0, 1.3) * max(expected.size, 100_000)) // 4096 * 4096 + 8192
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place], check=True)
            try:
                words = words_of(command, f"{place}/run")
                first = complete(words, seconds=_LATE)
                figures.tried += 1
                _judge_full(name, size, first, Path(place), figures)
                if first.status:
                    subprocess.run(["mount", "-o", "remount,size=512m", place], check=True)
                    again = complete(words, seconds=_LATE)
                    if again.status:
                        figures.lost += 1
                        figures.note(f"{name} at {size} bytes did not go on: {again.told[-300:]}")
                        continue
                _compare(name, command, Path(place) / "run", expected, figures)
            finally:
                subprocess.run(["umount", place], check=True)
    return figures


def _judge_full(name: str, size: int, done: Started, place: Path, figures: Figures) -> None:
    told = [line for line in done.told.splitlines() if line.startswith("scene-envs: ")]
    empty = [
        path.name for path in place.rglob("*") if path.is_file() and not path.stat().st_size and path.name != "log.txt"
    ]
    unclear = "something unexpected" in done.told or "Traceback" in done.told or len(told) != 1 or done.status != 1
    if (done.status and unclear) or empty:
        figures.silent += 1
        figures.note(f"{name} at {size} bytes: status {done.status}, empty {empty}: {done.told[-400:]}")


def two_writers(count: int, seed: int = 0) -> Figures:
    """Two processes write into one folder.

    One of them must work, the other must be told who is writing, and the result must be that of one process.
    """
    rng, figures, names = random.Random(seed), Figures(), list(RESUMABLE)
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            name = names[(seed + number) % len(names)]
            command, folder = RESUMABLE[name], Path(place) / str(number)
            expected, words = undisturbed(command), words_of(command, folder)
            first = Started(words)
            time.sleep(rng.uniform(0.0, 0.8) * expected.seconds)
            second = complete(words, seconds=_LATE)
            first.wait(_LATE)
            figures.tried += 1
            statuses = [first.status, second.status]
            if 0 not in statuses:
                figures.lost += 1
                figures.note(f"{name}: {statuses} {first.told[-300:]} {second.told[-300:]}")
                continue
            _compare(name, command, folder, expected, figures)
            if any(statuses) and "is being written by scene-envs" not in first.told + second.told:
                figures.silent += 1
                figures.note(f"{name}: {statuses} {first.told[-300:]} {second.told[-300:]}")
    return figures
