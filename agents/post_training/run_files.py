"""Names of the files of a run, its curve, and its progress on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from scene_envs.progress import Progress

CHECKPOINT_NAME = "checkpoint.pt"
METRICS_NAME = "metrics.json"
SCENES_NAME = "real_scenes.safetensors"
BASE_SAMPLES_NAME = "base_samples.safetensors"

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
    """Draw reward and guard over iterations as a PNG. ``history`` has ``iteration``, ``reward``, ``reward_std`` and, at
    checks, ``guard_ratio``, whose ``limit`` is a line; diamonds are rewards of the guard's samples. The picture is
    shaded from iteration ``beyond``, the first beyond a limit; ``highest`` bounds the band of the standard deviation.
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
    upper.fill_between(
        iteration, reward - spread, np.clip(reward + spread, None, highest), color=REWARD_COLOR, alpha=0.12, linewidth=0
    )
    upper.plot(iteration, reward, color=REWARD_COLOR, alpha=0.35, linewidth=1, label="a batch ± std")
    upper.plot(iteration, _smooth(reward), color=REWARD_COLOR, linewidth=2.2, label="smoothed")
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


def _smooth(values: np.ndarray, half: int = 4) -> np.ndarray:
    """Centred moving average over finite values, ``half`` to each side; the window shrinks at the ends."""
    parts = [values[max(0, i - half) : i + half + 1] for i in range(len(values))]
    return np.array([np.nanmean(part) if np.isfinite(part).any() else np.nan for part in parts])


@contextmanager
def run_progress(
    title: str, total: int, style: str, done: int = 0, after: float = 0.0
) -> Iterator[Callable[[int, float, float], None]]:
    """Show the progress of a run; yields the function that advances it, which takes the number of iterations done, the
    last batch's mean reward, and the held-out loss divided by the base prior's. ``style`` is ``"bar"`` (lines when
    stderr is no terminal), ``"lines"`` (after the first iteration, every 5 s and at the end) or ``"none"``.
    The time left includes work ``after`` the run that takes as long as so many iterations.
    """
    with Progress(title, total, done=done, style=style, every=5.0, always=(done + 1, total)) as progress:

        def update(iteration: int, reward: float, guard: float) -> None:
            left = progress.seconds / max(1, iteration - done) * (total - iteration + after)
            line = f"{title} {iteration}/{total}  reward {reward:.3g}  guard {guard:.2f}x  {left:.0f} s left"
            progress.update(iteration, f"reward [green]{reward:.3g}[/]  guard [yellow]{guard:.2f}x[/]", line)

        yield update
