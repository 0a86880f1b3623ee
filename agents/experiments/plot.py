"""The tables as one picture: a strip of dots per table and column, with real scenes as a line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.experiments import columns as columns_
from agents.experiments.columns import Column
from agents.experiments.tables import FilledTable, Line

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DOT, FLOOR, FAINT, INK = "#0f766e", "#b45309", "#e8ebee", "#1c2733"
_LINE_HEIGHT, _MARGIN, _PANEL_WIDTH, _LABEL_WIDTH = 0.235, 1.15, 2.9, 3.1
_LOGARITHMIC = 30.0
"""Columns whose largest number is this many times the smallest get a logarithmic axis."""


def draw(tables: Sequence[FilledTable], path: Path) -> Path | None:
    """Write the picture; None when no table has a number yet.

    Args:
        tables: with their numbers.
        path: of the PNG.
    """
    shown = [(filled, _plotted(filled), _lines(filled)) for filled in tables]
    shown = [one for one in shown if one[1] and one[2]]
    if not shown:
        return None
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    heights = [_MARGIN + _LINE_HEIGHT * len(lines) for _, _, lines in shown]
    across = max(len(chosen) for _, chosen, _ in shown)
    figure = Figure(figsize=(_LABEL_WIDTH + _PANEL_WIDTH * across, sum(heights)), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    parts = figure.subfigures(len(shown), 1, height_ratios=heights, squeeze=False)[:, 0]
    for part, (filled, chosen, lines) in zip(parts, shown, strict=True):
        part.suptitle(filled.table.title, x=0.01, ha="left", fontsize=11, fontweight="bold", color=INK)
        panels = part.subplots(1, across, sharey=True, squeeze=False)[0]
        for panel, column in zip(panels, chosen, strict=False):
            _draw_panel(panel, column, lines, filled.lines[-1])
        for panel in panels[len(chosen) :]:
            panel.set_visible(False)
        panels[0].set_yticks(range(len(lines)), [line.label for line in lines], fontsize=8.5)
        panels[0].set_ylim(len(lines) - 0.4, -0.6)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def _plotted(filled: FilledTable) -> list[Column]:
    """One column per name of ``plotted``: the first of those that the name stands for."""
    figures = [line.figures for line in filled.lines]
    expanded = [columns_.expand([name], figures) for name in filled.table.plotted]
    return [found[0] for found in expanded if found]


def _lines(filled: FilledTable) -> list[Line]:
    """The rows, without real scenes."""
    return list(filled.lines[:-1])


def _draw_panel(panel: Axes, column: Column, lines: Sequence[Line], real: Line) -> None:
    numbers = [columns_.value(column, line.figures) for line in lines]
    floor = columns_.value(column, real.figures)
    for height, (line, number) in enumerate(zip(lines, numbers, strict=True)):
        if number is None:
            panel.text(0.02, height, "failed" if line.failure else "no data", fontsize=7, va="center", color="#99a3ad",
                       transform=panel.get_yaxis_transform())  # fmt: skip
            continue
        spread = columns_.error(column, line.figures)
        panel.errorbar(number, height, xerr=spread, fmt="o", color=DOT, markersize=5, elinewidth=1.2, capsize=0)
    _scale(panel, [number for number in (*numbers, floor) if number is not None])
    if floor is not None:
        panel.axvline(floor, color=FLOOR, linestyle="--", linewidth=1.2)
        panel.text(floor, 1.0, "real", color=FLOOR, fontsize=7.5, ha="center", va="bottom",
                   transform=panel.get_xaxis_transform())  # fmt: skip
    panel.set_xlabel(f"{column.title}{_ARROWS[column.better]}", fontsize=8.5, color=INK)
    for start, line in enumerate(lines):
        if start and line.group != lines[start - 1].group:
            panel.axhline(start - 0.5, color="#99a3ad", linewidth=0.8)
    panel.spines[["top", "right", "left"]].set_visible(False)
    panel.grid(axis="both", color=FAINT, linewidth=0.8)
    panel.set_axisbelow(True)
    panel.tick_params(labelsize=8, length=0)


_ARROWS = {"low": "  (lower is better)", "high": "  (higher is better)", "": ""}


def _scale(panel: Any, numbers: Sequence[float]) -> None:
    if numbers and min(numbers) > 0 and max(numbers) > _LOGARITHMIC * min(numbers):
        panel.set_xscale("log")
