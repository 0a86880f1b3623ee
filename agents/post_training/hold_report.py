"""Report of the target that a run held: a sentence, and a picture of the measured value and of the weight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.post_training.curves import FAINT, GUARD_COLOR, REWARD_COLOR
from agents.post_training.hold import held_ratio
from agents.post_training.report import Picture, Section


def hold_sections(hold: Mapping[str, Any] | None, history: Sequence[Mapping[str, float]], path: Path) -> list[Section]:
    """A section on the target, with its picture written to ``path``; no section for a run without a target."""
    if hold is None or hold["measured"] is None:
        return []
    caption = "The held-out loss with its target, and the weight of the regularisation over its first value."
    picture = Picture(_draw(held_ratio(hold["target"]), history, path), caption)
    return [Section("What was held", hold["verdict"], [picture])]


def _draw(target: float, history: Sequence[Mapping[str, float]], path: Path) -> Path:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    measured = [(row["iteration"], row["guard_ratio"]) for row in history if "guard_ratio" in row]
    weights = [(row["iteration"], row["hold_factor"]) for row in history if "hold_factor" in row]
    figure = Figure(figsize=(8.4, 4.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(*zip(*measured, strict=True), ".-", color=GUARD_COLOR)
    upper.axhline(target, color=FAINT, linestyle="--", linewidth=1)
    upper.set_ylabel("held-out loss over base")
    lower.semilogy(*zip(*weights, strict=True), color=REWARD_COLOR)
    lower.set_ylabel("factor on the weight")
    lower.set_xlabel("iteration")
    for axes in (upper, lower):
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=9)
    figure.savefig(path)
    return path
