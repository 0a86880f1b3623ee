"""Progress on a terminal and in a log file."""

from __future__ import annotations

import io
import sys

import pytest

from agents.post_training.run_files import run_progress
from scene_envs.errors import UnknownNameError
from scene_envs.progress import Progress


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True


def written(monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, style: str, every: float = 1e9) -> str:
    """What four of ten updates write to stderr; a line is always due at the first and the fourth."""
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    with Progress("Baking", 10, style=style, every=every, always=(1, 4)) as progress:
        for done in range(1, 5):
            progress.update(done, f"[bold]{done}[/] loaves", f"{done} of 10 [loaves]")
    return stream.getvalue()


@pytest.mark.parametrize("style", ["bar", "lines"])
def test_a_log_file_gets_lines_and_no_bar(monkeypatch: pytest.MonkeyPatch, style: str) -> None:
    assert written(monkeypatch, io.StringIO(), style).splitlines() == ["1 of 10 [loaves]", "4 of 10 [loaves]"]
    assert len(written(monkeypatch, io.StringIO(), style, every=0.0).splitlines()) == 4


def test_a_terminal_gets_a_bar_and_no_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    text = written(monkeypatch, Terminal(), "bar")
    assert "Baking" in text
    assert "4/10" in text
    assert "of 10 [loaves]" not in text


def test_nothing_is_shown_where_nothing_is_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert written(monkeypatch, io.StringIO(), "none", every=0.0) == ""
    assert written(monkeypatch, Terminal(), "none", every=0.0) == ""
    with pytest.raises(UnknownNameError, match="'lines'"):
        Progress("Baking", 10, style="line")


def test_a_run_says_its_reward_and_guard_at_its_first_and_last_iteration(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with run_progress("post-train tea", 5, "bar", done=2) as report:
        for iteration in (3, 4, 5):
            report(iteration, 1.5 * iteration, 1.02)
    first, last = stream.getvalue().splitlines()
    assert first.startswith("post-train tea 3/5  reward 4.5  guard 1.02x  ")
    assert last == "post-train tea 5/5  reward 7.5  guard 1.02x  0 s left"


def test_the_time_left_of_a_run_includes_the_report(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with run_progress("post-train tea", 2, "lines", after=6.0) as report:
        monkeypatch.setattr(Progress, "seconds", 10.0)
        report(1, 1.0, 1.0)
        report(2, 1.0, 1.0)
    left = [line.rsplit("  ", 1)[1] for line in stream.getvalue().splitlines()]
    assert left == ["70 s left", "30 s left"]  # 10 s an iteration, then 5 s: one more and six, then six
