"""Rows of figures as a Markdown table."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from io import StringIO

Figures = Mapping[str, float]


def _percent(value: float) -> str:
    return f"{100 * value:.1f} %"


def _plain(digits: int) -> Callable[[float], str]:
    return lambda value: f"{value:.{digits}f}"


COLUMNS: dict[str, tuple[str, str, Callable[[float], str]]] = {
    "iterations": ("iterations", "iterations", _plain(0)),
    "free": ("free objects", "free_objects_mean", _plain(2)),
    "feasible": ("feasible objects", "feasible_objects", _plain(2)),
    "share": ("feasible share", "feasible_fraction", _percent),
    "collision": ("scenes with a collision", "collision_rate", _percent),
    "loss": ("held-out loss", "loss", _plain(3)),
    "count_wasserstein": ("W₁ of counts", "count_wasserstein", _plain(2)),
    "category_kl": ("category KL × 10⁴", "category_kl_e4", _plain(1)),
    "spacing": ("W₁ of spacing, mm", "spacing_wasserstein_mm", _plain(1)),
    "classifier": ("classifier", "classifier_accuracy", _percent),
    "prompt_counts": ("counts followed", "prompt_counts", _percent),
    "prompt_names": ("names", "prompt_names", _percent),
    "prompt_relations": ("relations", "prompt_relations", _percent),
    "base_reward": ("reward of the base prior's samples", "base_reward", _percent),
    "guard_reward": ("after training", "guard_reward", _percent),
    "kept": ("kept at", "kept", _plain(0)),
    "guard_counts": ("distance of counts", "guard_counts", _plain(2)),
    "base_classifier": ("classifier, base prior", "base_classifier", _percent),
    "guard_classifier": ("after training", "guard_classifier", _percent),
    "first": ("first 20", "first", _percent),
    "best": ("best 20", "best", _percent),
    "last": ("last 20", "last", _percent),
    "fall": ("largest fall", "fall", _percent),
    "training_seconds": ("seconds", "seconds", _plain(0)),
    "seconds": ("seconds per iteration", "seconds_per_iteration", _plain(1)),
}
"""Heading, figure and format of each column."""


def markdown(title: str, columns: Sequence[str], lines: Sequence[tuple[str, Figures]]) -> str:
    """A table with its heading; a figure that a line lacks is left empty.

    >>> print(markdown("Runs", ["free"], [("base", {"free_objects_mean": 17.1}), ("not run", {})]))
    ## Runs
    <BLANKLINE>
    | run | free objects |
    |---|---|
    | base | 17.10 |
    | not run | |
    <BLANKLINE>
    """
    shown = [COLUMNS[name] for name in columns]
    head = ["| run | " + " | ".join(heading for heading, _, _ in shown) + " |", "|---" * (len(shown) + 1) + "|"]
    body = []
    for label, figures in lines:
        cells = [write(figures[name]) if name in figures else "" for _, name, write in shown]
        body.append("|".join(["", f" {label} ", *(f" {cell} " if cell else " " for cell in cells), ""]))
    return "\n".join([f"## {title}", "", *head, *body, ""])


def comma_separated(columns: Sequence[str], lines: Sequence[tuple[str, Figures]]) -> str:
    """The figures of a table as CSV, not rounded; a figure that a line lacks is left empty.

    >>> print(comma_separated(["free"], [("base", {"free_objects_mean": 17.125}), ("not run", {})]).strip())
    run,free_objects_mean
    base,17.125
    not run,
    """
    names = [COLUMNS[name][1] for name in columns]
    file = StringIO()
    writer = csv.DictWriter(file, ["run", *names], extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({"run": label, **figures} for label, figures in lines)
    return file.getvalue()
