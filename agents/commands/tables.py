"""``scene-envs tables``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agents.experiments.settings import TablesConfig

if TYPE_CHECKING:
    from agents.cli_run import Run


def config() -> type[TablesConfig]:
    """The keys of this command."""
    return TablesConfig


def run(settings: TablesConfig, run: Run) -> None:
    """Train, measure and tabulate; the runner writes the files."""
    from agents.experiments import run_tables

    run_tables(settings, run.say)
    run.say((run.directory / "tables.md").read_text(encoding="utf-8"))
    run.say(f"{run.directory / 'tables.md'}, tables.csv and plot.png")
