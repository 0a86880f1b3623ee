"""Ranges of generated numbers, and the physics that keeps or drops a generated scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from scene_envs.datasets import SceneDataset
from scene_envs.datasets.generation import fixed_normalizer, judge_scenes
from scene_envs.grammars import get_grammar, register_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.toy_grammars import TYPE, ToyGrammar, generate_cups


def test_the_normalizer_is_fixed_by_the_grammar_and_fills_the_range(cups: Path) -> None:
    normalizer = fixed_normalizer(ToyGrammar())
    dataset = SceneDataset.load(cups)
    assert torch.equal(normalizer.scale, dataset.normalizer.scale)
    assert normalizer.input_min[:2].tolist() == pytest.approx([-0.4, -0.4])
    assert normalizer.input_max[:2].tolist() == pytest.approx([0.4, 0.4])
    assert normalizer.is_constant.nonzero().flatten().tolist() == [2, 5, 8, 9, 10]  # height, and the tilt
    normalised = normalizer.normalize(dataset.tensor)
    assert normalised.abs().max() <= 1.0
    assert set(normalised[..., 11:].unique().tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize("lean", [1.0, 0.003])
def test_rotations_take_the_full_range_when_any_object_leans(lean: float) -> None:
    """A cup in 300 leans: enough for all entries to vary, by its lean about one axis or any other."""
    normalizer = fixed_normalizer(ToyGrammar(lean=lean))
    assert normalizer.input_min[3:12].tolist() == [-1.0] * 9
    assert normalizer.input_max[3:12].tolist() == [1.0] * 9
    leaning = SceneBatch(torch.from_numpy(ToyGrammar(lean=1.0).sample_array(np.random.default_rng(0), 20)), TYPE)
    torch.testing.assert_close(normalizer.unnormalize(normalizer.normalize(leaning.tensor)), leaning.tensor)


def test_a_scene_that_the_normalizer_cannot_hold_is_thrown_away_and_counted(tmp_path: Path) -> None:
    generate_cups(tmp_path, count=1, verify=False)  # its normalizer knows upright cups alone
    (tmp_path / "scenes-00000.parquet").unlink()
    register_grammar("toy_cups")(lambda: ToyGrammar(lean=0.5))
    report = generate_cups(tmp_path, count=1, verify=False)
    assert report.tried == 1 + report.reasons.get("outside the normalizer", 0)
    loaded = SceneDataset.load(tmp_path).tensor
    assert (loaded[:, :, 11] > 0.999).any(dim=1).all()
    assert loaded[..., [5, 8, 9, 10]].abs().max() == 0.0


def test_objects_welded_at_generated_poses_are_normalised_like_any_other() -> None:
    """Tables of a room stand anywhere in its workspace, turned about z."""

    class Room(ToyGrammar):
        def sample_array(self, rng: np.random.Generator, count: int) -> np.ndarray:
            scenes = super().sample_array(rng, count)
            scenes[:, 4] = 0.0
            scenes[:, 4, :3] = rng.uniform([-0.4, -0.4, 0.0], [0.4, 0.4, 0.0], (count, 3))
            angle = rng.uniform(0, 2 * np.pi, count)
            scenes[:, 4, [3, 7]], scenes[:, 4, 4], scenes[:, 4, 6] = (
                np.cos(angle)[:, None],
                -np.sin(angle),
                np.sin(angle),
            )
            scenes[:, 4, 11] = scenes[:, 4, 12] = 1.0
            return scenes

    room = Room()
    normalizer = fixed_normalizer(room)  # type: ignore[arg-type]
    scenes = torch.from_numpy(room.sample_array(np.random.default_rng(1), 100)).float()
    assert normalizer.normalize(scenes).abs().max() <= 1.0
    torch.testing.assert_close(normalizer.unnormalize(normalizer.normalize(scenes)), scenes)


def test_verification_keeps_grammar_scenes_and_drops_broken_ones_with_reasons() -> None:
    good = get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)
    tensor = good.tensor.clone()
    tensor[1, 1, 0] = 3.0  # off the table
    tensor[2, 2, :3] = tensor[2, 1, :3]  # one object inside another
    tensor[3, 1, 2] = 0.3  # in the air: it falls
    verdicts = judge_scenes(SceneBatch(tensor, good.scene_type))
    assert verdicts == ["", "outside workspace", "penetration", "moved while settling", "", ""]
