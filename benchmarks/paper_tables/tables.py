"""Tables with their numbers, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from benchmarks.paper_tables import columns as columns_
from benchmarks.paper_tables.columns import Column, Figures
from benchmarks.paper_tables.rows import Table

REAL = "real"
"""Label of the line of real scenes measured against other real scenes."""


@dataclass(frozen=True)
class Line:
    """One line with its numbers.

    Attributes:
        label: what the reader sees.
        row: name of the training run, empty for real scenes.
        group: heading under which it stands.
        figures: by name; empty where the run failed.
        failure: why it failed, empty where it did not.
        pending: whether the run has not been tried yet.
    """

    label: str
    row: str
    group: str
    figures: Figures
    failure: str = ""
    pending: bool = False


@dataclass(frozen=True)
class FilledTable:
    """A table with its lines, that of real scenes last.

    Attributes:
        table: what it was made from.
        lines: in order.
        note: the table's note and the settings that hold for all lines.
    """

    table: Table
    lines: tuple[Line, ...]
    note: str

    def columns(self) -> list[Column]:
        """The columns for which there are numbers."""
        return columns_.expand(self.table.columns, [line.figures for line in self.lines])


def markdown(tables: Sequence[FilledTable], title: str, lead: str) -> str:
    """A page with every table under its heading."""
    parts = [f"# {title}", lead]
    for filled in tables:
        parts += [f"## {filled.table.title}", filled.note, markdown_table(filled)]
    return "\n\n".join(part for part in parts if part) + "\n"


def markdown_table(filled: FilledTable) -> str:
    """One table; lines of a group follow its heading, the message of a failed run stands in its line."""
    shown = filled.columns()
    rows = [["", *(column.title for column in shown)]]
    group = ""
    for line in filled.lines:
        if line.group != group and line.group:
            rows.append([f"**{line.group}**", *([""] * len(shown))])
        group = line.group
        rows.append([line.label, *_cells(line, shown)])
    head, *body = ["| " + " | ".join(_escaped(cell) for cell in row) + " |" for row in rows]
    return "\n".join([head, "|---" * (len(shown) + 1) + "|", *body])


def csv_text(tables: Sequence[FilledTable]) -> str:
    """All tables as one, a line each, with the unscaled figures and their standard errors.

    Columns: ``table``, ``row`` (empty for real scenes), ``label``, ``group``, ``failure``, and for every figure its
    name and, where it has one, ``<name>_error``.
    """
    shown: dict[str, Column] = {column.name: column for filled in tables for column in filled.columns()}
    records = [_record(filled.table.name, line, shown) for filled in tables for line in filled.lines]
    names = ["table", "row", "label", "group", "failure"]
    for name in shown:
        names += [key for key in (name, f"{name}_error") if any(key in record for record in records)]
    out = io.StringIO()
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return out.getvalue()


def _record(table: str, line: Line, shown: Mapping[str, Column]) -> dict[str, str]:
    record = {"table": table, "row": line.row, "label": line.label, "group": line.group, "failure": line.failure}
    for name, column in shown.items():
        number, spread = line.figures.get(name), columns_.error(column, line.figures)
        if number is not None:
            record[name] = f"{number:.8g}"
        if number is not None and spread is not None:
            record[f"{name}_error"] = f"{spread / column.scale:.4g}"
    return record


def _cells(line: Line, shown: Sequence[Column]) -> list[str]:
    if line.pending:
        return ["not run yet", *([""] * (len(shown) - 1))] if shown else []
    if line.failure:
        return [f"failed: {line.failure}", *([""] * (len(shown) - 1))] if shown else []
    return [columns_.text(column, line.figures) for column in shown]


def _escaped(cell: str) -> str:
    """A cell on one line, its bars escaped."""
    return " ".join(cell.split()).replace("|", "\\|")
