"""A current folder whose files have the names of modules."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def trapped(folder: Path) -> Iterator[None]:
    """``folder`` is the current one, and no process that starts meanwhile may import what its files look like."""
    sprung = folder / "sprung"
    for name in ("scene_envs", "rewards", "numpy", "torch", "runpy", "signal"):
        (folder / f"{name}.py").write_text(f"open({str(sprung)!r}, 'w')\nraise SystemExit('trap')\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [entry for entry in sys.path if entry])
        yield
    assert not sprung.exists()
