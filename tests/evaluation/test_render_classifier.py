"""The classifier of renders, on scenes that look the same or do not."""

from __future__ import annotations

import sys

import pytest
import torch

from agents.evaluation import grammar_scenes
from agents.evaluation.classifier import ClassifierConfig
from agents.evaluation.pictures import class_images, render_classifier_accuracy
from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.render import render
from scene_envs.render.stage import get_stage
from scene_envs.scene import SceneBatch

QUICK = ClassifierConfig(epochs=5, batch_size=16)
SIZE = {"width": 48, "height": 36}


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    pytest.importorskip("pybullet")
    return grammar_scenes("dimsum_table", 120, seed=6)


@pytest.mark.slow
def test_real_against_real_is_near_chance(scenes: SceneBatch) -> None:
    accuracy = render_classifier_accuracy(scenes[:60], scenes[60:], seeds=2, config=QUICK, **SIZE)
    assert accuracy.mean == pytest.approx(0.5, abs=0.2)  # 56 held-out renders a seed: 7 % standard error


@pytest.mark.slow
def test_missing_objects_are_seen(scenes: SceneBatch) -> None:
    bare = SceneBatch.empty("dimsum_table", 60).with_slots(scenes.tensor.shape[1])
    accuracy = render_classifier_accuracy(scenes[:60], bare, seeds=1, config=QUICK, **SIZE)
    assert accuracy.mean > 0.95


def test_class_images_are_the_renders(scenes: SceneBatch) -> None:
    index, colors = class_images([scenes[:2], scenes[2:3]], 48, 36)
    images = torch.from_numpy(render(scenes[:3], style="semantic", width=48, height=36)).long()
    assert index.shape == (3, 36, 48)
    assert int(index.max()) == colors - 1
    for value in range(colors):
        assert len(torch.unique(images[index == value], dim=0)) == 1


def test_without_pybullet_the_message_says_so(scenes: SceneBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    get_stage.cache_clear()
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingDependencyError, match="PyBullet"):
        render_classifier_accuracy(scenes[:20], scenes[20:40], seeds=1)
    get_stage.cache_clear()


def test_bad_input_is_refused(scenes: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="16 x 16"):
        render_classifier_accuracy(scenes, scenes, width=8)
    with pytest.raises(InvalidInputError, match="at least 20"):
        render_classifier_accuracy(scenes[:4], scenes)
