"""``python -m benchmarks.reliability [kills=N] [terms=N] [lines=N] [files=N] [rewards=N] [full=N] [writers=N]``.

Tries each so many times, one process at a time, and prints a table: how often it was tried, and in how many a finished
state was lost, a result differed, or something wrong was not told. The last three should be 0. Full
disks need the right to mount a tmpfs; nothing needs a network.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence

from benchmarks.reliability.command_lines import fuzzed_lines
from benchmarks.reliability.damaged_files import fuzzed_files
from benchmarks.reliability.figures import Figures
from benchmarks.reliability.interruptions import full_disks, kills, two_writers
from benchmarks.reliability.rewards import hostile_rewards

TRIALS: dict[str, Callable[[int], Figures]] = {
    "kills": kills,
    "terms": lambda count: kills(count, signal.SIGTERM, 1),
    "lines": fuzzed_lines,
    "files": fuzzed_files,
    "rewards": hostile_rewards,
    "full": full_disks,
    "writers": two_writers,
}
"""Kinds of trials by the word that says how many."""
COUNTS = {"kills": 300, "terms": 60, "lines": 10_000, "files": 10_000, "rewards": 100, "full": 100, "writers": 10}


def main(words: Sequence[str]) -> None:
    """Print a row per kind of trial, and the cases that went wrong."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    asked = {name: int(count) for name, _, count in (word.partition("=") for word in words)} or COUNTS
    print("| what | tried | lost | different | silent | seconds |\n|---|---|---|---|---|---|", flush=True)
    for name, count in asked.items():
        started = time.monotonic()
        found = TRIALS[name](count)
        row = (name, found.tried, found.lost, found.different, found.silent, round(time.monotonic() - started))
        print("| " + " | ".join(map(str, row)) + " |", flush=True)
        for note in found.notes:
            print(f"  {name}: {note}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
