"""Picture of the reward and guard curves of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

REWARD_COLOR, GUARD_COLOR, FAINT = "#0f766e", "#b45309", "#99a3ad"


def draw_curve(
    history: Sequence[Mapping[str, float]],
    path: Path,
    *,
    reward_name: str,
    limit: float | None = None,
    beyond: int | None = None,
    highest: float | None = None,
) -> Path:
    """Draw reward and guard over iterations as a PNG; diamonds are the rewards of the guard's samples.

    Args:
        history: rows with ``iteration``, ``reward``, ``reward_std`` and, at checks, ``guard_ratio``.
        path: image file to write.
        reward_name: label of the upper axis.
        limit: limit of the guard's loss, drawn as a line.
        beyond: iteration from which the run is over-optimised; the picture is shaded from there.
        highest: largest possible reward, which bounds the band of the standard deviation; None for no bound.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    iteration = np.array([row["iteration"] for row in history])
    reward = np.array([row["reward"] for row in history], dtype=float)
    spread = np.array([row["reward_std"] for row in history], dtype=float)
    checks = [(row["iteration"], row["guard_ratio"]) for row in history if "guard_ratio" in row]
    figure = Figure(figsize=(8.4, 5.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.4, 1.0))
    upper.fill_between(iteration, *band(reward, spread, highest), color=REWARD_COLOR, alpha=0.12, linewidth=0)
    upper.plot(iteration, reward, color=REWARD_COLOR, alpha=0.35, linewidth=1, label="a batch ± std")
    upper.plot(iteration, smooth(reward), color=REWARD_COLOR, linewidth=2.2, label="smoothed")
    sampled = [(row["iteration"], row["guard_sample_reward"]) for row in history if "guard_sample_reward" in row]
    if sampled:
        upper.plot(*zip(*sampled, strict=True), "D", color=GUARD_COLOR, markersize=5, label="samples of the guard")
    upper.legend(frameon=False, fontsize=8)
    upper.set_ylabel(reward_name)
    if checks:
        lower.plot([0, *(x for x, _ in checks)], [1.0, *(y for _, y in checks)], "o-", color=GUARD_COLOR, markersize=4)
    if limit is not None:
        lower.axhline(limit, color=FAINT, linestyle="--", linewidth=1)
        lower.text(1.0, limit, f" limit {limit:g}×", color=FAINT, va="bottom", ha="right", fontsize=8,
                   transform=lower.get_yaxis_transform())  # fmt: skip
    lower.set_ylabel("held-out loss\nover base")
    lower.set_xlabel("iteration")
    lower.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (upper, lower):
        if beyond is not None and len(iteration):
            axes.axvspan(beyond, max(iteration[-1], beyond + 0.5), color=GUARD_COLOR, alpha=0.08, linewidth=0)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="y", color="#e8ebee", linewidth=0.8)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=9)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    return path


def band(reward: np.ndarray, spread: np.ndarray, highest: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Reward minus and plus its standard deviation; the sum is at most ``highest``, the largest possible reward.

    >>> low, high = band(np.array([0.9, 0.5]), np.array([0.2, 0.3]), highest=1.0)
    >>> low.round(2).tolist(), high.round(2).tolist()
    ([0.7, 0.2], [1.0, 0.8])
    """
    return reward - spread, np.clip(reward + spread, None, highest)


def smooth(values: np.ndarray, window: int = 9) -> np.ndarray:
    """Centred moving average over finite values, of the same length; the window shrinks at the ends.

    >>> smooth(np.array([1.0, 2.0, 6.0]), window=3).tolist()
    [1.5, 3.0, 4.0]
    """
    half = window // 2
    parts = [values[max(0, i - half) : i + half + 1] for i in range(len(values))]
    return np.array([np.nanmean(part) if np.isfinite(part).any() else np.nan for part in parts])
