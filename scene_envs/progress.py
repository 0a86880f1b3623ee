"""Words on the terminal: the progress of long work on stderr, a bar or lines; PyBullet without its message."""

from __future__ import annotations

import os
import sys
from collections.abc import Collection
from time import perf_counter
from typing import Any

from scene_envs.errors import MissingDependencyError, unknown_name

STYLES = ("bar", "lines", "none")
"""Styles of progress; where there is no terminal, a bar becomes lines."""


class Progress:
    """Context manager that shows the progress of work of ``total`` items, of which ``done`` were done before.

    ``style`` is ``"bar"`` (lines where stderr is no terminal), ``"lines"`` (one per ``every`` seconds, and ``always``
    at these numbers of items) or ``"none"``.

    >>> with Progress("Counting", 3, style="none") as progress:
    ...     progress.update(3, "all of them")
    """

    def __init__(
        self,
        title: str,
        total: int,
        *,
        done: int = 0,
        style: str = "bar",
        every: float = 5.0,
        always: Collection[int] = (),
    ) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.progress import Progress as Bar

        if style not in STYLES:
            raise unknown_name("progress", style, STYLES)
        self.total, self.every, self.always = total, every, always
        self._console = Console(stderr=True)
        live = style == "bar" and self._console.is_terminal
        self._prints = style != "none" and not live
        self._bar = Bar(
            TextColumn("[bold]{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not live,
            speed_estimate_period=120,
        )
        self._task = self._bar.add_task(title, total=total, completed=done, text="")
        self._started = self._printed = perf_counter()

    def __enter__(self) -> Progress:
        self._bar.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._bar.stop()

    @property
    def seconds(self) -> float:
        """Seconds since this object was made."""
        return perf_counter() - self._started

    def update(self, done: int, text: str, line: str = "") -> None:
        """Show that ``done`` of the total are done: ``text`` (rich markup) after the bar, or ``line`` without a bar."""
        self._bar.update(self._task, completed=done, text=text)
        now = perf_counter()
        if self._prints and line and (now - self._printed >= self.every or done in self.always):
            self._printed = now
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)


def quiet_pybullet(otherwise: str) -> Any:
    """The module pybullet, imported without its message; MissingDependencyError with the text ``otherwise``."""
    sys.stdout.flush()
    sys.stderr.flush()
    kept = os.dup(1), os.dup(2)
    try:
        with open(os.devnull, "w") as sink:
            os.dup2(sink.fileno(), 1)
            os.dup2(sink.fileno(), 2)
        import pybullet
    except ImportError as error:
        raise MissingDependencyError(otherwise) from error
    finally:
        for copy, descriptor in zip(kept, (1, 2), strict=True):
            os.dup2(copy, descriptor)
            os.close(copy)
    return pybullet
