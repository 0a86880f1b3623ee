"""Fixtures that several folders of tests share."""

from __future__ import annotations

import pytest


@pytest.fixture
def few_grammar_scenes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run on ``data=grammar`` draws 32 scenes for its moments and its vocabulary, and holds 32 out."""
    monkeypatch.setattr("agents.pretraining.setup._SAMPLE", 32)
    monkeypatch.setattr("agents.pretraining.setup._HELD_OUT", 32)
