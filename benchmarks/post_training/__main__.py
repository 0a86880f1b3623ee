"""Command ``python -m benchmarks.post_training table=NAME key=value …``: training, measures and the table of rows."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from typing import TYPE_CHECKING

from agents.cli.main import main_of
from scene_envs.errors import InvalidInputError, unknown_name

if TYPE_CHECKING:
    from agents.cli.run_folder import Run


@dataclass
class PostTrainingTables:
    """A table of post-training: its runs, their samples and those of the base priors.

    Attributes:
        table: stability, placement, equal_scenes, counts, prompts, realism, frontier, losses or
            long_losses.
        rows: patterns of the names of rows to run and show, such as [dimsum_table-nft-*]; empty for all.
        iterations: iterations of every run; null takes the number of the table.
        count: number of measured samples of each prior.
        keys: further keys of post-train for every run, such as ["batch_size=8"].
        train: train missing rows; false only tabulates the results in the folder.
        output: folder of the runs, the figures, table.md and table.csv; a second call resumes there.
    """

    table: str = "stability"
    rows: list[str] = field(default_factory=list)
    iterations: int | None = None
    count: int = 400
    keys: list[str] = field(default_factory=list)
    train: bool = True
    output: str = ""


def run(settings: PostTrainingTables, run: Run) -> None:
    """Train and measure what is missing, and write the table after every row."""
    from benchmarks.post_training.rows import TABLES, Row
    from benchmarks.post_training.runs import guard_figures, kept_loss, measure, train, training_figures
    from benchmarks.post_training.tables import comma_separated, markdown
    from scene_envs.files import write_text

    if settings.table not in TABLES:
        raise unknown_name("table", settings.table, sorted(TABLES))
    table = TABLES[settings.table]
    patterns = settings.rows or ["*"]
    rows = [row for row in table.rows if any(fnmatch(row.name, pattern) for pattern in patterns)]
    if not rows:
        names = ", ".join(row.name for row in table.rows)
        raise InvalidInputError(f"no row matches rows={settings.rows}; the rows are {names}")
    lines: list[tuple[str, dict[str, float]]] = []

    def figures_of(row: Row) -> dict[str, float]:
        iterations = settings.iterations or row.iterations
        folder = run.directory / row.name
        if settings.train:
            run.say(f"{row.name}: {iterations} iterations")
            train(row, run.directory, iterations, settings.keys)
        if not (folder / "log.csv").exists():
            return {}
        figures = training_figures(folder) | guard_figures(folder)
        figures["seconds_per_iteration"] = figures["seconds"] / figures["iterations"]
        if table.measures and (folder / "metrics.json").exists():
            prior = str(folder)
            measured_at = run.directory / f"{row.name}-figures"
            figures |= measure(prior, measured_at, table.measures, settings.count, row.guidance, table.evaluate)
            figures |= kept_loss(folder)
        return figures

    measured: set[str] = set()
    for row in rows:
        if table.measures and row.prior not in measured:
            measured.add(row.prior)
            base = run.directory / f"{row.prior}-figures"
            figures = measure(row.prior, base, table.measures, settings.count, row.guidance, table.evaluate)
            lines.append((row.prior, figures))
        lines.append((row.name, figures_of(row)))
        columns = ("iterations", *table.columns, "seconds")
        text = markdown(table.title, columns, lines)
        write_text(run.directory / "table.md", text)
        write_text(run.directory / "table.csv", comma_separated(columns, lines))
    run.say(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program and return its exit status."""
    return main_of("post_training", "tables of post-training", sys.modules[__name__], argv)


if __name__ == "__main__":
    sys.exit(main())
