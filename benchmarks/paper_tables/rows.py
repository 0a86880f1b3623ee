"""What tables are made of: rows, which are training runs, and lines that show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


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


_TEXT: dict[str, Any] = {"process": "mixed", "text": True, "prompt_dropout": 0.1}

PAPER: dict[str, Any] = {
    "process": "mixed",
    "network": "flux",
    "prediction": "epsilon",
    "schedule": "linear",
    "timesteps": "uniform",
    "loss_weighting": "none",
    "moments": "feature",
    "translation_weight": 1.0,
    "category_loss": "bound",
    "category_weight": 1.0,
    "given_share": 0.0,
    "denoised_clip": 1.0,
    "kernel": "mask_and_replace",
    "empty_slots": "attended",
    "attention": "plain",
    "frequencies": 0,
    "rotation_features": False,
    "contacts": False,
    "optimizer": "adamw",
}
"""The paper's setting: noise prediction under a linear schedule, the variational bound of masked and replaced
categories, AdamW, and a network without features or relations between slots."""

NETWORKS: dict[str, dict[str, Any]] = {
    "flux": {"network": "flux"},
    "midiffusion": {"network": "midiffusion", "attention": "plain", "frequencies": 0, "empty_slots": "attended"},
    "diffuscene": {"network": "diffuscene", "attention": "plain", "frequencies": 0, "empty_slots": "attended"},
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
    return Row(f"{network}_{process}", {"process": process, **NETWORKS[network]})
