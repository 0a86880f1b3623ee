"""The guard's part of a report: verdict, figures and samples."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from agents.post_training.report import Picture, Section

_LABELS = {
    "loss": "held-out loss",
    "sample_reward": "mean reward",
    "count_distance": "distance of object counts (Wasserstein-1)",
    "stack_distance": "distance of the tallest stacks (Wasserstein-1)",
    "category_kl": "KL divergence of categories (nats)",
    "classifier_accuracy": "accuracy of a classifier, samples against real scenes",
}
"""Labels of the figures of a check on the page."""


def guard_verdict(guard: Mapping[str, Any]) -> str:
    """Result of the guard, in one sentence."""
    over = guard["over_optimised_from"]
    if over is None:
        return "The guard found nothing beyond its limits."
    found = next(check for check in guard["checks"] if check["iteration"] == over)
    names = " and ".join(_LABELS.get(name, name) for name in found["beyond"])
    return f"At iteration {over} the {names} passed the limit: the run is over-optimised from there."


def guard_sections(guard: Mapping[str, Any], pictures: Mapping[str, Path]) -> list[Section]:
    """The guard's samples: a table, and pictures for the best checkpoint and for the first check beyond a limit."""
    base = guard["base_samples"]
    if not base:
        return []
    sampled = [check for check in guard["checks"] if check["samples"]]
    best = next((check["samples"] for check in sampled if check["iteration"] == guard["best_iteration"]), base)
    last = sampled[-1]["samples"] if sampled else base
    rows: list[tuple[str, ...]] = [("", "base prior", "kept prior", "last check", "limit")]
    for name, label in _LABELS.items():
        if name in base:
            limit = guard["sample_limits"].get(name)
            largest = "none" if limit is None else f"{base[name] + limit:.3g}"
            rows.append((label, *(f"{figures[name]:.3g}" for figures in (base, best, last)), largest))
    within, beyond = pictures.get("guard_within"), pictures.get("guard_beyond")
    shown = [Picture(within, "Of the prior kept")] if within else []
    shown += [Picture(beyond, "Of the first check beyond a limit")] if beyond else []
    text = "Each check sampled from the same noise, and compared the samples with held-out real scenes."
    return [Section("What the guard sampled", text, shown, table=rows)]
