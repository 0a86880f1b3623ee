"""How far a generation is: a live bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter

Report = Callable[[int, int, dict[str, int]], None]
"""Called with (scenes kept, scenes tried, reasons) since the last call."""

_EVERY = 30.0
"""Seconds between lines where there is no terminal."""


@contextmanager
def generation_progress(title: str, done: int, count: int, show: bool) -> Iterator[Report]:
    """A live bar with scenes/s and the most frequent reasons; yields the function that advances it.

    On a terminal the bar stands on stderr; elsewhere (a log file) a line is printed every 30 s.

    Args:
        title: what is made.
        done: scenes that are there already.
        count: scenes that are wanted.
        show: whether to show anything.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]:.1f} scenes/s"),
        TimeRemainingColumn(),
        TextColumn("[dim]{task.fields[reasons]}"),
    )
    console = Console(stderr=True)
    live = show and console.is_terminal
    totals: Counter[str] = Counter()
    kept, start = 0, perf_counter()
    said = start
    with Progress(*columns, console=console, disable=not live, speed_estimate_period=120) as bar:
        task = bar.add_task(title, total=count, completed=done, rate=0.0, reasons="")

        def report(fresh: int, tried: int, reasons: dict[str, int]) -> None:
            nonlocal kept, said
            kept += fresh
            totals.update(reasons)
            now = perf_counter()
            rate = kept / max(now - start, 1e-9)
            dropped = ", ".join(f"{name} {number}" for name, number in totals.most_common(3))
            bar.update(task, advance=fresh, rate=rate, reasons=dropped)
            if show and not live and now - said >= _EVERY:
                said = now
                text = f"{title}: {done + kept}/{count}, {rate:.1f} scenes/s"
                console.print(f"{text}, {dropped}" if dropped else text, highlight=False, soft_wrap=True)

        yield report
        bar.update(task, completed=count)
