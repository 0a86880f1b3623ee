"""Command ``python -m benchmarks.paper_tables key=value …``: training and measures of priors for the paper's tables."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from agents.cli.main import main_of
from benchmarks.paper_tables.settings import TablesConfig

if TYPE_CHECKING:
    from agents.cli.run_folder import Run

MEANING = "train and measure priors for the paper's tables and that of precision"


def run(settings: TablesConfig, run: Run) -> None:
    """Train, measure and tabulate; the runner writes the files."""
    from benchmarks.paper_tables.runner import run_tables

    run_tables(settings, run.say)
    run.say((run.directory / "tables.md").read_text(encoding="utf-8"))
    run.say(f"{run.directory / 'tables.md'}, tables.csv and plot.png")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program and return its exit status."""
    return main_of("paper_tables", MEANING, sys.modules[__name__], argv)


if __name__ == "__main__":
    sys.exit(main())
