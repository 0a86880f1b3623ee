"""The columns of the tables: which figure, in which unit, with which error."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from scene_envs.errors import unknown_name

Figures = Mapping[str, float | None]
"""Figures of one line by name; None where a number is not finite."""


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        name: of the figure.
        title: what the reader sees, unit included.
        scale: the figure is shown times this.
        digits: significant digits.
        better: ``"low"``, ``"high"``, or ``""`` where neither is.
        error: name of the figure that holds the standard error or deviation. With ``binomial``, name of the number of
            trials of which the figure is a share.
        binomial: whether ``error`` names a number of trials.
    """

    name: str
    title: str
    scale: float = 1.0
    digits: int = 3
    better: str = ""
    error: str = ""
    binomial: bool = False


def _share(name: str, title: str, better: str, trials: str) -> Column:
    return Column(name, f"{title} %", 100.0, 3, better, trials, binomial=True)


COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("classifier_accuracy", "classifier accuracy %", 100.0, 3, "low", "classifier_accuracy_std"),
        Column("frechet_scene_distance", "FSD", 1.0, 3, "low"),
        Column("category_kl", "category KL ×10⁴", 1e4, 3, "low"),
        Column("median_total_penetration_cm", "median total penetration cm", 1.0, 3, "low"),
        _share("feasible_fraction", "feasible objects", "high", "free_objects"),
        _share("stable_fraction", "stable objects", "high", "free_objects"),
        Column("count_wasserstein", "count W₁", 1.0, 3, "low"),
        _share("prompt_following", "prompts followed", "high", "prompt_following_number"),
        _share("prompt_counts", "counts followed", "high", "prompt_counts_number"),
        _share("prompt_names", "names followed", "high", "prompt_names_number"),
        _share("prompt_relations", "relations followed", "high", "prompt_relations_number"),
        Column("overlap_median_mm", "overlap depth, median mm", 1.0, 3, "low"),
        _share("deeper_than_1mm_fraction", "deeper than 1 mm", "low", "free_objects"),
        _share("deeper_than_1cm_fraction", "deeper than 1 cm", "low", "free_objects"),
        Column("parameters", "parameters", 1.0, 4),
        Column("seconds_per_step", "s per step", 1.0, 2),
    )
}  # fmt: skip
"""Columns with a name of their own; ``height_errors`` stands for one or more, see :func:`expand`."""

HEIGHT_ERRORS = "height_errors"


def expand(names: Iterable[str], lines: Sequence[Figures]) -> list[Column]:
    """The columns called ``names`` that at least one line has a number for.

    ``height_errors`` becomes the median and the 95 % quantile of every kind of support that occurs.

    >>> [column.title for column in expand(["height_errors"], [{"height_error_table_mm": 0.3}])]
    ['height error, table, median mm']
    """
    found: list[Column] = []
    for name in names:
        found += _height_columns(lines) if name == HEIGHT_ERRORS else [_column(name)]
    return [column for column in found if any(line.get(column.name) is not None for line in lines)]


def value(column: Column, figures: Figures) -> float | None:
    """The number that the column shows for a line, None where there is none."""
    number = figures.get(column.name)
    return None if number is None or not math.isfinite(number) else number * column.scale


def error(column: Column, figures: Figures) -> float | None:
    """The standard error beside :func:`value`: √(p (1 − p) / n) of a share of n, or as it was measured.

    None where nothing was measured, and for a share of 0 or 1, for which the formula is of no use.

    >>> share = Column("good", "good %", 100.0, error="trials", binomial=True)
    >>> error(share, {"good": 0.5, "trials": 100})
    5.0
    """
    number, other = figures.get(column.name), figures.get(column.error) if column.error else None
    if number is None or other is None or not math.isfinite(other):
        return None
    if not column.binomial:
        return other * column.scale
    return math.sqrt(number * (1.0 - number) / other) * column.scale if other > 0 and 0 < number < 1 else None


def text(column: Column, figures: Figures) -> str:
    """A cell: the number with its error, empty where there is none.

    >>> text(COLUMNS["feasible_fraction"], {"feasible_fraction": 0.5, "free_objects": 100.0})
    '50.0 ± 5.0'
    """
    number, spread = value(column, figures), error(column, figures)
    if number is None:
        return ""
    if spread is None:
        return format_number(number, column.digits)
    places = max(0, min(4, 1 - math.floor(math.log10(spread)))) if spread > 0 else 1
    return f"{number:.{places}f} ± {spread:.{places}f}"


def format_number(number: float, digits: int = 3) -> str:
    """``number`` with ``digits`` significant digits, never in exponents.

    >>> format_number(0.01234), format_number(1234567.0), format_number(12.0), format_number(1e-6)
    ('0.0123', '1,234,567', '12.0', '<0.0001')
    """
    if number == 0:
        return "0"
    if 0 < number < 1e-4:
        return "<0.0001"
    places = digits - 1 - math.floor(math.log10(abs(number)))
    return f"{number:,.{max(0, min(6, places))}f}"


def _column(name: str) -> Column:
    if name not in COLUMNS:
        raise unknown_name("column", name, [*COLUMNS, HEIGHT_ERRORS])
    return COLUMNS[name]


def _height_columns(lines: Sequence[Figures]) -> list[Column]:
    """Median before 95 % quantile, kind by kind, in the order in which they are met."""
    kinds: dict[str, None] = {}
    for line in lines:
        for name in line:
            if name.startswith("height_error_") and name.endswith("_mm") and not name.endswith("_p95_mm"):
                kinds[name.removeprefix("height_error_").removesuffix("_mm")] = None
    columns = []
    for kind in kinds:
        shown = kind.replace("_", " ")
        columns.append(Column(f"height_error_{kind}_mm", f"height error, {shown}, median mm", better="low"))
        columns.append(Column(f"height_error_{kind}_p95_mm", f"height error, {shown}, p95 mm", better="low"))
    return columns
