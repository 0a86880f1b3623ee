"""Rows of tables, which are training runs, and the lines that show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from agents.configuration.composition import dotted_values
from agents.pretraining.settings import PretrainConfig


@dataclass(frozen=True)
class Row:
    """One training run.

    Attributes:
        name: of its folder; also what ``rows=`` selects by.
        overrides: keys of ``pretrain`` that differ from what all rows have in common.
        capacity: its parameters, as a multiple of those of other rows.
    """

    name: str
    overrides: Mapping[str, Any] = field(default_factory=dict)
    capacity: float = 1.0


@dataclass(frozen=True)
class Entry:
    """One line of a table.

    Attributes:
        label: what the reader sees.
        row: the training run.
        prompted: whether its prior is given prompts.
        group: heading under which the line stands, empty for none.
    """

    label: str
    row: Row
    prompted: bool = False
    group: str = ""


@dataclass(frozen=True)
class Table:
    """A table before its numbers.

    Attributes:
        name: as ``tables=`` knows it.
        title: heading.
        note: what was held equal, and how to read it.
        entries: lines, without that of real scenes.
        columns: names of columns, see :data:`benchmarks.paper_tables.columns.COLUMNS`.
        plotted: those of them that the picture shows.
    """

    name: str
    title: str
    note: str
    entries: tuple[Entry, ...]
    columns: tuple[str, ...]
    plotted: tuple[str, ...]


_TEXT: dict[str, Any] = {"process.name": "mixed", "text.encoder": "vocabulary", "text.dropout": 0.1}

_OF_SIZE = (
    *("recipe", "iterations", "batch_size", "network.hidden", "network.depth", "network.heads"),
    *("network.flux.double_blocks", "network.flux.embedding", "network.flux.pose_head"),
    *("optimizer.lr", "optimizer.rate.warmup", "optimizer.rate.decay"),
)
"""Keys of a recipe that belong to a network and a run of another size."""

PAPER: dict[str, Any] = {
    key: value
    for key, value in dotted_values(PretrainConfig(recipe="paper")).items()
    if value != dotted_values(PretrainConfig())[key] and key not in _OF_SIZE
}
"""The paper's setting, ``configs/recipe/paper.yaml``, for a network of the tables' size and a run of their length."""

_AS_PUBLISHED = {"network.modules.relations": "none", "network.flux.frequencies": 0, "process.empty_slots": "attended"}

NETWORKS: dict[str, dict[str, Any]] = {
    "flux": {"network.name": "flux"},
    "midiffusion": {"network.name": "midiffusion", **_AS_PUBLISHED},
    "diffuscene": {"network.name": "diffuscene", **_AS_PUBLISHED},
}
"""Ours with its defaults; the others read poses as they are, as published."""
NETWORK_LABELS = {"flux": "ours (flux)", "midiffusion": "MiDiffusion", "diffuscene": "DiffuScene"}
PROCESSES = ("mixed", "continuous")

COSTS = ("parameters", "seconds_per_step")
"""Columns that say what a row costs."""


def text_row(network: str) -> Row:
    """A mixed prior that reads prompts."""
    return Row(f"{network}_mixed_text", {**_TEXT, **NETWORKS[network]})


def plain_row(network: str, process: str) -> Row:
    """A prior that reads no prompts."""
    return Row(f"{network}_{process}", {"process.name": process, **NETWORKS[network]})
