"""Trials that disturb a running command: kills, full disks, a second writer."""

from __future__ import annotations

import contextlib
import random
import signal
import subprocess
import tempfile
import time
from pathlib import Path

from benchmarks.reliability.figures import Figures
from benchmarks.reliability.processes import GENERATE, POST, PRETRAIN, RESULTS, RESUMABLE, command, digests


def kills(count: int, number: signal.Signals = signal.SIGKILL, seed: int = 0) -> Figures:
    """Kill resumable commands at random moments until they end; results are compared with an undisturbed run's."""
    figures, rng = Figures(), random.Random(seed)
    with tempfile.TemporaryDirectory() as place:
        expected, seconds = {}, {}
        for name, words in RESUMABLE.items():
            started = time.monotonic()
            subprocess.run(command(*words, f"output={place}/{name}"), check=True, capture_output=True)
            seconds[name] = time.monotonic() - started
            expected[name] = digests(Path(place) / name, RESULTS[name])
        trial = 0
        while figures.tried < count:
            name = sorted(RESUMABLE)[trial % len(RESUMABLE)]
            trial += 1
            _kill_until_done(name, Path(place) / f"{name}-{trial}", number, rng, seconds[name], expected[name], figures)
    return figures


def _kill_until_done(
    name: str, folder: Path, number: signal.Signals, rng: random.Random, seconds: float, expected: dict[str, str],
    figures: Figures,
) -> None:  # fmt: skip
    words = command(*RESUMABLE[name], f"output={folder}")
    for _ in range(3):
        process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(rng.uniform(0.3, 1.1) * seconds)
        if process.poll() is not None:
            break
        process.send_signal(number)
        status = process.wait()
        figures.tried += 1
        if number == signal.SIGTERM and status not in (143, 0):
            figures.silent += 1
            figures.note(f"{name}: SIGTERM gave exit status {status}")
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        figures.lost += 1
        figures.note(f"{name} did not go on: {done.stderr[-400:]}")
        return
    found = digests(folder, expected)
    if found != expected:
        figures.different += 1
        figures.note(f"{name}: {[file for file in expected if found.get(file) != expected[file]]} differ")
    left = [path.name for path in folder.rglob(".*") if path.name.endswith((".partial", ".lock", ".journal"))]
    if left:
        figures.silent += 1
        figures.note(f"{name} left {left}")


def full_disks(count: int, seed: int = 0) -> Figures:
    """Commands on a disk with a random number of bytes left: one sentence, no empty file, and they go on after."""
    rng, figures = random.Random(seed), Figures()
    lines = (POST, PRETRAIN, GENERATE, ("sample", "count=2", "num_steps=1", "workers=0", "reward=object_count"))
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            line = lines[number % len(lines)]
            size = int(4096 * 10 ** rng.uniform(0.3, 3.2))
            subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", place], check=True)
            try:
                words = command(*line, f"output={place}/run")
                first = subprocess.run(words, capture_output=True, text=True, check=False)
                figures.tried += 1
                _judge_full(line[0], size, first, Path(place), figures)
                if first.returncode:
                    subprocess.run(["mount", "-o", "remount,size=512m", place], check=True)
                    again = subprocess.run(words, capture_output=True, text=True, check=False)
                    if again.returncode:
                        figures.lost += 1
                        figures.note(f"{line[0]} at {size} bytes did not go on: {again.stderr[-300:]}")
            finally:
                subprocess.run(["umount", place], check=True)
    return figures


def _judge_full(name: str, size: int, done: subprocess.CompletedProcess[str], place: Path, figures: Figures) -> None:
    told = [line for line in done.stderr.splitlines() if line.startswith("scene-envs: ")]
    empty = [
        path.name for path in place.rglob("*") if path.is_file() and not path.stat().st_size and path.name != "log.txt"
    ]
    bad = done.returncode and ("something unexpected" in done.stderr or "Traceback" in done.stderr or not told)
    if bad or empty:
        figures.silent += 1
        figures.note(f"{name} at {size} bytes: status {done.returncode}, empty {empty}: {done.stderr[-400:]}")


def two_writers(count: int, seed: int = 0) -> Figures:
    """Two processes with one folder: one of them works, the other is told who does."""
    rng, figures = random.Random(seed), Figures()
    with tempfile.TemporaryDirectory() as place:
        for number in range(count):
            name = sorted(RESUMABLE)[number % len(RESUMABLE)]
            words = command(*RESUMABLE[name], f"output={place}/{number}")
            first = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
            time.sleep(rng.uniform(0.0, 0.5))
            second = subprocess.run(words, capture_output=True, text=True, check=False)
            _, err = first.communicate()
            figures.tried += 1
            statuses = sorted((first.returncode, second.returncode))
            if statuses[0] != 0:
                figures.lost += 1
                figures.note(f"{name}: {statuses} {err[-300:]} {second.stderr[-300:]}")
            elif statuses[1] and "is being written by scene-envs" not in err + second.stderr:
                figures.silent += 1
                figures.note(f"{name}: {err[-300:]} {second.stderr[-300:]}")
    return figures
