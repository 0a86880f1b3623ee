"""Live progress of a run: reward, guard and time left, on a terminal or as lines."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any


class Progress:
    """Context manager that shows how a run goes.

    Args:
        title: what runs.
        total: iterations.
        style: ``"bar"`` (lines when the output is no terminal), ``"lines"`` or ``"none"``.
        done: iterations done before, by a resumed run.
    """

    def __init__(self, title: str, total: int, style: str, done: int = 0) -> None:
        self.title, self.total, self.first = title, total, done
        terminal = sys.stderr.isatty()
        self.style = "lines" if style == "bar" and not terminal else style
        self._bar: Any = None
        self._task: Any = None
        self._started = time.perf_counter()
        self._last_line = float("-inf")

    def __enter__(self) -> Progress:
        if self.style == "bar":
            self._bar = _make_bar()
            self._bar.start()
            self._task = self._bar.add_task(self.title, total=self.total, completed=self.first, reward="", guard="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()

    def update(self, done: int, reward: float, guard: float) -> None:
        """After ``done`` iterations: mean reward of the last batch, held-out loss over the base prior's."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, reward=f"{reward:.3g}", guard=f"{guard:.2f}")
        elif self.style == "lines":
            self._line(done, reward, guard)

    def _line(self, done: int, reward: float, guard: float) -> None:
        now = time.perf_counter()
        if now - self._last_line < 5.0 and done not in (self.first + 1, self.total):
            return
        self._last_line = now
        left = (now - self._started) / max(1, done - self.first) * (self.total - done)
        print(
            f"{self.title} {done}/{self.total}  reward {reward:.3g}  guard {guard:.2f}x  {left:.0f} s left",
            file=sys.stderr,
            flush=True,
        )


def _make_bar() -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    return RichProgress(
        TextColumn("[bold]{task.description}"),
        BarColumn(bar_width=None),
        MofNCompleteColumn(),
        TextColumn("reward [green]{task.fields[reward]}"),
        TextColumn("guard [yellow]{task.fields[guard]}x"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )
