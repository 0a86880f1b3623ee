"""Command ``python -m benchmarks.reliability [PART ...] [PART=COUNT ...] [rows=FILE] [seed=N]``.

Runs the parts that are named, or all at full size, a part of a few trials after the other in one process at a time, and
appends a row of JSON to FILE after each. Rows that FILE has are not measured again, so a run that was cut off goes on.
Prints the sums at the end: how often it was tried, and in how many a finished state was lost, a result differed, or
something wrong was not told. The last three should be 0. Full disks need the right to mount a tmpfs; nothing needs a
network.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from signal import SIGTERM
from typing import Any

from benchmarks.reliability.command_lines import fuzzed_lines, two_ways
from benchmarks.reliability.damaged_files import fuzzed_files
from benchmarks.reliability.figures import Figures
from benchmarks.reliability.flat import episodes, physics_calls
from benchmarks.reliability.interruptions import full_disks, kills, two_writers
from benchmarks.reliability.rewards import hostile_rewards
from benchmarks.reliability.small_commands import REPEATABLE


@dataclass(frozen=True)
class Part:
    """A kind of trial: ``run(count, seed)``, how many at full size, and how many make a row."""

    run: Callable[[int, int], Figures]
    count: int
    row: int


PARTS = {
    "kills": Part(kills, 300, 20),
    "fresh_kills": Part(lambda count, seed: kills(count, seed, fresh=True), 30, 5),
    "terms": Part(lambda count, seed: kills(count, seed, SIGTERM), 60, 20),
    "repeated_kills": Part(lambda count, seed: kills(count, seed, commands=REPEATABLE), 60, 20),
    "full": Part(full_disks, 100, 20),
    "writers": Part(two_writers, 40, 20),
    "rewards": Part(hostile_rewards, 100, 20),
    "files": Part(fuzzed_files, 5_000, 500),
    "two_ways": Part(two_ways, 20, 10),
    "lines": Part(fuzzed_lines, 5_000, 250),
    "episodes": Part(episodes, 10_000, 10_000),
    "physics": Part(physics_calls, 2_000, 2_000),
}
"""Parts by name, in the order in which they run."""


def main(words: Sequence[str]) -> None:
    """Measure what is asked for and print the sums."""
    if {"-h", "--help"} & set(words):
        sys.exit(__doc__)
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    named = dict(word.partition("=")[::2] for word in words)
    path, seed = Path(named.pop("rows", "reliability.jsonl")), int(named.pop("seed", "0"))
    unknown = [f"{name}={count}" for name, count in named.items() if name not in PARTS or not (count or "1").isdigit()]
    if unknown:
        sys.exit(
            f"{', '.join(unknown)}: known are {', '.join(PARTS)}, each alone or as PART=COUNT, rows=FILE and seed=N"
        )
    asked = {name: int(count or PARTS[name].count) for name, count in named.items()}
    asked = asked or {name: part.count for name, part in PARTS.items()}
    for name, count in asked.items():
        part = PARTS[name]
        for number, first in enumerate(range(0, count, part.row)):
            if (name, seed + number) in {(row["part"], row["seed"]) for row in _rows(path)}:
                continue
            started, used = time.monotonic(), _processor_seconds()
            found = part.run(min(part.row, count - first), seed + number)
            row = {"part": name, "seed": seed + number, **asdict(found)}
            row |= {"seconds": time.monotonic() - started, "processor_seconds": _processor_seconds() - used}
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            for note in found.notes:
                print(f"  {name} {seed + number}: {note}", file=sys.stderr, flush=True)
    _print_sums(_rows(path))


def _rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def _print_sums(rows: Sequence[dict[str, Any]]) -> None:
    columns = ("tried", "lost", "different", "silent", "processor_seconds")
    print(f"| what | {' | '.join(columns)} |\n|---|---|---|---|---|---|")
    for name in PARTS:
        if own := [row for row in rows if row["part"] == name]:
            print(f"| {name} | " + " | ".join(f"{sum(row[column] for row in own):.0f}" for column in columns) + " |")
            for row in own:
                print(*(f"  {key}: {value}\n" for key, value in row["measured"].items()), sep="", end="")


def _processor_seconds() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


if __name__ == "__main__":
    main(sys.argv[1:])
