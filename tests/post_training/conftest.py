"""Shared data of small runs: real scenes of a grammar, and blank curves where no test reads them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from agents.post_training import real_scenes as scene_bank
from agents.priors.prior import ScenePrior
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import one_quick_classifier

_DRAWN: dict[tuple[Any, ...], SceneBatch] = {}


@pytest.fixture(autouse=True)
def _blank_curves(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of runs are blank, but for the one file that looks at them."""
    if request.module.__name__.rpartition(".")[2] == "test_report":
        return
    request.getfixturevalue("blank_curves")
    monkeypatch.setattr("agents.post_training.trainer.draw_curve", _blank)


def _blank(history: object, path: Path, **_: object) -> Path:
    Image.new("L", (1, 1)).save(path)
    return path


@pytest.fixture(autouse=True)
def _one_quick_classifier() -> Iterator[None]:
    with one_quick_classifier():
        yield


@pytest.fixture(autouse=True)
def _scenes_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same scenes of a grammar, which take longer than an iteration, are drawn once per process."""
    draw = scene_bank.real_scenes

    def once(
        prior: ScenePrior, source: str, count: int, *, seed: int, slots: int | None = None, progress: str = "none"
    ) -> tuple[Any, Any]:
        if source != "grammar":
            return draw(prior, source, count, seed=seed, slots=slots)
        key = (prior.scene_type, prior.config.slots, count, seed, slots)
        if key not in _DRAWN:
            _DRAWN[key], _ = draw(prior, source, count, seed=seed, slots=slots)
        return SceneBatch(_DRAWN[key].tensor.clone(), prior.scene_type), None

    monkeypatch.setattr(scene_bank, "real_scenes", once)
