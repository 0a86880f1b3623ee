"""Live progress of a run: reward, guard and time left, on a terminal or as lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from scene_envs.progress import Progress


@contextmanager
def run_progress(title: str, total: int, style: str, done: int = 0) -> Iterator[Callable[[int, float, float], None]]:
    """Show the progress of a run; yields the function that advances it.

    The function takes the number of iterations done, the mean reward of the last batch, and the held-out loss divided
    by that of the base prior. Lines are printed after the first iteration, every 5 s and at the end.

    Args:
        title: name of the run.
        total: number of iterations.
        style: ``"bar"`` (lines when stderr is no terminal), ``"lines"`` or ``"none"``.
        done: number of iterations before the run was resumed.
    """
    with Progress(title, total, done=done, style=style, every=5.0, always=(done + 1, total)) as progress:

        def update(iteration: int, reward: float, guard: float) -> None:
            left = progress.seconds / max(1, iteration - done) * (total - iteration)
            line = f"{title} {iteration}/{total}  reward {reward:.3g}  guard {guard:.2f}x  {left:.0f} s left"
            progress.update(iteration, f"reward [green]{reward:.3g}[/]  guard [yellow]{guard:.2f}x[/]", line)

        yield update
