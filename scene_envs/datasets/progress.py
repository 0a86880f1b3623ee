"""Progress of a generation: scenes per second, and reasons for dropped scenes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from scene_envs.progress import Progress

Report = Callable[[int, int, dict[str, int]], None]
"""Called with (scenes kept, scenes tried, reasons) since the last call."""

_EVERY = 30.0
"""Seconds between lines where there is no terminal."""


@contextmanager
def generation_progress(title: str, done: int, count: int, show: bool) -> Iterator[Report]:
    """A live bar with scenes/s and the most frequent reasons; yields the function that advances it.

    On a terminal the bar is on stderr; elsewhere (a log file) a line is printed every 30 s.

    Args:
        title: Title of the bar.
        done: Number of scenes that exist already.
        count: Number of requested scenes.
        show: Whether to show anything.
    """
    totals: Counter[str] = Counter()
    kept = 0
    with Progress(title, count, done=done, style="bar" if show else "none", every=_EVERY) as progress:

        def report(fresh: int, tried: int, reasons: dict[str, int]) -> None:
            nonlocal kept
            kept += fresh
            totals.update(reasons)
            rate = f"{kept / max(progress.seconds, 1e-9):.1f} scenes/s"
            dropped = ", ".join(f"{name} {number}" for name, number in totals.most_common(3))
            line = f"{title}: {done + kept}/{count}, {rate}"
            progress.update(done + kept, f"{rate} [dim]{dropped}", f"{line}, {dropped}" if dropped else line)

        yield report
        progress.update(count, f"{kept / max(progress.seconds, 1e-9):.1f} scenes/s")
