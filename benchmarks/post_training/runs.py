"""Training and measuring of one row by the commands ``post-train`` and ``evaluate``; results in folders are kept."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from agents.cli.main import main as scene_envs
from benchmarks.post_training.rows import Row
from scene_envs.errors import TrainingError

WINDOW = 20
"""Iterations whose mean reward counts as one value of a curve."""


def train(row: Row, directory: Path, iterations: int, extra: Sequence[str]) -> Path:
    """Post-train a row, or go on with it; a finished one is left as it is.

    Args:
        row: what is trained.
        directory: of all rows.
        iterations: of this run.
        extra: further keys of ``post-train`` for every row.

    Returns:
        The folder of the run.

    Raises:
        TrainingError: the command failed; its message stands above.
    """
    folder = directory / row.name
    if not (folder / "metrics.json").exists():
        _call(
            "post-train", "--allow-local", f"prior={row.prior}", *row.keys, f"iterations={iterations}",
            f"output={folder}", "progress=none", "logger.report_scenes=0", *extra,
        )  # fmt: skip
    return folder


def measure(
    prior: str, directory: Path, measures: Sequence[str], count: int, guidance: float = 0.0, extra: Sequence[str] = ()
) -> dict[str, float]:
    """Figures of ``evaluate`` for a prior, computed once for each folder; an interrupted evaluation goes on.

    Args:
        prior: a shipped name, or the folder of a run.
        directory: folder of the figures.
        measures: groups of figures.
        count: samples.
        guidance: weight of guidance of the samples with prompts.
        extra: further keys of ``evaluate``.
    """
    if not _measured(directory / "metrics.json", measures):
        names = ",".join(measures)
        _call(
            "evaluate", f"prior={prior}", f"measures=[{names}]", f"count={count}", f"guidance={guidance}",
            "physics_guidance=0", "workers=0", f"output={directory}", *extra,
        )  # fmt: skip
    return _numbers(json.loads((directory / "metrics.json").read_text(encoding="utf-8")))


def training_figures(folder: Path) -> dict[str, float]:
    """``first``, ``best``, ``last`` and ``fall`` of the reward's means over windows, and what the run cost.

    ``fall`` is the largest drop of a mean below the best one before it.
    """
    with (folder / "log.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    rewards = [float(row["reward"]) for row in rows]
    means = [
        sum(rewards[start : start + WINDOW]) / WINDOW for start in range(0, len(rewards) - WINDOW + 1, WINDOW)
    ]  # fmt: skip
    ratios = [float(row["guard_ratio"]) for row in rows if row.get("guard_ratio")]
    figures = {"iterations": float(len(rows)), "seconds": float(rows[-1]["seconds"])}
    if ratios:
        figures["loss"] = ratios[-1]
    if means:
        falls = [max(means[: index + 1]) - mean for index, mean in enumerate(means)]
        figures |= {"first": means[0], "best": max(means), "last": means[-1], "fall": max(falls)}
    return figures


def kept_loss(folder: Path) -> dict[str, float]:
    """Held-out loss of the kept prior over the base prior's, as ``loss``; empty without a guard."""
    guard = json.loads((folder / "metrics.json").read_text(encoding="utf-8")).get("guard") or {}
    return {"loss": float(guard["ratio"])} if guard.get("ratio") is not None else {}


def guard_figures(folder: Path) -> dict[str, float]:
    """Figures of the guard's samples at the base prior (``base_…``) and at the last check, and the iteration ``kept``.

    Empty without a guard that samples, or before the run ended.
    """
    path = folder / "metrics.json"
    guard = json.loads(path.read_text(encoding="utf-8")).get("guard") if path.exists() else None
    if not guard or not guard["checks"] or not guard["checks"][-1].get("samples"):
        return {}
    base, last = guard["base_samples"], guard["checks"][-1]["samples"]
    return {
        "base_reward": base["sample_reward"],
        "guard_reward": last["sample_reward"],
        "kept": float(guard["best_iteration"]),
        "guard_counts": last["count_distance"],
        "base_classifier": base["classifier_accuracy"],
        "guard_classifier": last["classifier_accuracy"],
    }


def _measured(path: Path, measures: Sequence[str]) -> bool:
    """Whether ``evaluate`` has written all of these groups of figures, or why a group is missing."""
    if not path.exists():
        return False
    evaluation = json.loads(path.read_text(encoding="utf-8")).get("evaluation", {})
    return set(measures) <= {*evaluation.get("groups", {}), *evaluation.get("left_out", {})}


def _numbers(metrics: Mapping[str, object]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items() if isinstance(value, int | float)}


def _call(*words: str) -> None:
    status = scene_envs(words)
    if status:
        raise TrainingError(f"scene-envs {' '.join(words)} ended with status {status}; its message stands above")
