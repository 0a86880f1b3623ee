"""Fixtures that several folders of tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image


@pytest.fixture
def few_grammar_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run on ``data=grammar`` draws 32 scenes for its moments and its vocabulary, and holds 32 out."""
    monkeypatch.setattr("agents.pretraining.setup._SAMPLE", 32)
    monkeypatch.setattr("agents.pretraining.setup._HELD_OUT", 32)


@pytest.fixture
def blank_curves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Curves of runs are composed and not rastered, which is half of a small run's time; a blank PNG is written."""

    def blank(figure: object, path: Path) -> None:
        Image.new("L", (1, 1)).save(path)

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", blank)
