"""Every table by its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from benchmarks.paper_tables.definitions import conditional, objective, rotation, unconditional
from benchmarks.paper_tables.precision_table import precision
from benchmarks.paper_tables.rows import Row, Table
from benchmarks.paper_tables.settings import ALL_TABLES
from scene_envs.errors import InvalidInputError

_MAKERS = {
    "unconditional": unconditional,
    "conditional": conditional,
    "objective": objective,
    "rotation": rotation,
    "precision": precision,
}


def make_tables(names: Sequence[str] = ALL_TABLES, rows: Sequence[str] = ()) -> list[Table]:
    """The tables called ``names``, in the order of :data:`ALL_TABLES`, with the rows that match a pattern of ``rows``.

    Raises:
        InvalidInputError: a pattern matches no row of these tables.

    >>> [entry.row.name for entry in make_tables(["rotation"])[0].entries]
    ['flux_continuous', 'flux_continuous_quaternion', 'flux_continuous_axis_angle']
    """
    tables = [_MAKERS[name]() for name in ALL_TABLES if name in names]
    known = list(dict.fromkeys(entry.row.name for table in tables for entry in table.entries))
    for pattern in rows:
        if not any(fnmatchcase(name, pattern) for name in known):
            raise InvalidInputError(f"rows: {pattern!r} matches no row of these tables; known: {', '.join(known)}")
    if not rows:
        return tables
    chosen = [
        replace(table, entries=tuple(e for e in table.entries if any(fnmatchcase(e.row.name, p) for p in rows)))
        for table in tables
    ]
    return [table for table in chosen if table.entries]


def list_rows(tables: Sequence[Table]) -> list[Row]:
    """Every training run of ``tables``, once."""
    return list({entry.row.name: entry.row for table in tables for entry in table.entries}.values())
