"""The tables as one picture: a strip of dots per table and column, with real scenes as a line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.paper_tables import columns as columns_
from benchmarks.paper_tables.columns import Column
from benchmarks.paper_tables.tables import FilledTable, Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DOT, FLOOR, FAINT, SOFT, INK = "#0f766e", "#b45309", "#e8ebee", "#99a3ad", "#1c2733"
_LINE, _ABOVE, _BELOW = 0.23, 0.52, 0.56
"""Heights in inches: of a line, and of what stands above and below the lines of a table."""
_LABELS, _PANEL, _GAP = 2.75, 2.6, 0.42
"""Widths in inches: of the labels, of a panel, between panels."""
_LOGARITHMIC = 30.0
"""Columns whose largest number is this many times the smallest get a logarithmic axis."""
_BETTER = {"low": "  (lower is better)", "high": "  (higher is better)", "": ""}


def draw(tables: Sequence[FilledTable], path: Path) -> Path | None:
    """Write the picture; None when no table has a number yet.

    Args:
        tables: with their numbers.
        path: of the PNG.
    """
    chosen = [(filled, _plotted(filled)) for filled in tables]
    chosen = [(filled, columns) for filled, columns in chosen if columns]
    if not chosen:
        return None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    across = max(len(columns) for _, columns in chosen)
    width = _LABELS + across * (_PANEL + _GAP)
    height = sum(_height(filled) for filled, _ in chosen)
    figure = Figure(figsize=(width, height), dpi=130)
    FigureCanvasAgg(figure)
    top = height
    for filled, columns in chosen:
        _draw_table(figure, filled, columns, top)
        top -= _height(filled)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _plotted(filled: FilledTable) -> list[Column]:
    """One column per name of ``plotted``: the first of those that the name stands for."""
    figures = [line.figures for line in filled.lines[:-1]]
    expanded = [columns_.expand([name], figures) for name in filled.table.plotted]
    return [found[0] for found in expanded if found]


def _height(filled: FilledTable) -> float:
    return _ABOVE + _LINE * len(filled.lines[:-1]) + _BELOW


def _draw_table(figure: Figure, filled: FilledTable, columns: Sequence[Column], top: float) -> None:
    """The panels of one table below ``top`` (inches from the bottom of the figure)."""
    *lines, real = filled.lines
    width, height = figure.get_size_inches()
    figure.text(0.12 / width, (top - 0.12) / height, filled.table.title, fontsize=11, fontweight="bold", color=INK,
                va="top")  # fmt: skip
    bottom, tall = top - _ABOVE - _LINE * len(lines), _LINE * len(lines)
    for number, column in enumerate(columns):
        left = _LABELS + number * (_PANEL + _GAP)
        panel = figure.add_axes((left / width, bottom / height, _PANEL / width, tall / height))
        _draw_panel(panel, column, lines, real)
        panel.set_ylim(len(lines) - 0.5, -0.5)
        panel.set_yticks(range(len(lines)), [line.label for line in lines] if not number else [], fontsize=8.5)


def _draw_panel(panel: Axes, column: Column, lines: Sequence[Line], real: Line) -> None:
    numbers = [columns_.value(column, line.figures) for line in lines]
    floor = columns_.value(column, real.figures)
    _scale(panel, column, [number for number in (*numbers, floor) if number is not None])
    for height, (line, number) in enumerate(zip(lines, numbers, strict=True)):
        if number is None:
            why = "failed" if line.failure else "not run yet" if line.pending else "no data"
            panel.text(0.02, height, why, fontsize=7, va="center", color=SOFT,
                       transform=panel.get_yaxis_transform())  # fmt: skip
            continue
        spread = columns_.error(column, line.figures)
        panel.errorbar(number, height, xerr=spread, fmt="o", color=DOT, markersize=5, elinewidth=1.2, clip_on=False)
    if floor is not None:
        panel.axvline(floor, color=FLOOR, linestyle="--", linewidth=1.2, clip_on=False)
        panel.text(floor, 1.0, "real", color=FLOOR, fontsize=7.5, ha="center", va="bottom",
                   transform=panel.get_xaxis_transform())  # fmt: skip
    for start, line in enumerate(lines):
        if start and line.group != lines[start - 1].group:
            panel.axhline(start - 0.5, color=SOFT, linewidth=0.8)
    panel.set_xlabel(f"{column.title}{_BETTER[column.better]}", fontsize=8, color=INK)
    panel.spines[["top", "right", "left"]].set_visible(False)
    panel.grid(axis="both", color=FAINT, linewidth=0.8)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8, length=0, which="both")
    panel.tick_params(axis="y", pad=7)


def _scale(panel: Axes, column: Column, numbers: Sequence[float]) -> None:
    """Set the axis: 0 to 100 for shares, otherwise the range of the numbers, logarithmic where they differ much."""
    some = [number for number in numbers if number > 1e-4]
    if column.scale == 100.0:
        panel.set_xlim(0, 100)
    elif some and max(some) > _LOGARITHMIC * min(some):
        if len(some) == len(numbers):
            panel.set_xscale("log")
            panel.xaxis.set_minor_formatter("")  # over less than two decades the labels of minor ticks overlap
        else:
            panel.set_xscale("symlog", linthresh=min(some))
