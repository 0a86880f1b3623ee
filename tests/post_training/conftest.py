"""Shared data of small runs: real scenes of a grammar, and blank curves where no test reads them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from scene_envs.render import Pinhole
from tests.helpers.small_runs import one_quick_classifier, scenes_drawn_once


@pytest.fixture(autouse=True)
def _blank_curves(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures of runs are blank, but for the one file that looks at them."""
    if request.module.__name__.rpartition(".")[2] == "test_report":
        return
    request.getfixturevalue("blank_curves")
    monkeypatch.setattr("agents.post_training.trainer.draw_curve", _blank)


@pytest.fixture(autouse=True)
def _blank_scenes(request: pytest.FixtureRequest, _coarse_pictures: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scenes of reports are blank, but for those of the demonstration."""
    if "demonstration" not in request.node.name:
        monkeypatch.setattr("scene_envs.render.pictures.draw_picture", _blank_picture)


def _blank_picture(stage: object, camera: Pinhole, *scene: object) -> NDArray[np.uint8]:
    return np.zeros((camera.height, camera.width, 3), np.uint8)


def _blank(history: object, path: Path, **_: object) -> Path:
    Image.new("L", (1, 1)).save(path)
    return path


@pytest.fixture(autouse=True)
def _one_quick_classifier() -> Iterator[None]:
    with one_quick_classifier():
        yield


@pytest.fixture(autouse=True)
def _scenes_drawn_once() -> Iterator[None]:
    with scenes_drawn_once():
        yield
