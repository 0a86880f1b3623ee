"""The precision table: one factor changed at a time, from the default and from the paper's setting."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from agents.configuration.composition import dotted_values
from agents.pretraining.settings import PretrainConfig
from benchmarks.paper_tables.rows import COSTS, PAPER, Entry, Row, Table, plain_row

_COLUMNS = (
    "height_errors",
    "overlap_median_mm",
    "deeper_than_1mm_fraction",
    "deeper_than_1cm_fraction",
    "feasible_fraction",
    "category_kl",
    "count_wasserstein",
    *COSTS,
)

Setting = tuple[str, dict[str, Any]]
"""Label of a line, and keys of ``pretrain``."""


def _each(title: str, key: str, *values: Any) -> list[Setting]:
    return [
        (f"{title} {value:g}" if isinstance(value, float) else f"{title} {value}", {key: value}) for value in values
    ]


def _predictions(weighting: str, note: str, *names: str) -> list[Setting]:
    return [(f"prediction {name}{note}", {"process.prediction": name, "loss.weighting": weighting}) for name in names]


def _categories(kernel: str, empty_slots: str, loss: str) -> dict[str, Any]:
    return {"process.kernel": kernel, "process.empty_slots": empty_slots, "loss.category": loss}


FACTORS: tuple[Setting, ...] = (
    *_predictions("none", "", "edm", "epsilon", "v", "x0"),
    *_predictions("min_snr", ", min-SNR", "epsilon", "v", "x0"),
    *_each("schedule", "process.schedule", "karras", "linear"),
    *_each("noise floor", "process.noise.floor", 0.01, 0.002, 0.0005),
    *_each("noise ceiling", "process.noise.ceiling", 20.0, 80.0),
    *_each("timesteps", "loss.timesteps", "lognormal", "uniform", "both"),
    *_each("moments per", "process.moments", "feature", "category"),
    *_each("translation weight", "loss.translation_weight", 1.0, 3.0),
    *_each("relations of slots, blurred by the noise of the", "network.modules.relations", "none", "largest", "axis"),
    *_each("Fourier octaves", "network.flux.frequencies", 0, 8),
    *_each("features of rotations", "network.modules.rotation_features", False, True),
    *_each("contacts", "network.modules.contacts", False, True),
    ("no learning-rate decay", {"optimizer.rate.final": 1.0}),
    ("learning rate decays from the warm-up on", {"optimizer.rate.decay": 1.0}),
    *_each("optimizer", "optimizer.name", "muon", "adamw"),
    *_each("empty slots", "process.empty_slots", "dropped", "attended"),
    ("categories: early absorbing, dropped, cross-entropy", _categories("early_absorbing", "dropped", "cross_entropy")),
    ("categories: absorbed along a square", _categories("squared_absorbing", "dropped", "cross_entropy")),
    ("categories: mask and replace, cross-entropy", _categories("mask_and_replace", "attended", "cross_entropy")),
    ("categories: early absorbing, bound", _categories("early_absorbing", "attended", "bound")),
)
"""Settings that the precision table changes, one at a time."""

_NEEDS = {
    "process.noise.floor": ("process.schedule", "karras"),
    "process.noise.ceiling": ("process.schedule", "karras"),
    "process.moments": ("process.prediction", "edm"),
    "network.modules.contacts": ("network.modules.relations", "axis"),
}
"""Keys that are read only where another key has a value."""


def one_factor_at_a_time(prefix: str, base: Mapping[str, Any], title: str) -> tuple[Entry, ...]:
    """``base``, then every setting of every factor that differs from it and that it reads, and two capacities."""
    standard = dotted_values(PretrainConfig())
    here, group = {**standard, **base}, f"from {title}"
    entries = [Entry(title, Row(prefix, base), group=group)]
    for label, keys in FACTORS:
        changed = {key: value for key, value in keys.items() if here[key] != value}
        if not changed or any(here[_NEEDS[key][0]] != _NEEDS[key][1] for key in keys if key in _NEEDS):
            continue
        if changed == {"process.empty_slots": "dropped"} and here["process.kernel"] == "mask_and_replace":
            continue
        name = "_".join([prefix, *(f"{key.rpartition('.')[2]}_{value}" for key, value in changed.items())])
        entries.append(Entry(label, Row(name, {**base, **changed}), group=group))
    for capacity, label in ((0.5, "half the parameters"), (2.0, "twice the parameters")):
        entries.append(Entry(label, Row(f"{prefix}_capacity_{capacity:g}", base, capacity), group=group))
    return tuple(entries)


def precision() -> Table:
    """Every factor, from the default and from the paper's setting."""
    ours = one_factor_at_a_time("flux_mixed", plain_row("flux", "mixed").overrides, "the default")
    paper = one_factor_at_a_time("paper", PAPER, "the paper's setting")
    return Table(
        "precision", "Precision",
        "Raw samples, no row projected or settled. Each line changes one thing of the first line of its part. Equal "
        "parameters (but for the two capacities), data and steps.",
        (*ours, *paper), _COLUMNS, ("feasible_fraction", "overlap_median_mm", "height_errors"),
    )  # fmt: skip
