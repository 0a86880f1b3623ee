"""Blank pictures and curves for runs whose pictures no test reads."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from PIL import Image


@pytest.fixture(autouse=True)
def _blank_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Curves and scenes of all runs but those of fixtures, whose pictures are looked at."""

    def blank(scene: object, state: object, path: Path) -> None:
        Image.new("L", (1, 1)).save(path)

    monkeypatch.setattr("agents.planning.search_run.draw_scene", blank)
    if "matplotlib.figure" in sys.modules:
        request.getfixturevalue("blank_curves")
