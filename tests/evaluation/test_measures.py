"""Groups of measures and the real scenes they compare with."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from agents.cli.commands.evaluate import choose_measures
from agents.evaluation import grammar_scenes
from agents.evaluation.measure import MEASURES, EvaluationInputs, RealScenes, compute_measure
from scene_envs.datasets import SceneDataset, generate
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, register_scene_type, union_scene_type


def save(batch: SceneBatch, folder: Path) -> str:
    prompts = ["A scene with 1 object."] * len(batch)
    dataset = SceneDataset(batch.tensor, prompts, Normalizer.fit(batch.tensor), batch.scene_type)
    return str(dataset.save(folder))


def keys(batch: SceneBatch | None) -> set[bytes]:
    assert batch is not None
    return {scene.numpy().tobytes() for scene in batch.tensor}


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return grammar_scenes("dimsum_table", 40, seed=6)


def test_groups_are_chosen_by_name_in_their_order() -> None:
    assert choose_measures("all") == list(MEASURES)
    assert choose_measures("all", project=False) == [name for name in MEASURES if name != "ready"]
    assert choose_measures(["physics", "layout"]) == ["layout", "physics"]
    with pytest.raises(UnknownNameError, match="did you mean 'physics'"):
        choose_measures("phisics")


def test_samples_that_follow_every_prompt_score_as_real_scenes_do(scenes: SceneBatch) -> None:
    real = RealScenes(scenes[:12], scenes[12:24])
    figures = compute_measure("prompts", EvaluationInputs(scenes, real, follow=lambda prompts: real.floor))
    assert figures["prompt_following"] == figures["floor_prompt_following"] == 1.0
    assert figures["chance_prompt_following"] < 1.0


def test_fewer_prompts_than_samples_can_be_followed(scenes: SceneBatch) -> None:
    real = RealScenes(scenes[:12], scenes[12:24])
    inputs = EvaluationInputs(scenes, real, follow=lambda prompts: real.floor[: len(prompts)], prompts=6)
    figures = compute_measure("prompts", inputs)
    assert sum(figures[f"prompt_{kind}_number"] for kind in ("counts", "names", "relations")) == 6
    assert figures["prompt_following"] == figures["floor_prompt_following"] == 1.0


def test_samples_that_ignore_their_prompts_score_as_chance_does(scenes: SceneBatch) -> None:
    real = RealScenes(scenes[:20], scenes[20:])
    ignored = compute_measure("prompts", EvaluationInputs(scenes, real, follow=lambda prompts: real.reference))
    assert ignored["prompt_following"] < 0.5
    assert ignored["floor_prompt_following"] == 1.0


def test_novelty_of_copies_and_of_real_scenes(scenes: SceneBatch) -> None:
    real = RealScenes(scenes[:10], scenes[10:20], scenes[20:])
    copies = compute_measure("novelty", EvaluationInputs(scenes[20:30], real))
    assert copies["novelty"] == copies["nearest_training_cm"] == 0.0
    assert copies["copied_fraction"] == 1.0
    assert copies["floor_novelty"] == pytest.approx(1.0, abs=0.4)
    assert copies["floor_copied_fraction"] == 0.0


def test_the_parts_of_a_dataset_share_no_scene(scenes: SceneBatch, tmp_path: Path) -> None:
    repeated = SceneBatch.concatenate([scenes, scenes[:5]])  # the last scenes are also the first ones
    real = RealScenes.load(scenes.scene_type, 8, data=save(repeated, tmp_path / "data"))
    assert len(real.reference) == len(real.floor) == 8
    parts = [keys(real.reference), keys(real.floor), keys(real.training)]
    assert not parts[0] & parts[1]
    assert not (parts[0] | parts[1]) & parts[2]
    assert len(parts[2]) == len(scenes) - 16


def test_held_out_scenes_may_be_a_folder_of_their_own(scenes: SceneBatch, tmp_path: Path) -> None:
    data, held = save(scenes[:30], tmp_path / "data"), save(scenes[30:], tmp_path / "held")
    real = RealScenes.load(scenes.scene_type, 100, data=data, heldout=held, training=20)
    assert (len(real.reference), len(real.floor)) == (5, 5)
    assert real.training is not None
    assert len(real.training) == 20


@pytest.mark.slow
def test_a_union_takes_as_many_scenes_of_each_of_its_types(scenes: SceneBatch, tmp_path: Path) -> None:
    shelves = grammar_scenes("pantry_shelf", 12, seed=6)
    union = union_scene_type(["dimsum_table", "pantry_shelf"])
    folders = f"{save(scenes, tmp_path / 'a')},{save(shelves, tmp_path / 'b')}"
    real = RealScenes.load(union, 6, data=folders)
    assert real.reference.scene_type.name == "dimsum_table+pantry_shelf"
    assert sorted("cafe_table" in names for names in real.reference.names()) == [False] * 3 + [True] * 3


def test_too_few_held_out_scenes_are_refused(scenes: SceneBatch, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="at least 4 are needed"):
        RealScenes.load(get_scene_type("dimsum_table"), 8, data=save(scenes[:4], tmp_path / "few"))


def test_the_grammar_gives_two_different_sets() -> None:
    real = RealScenes.load(get_scene_type("dimsum_table"), 3)
    assert real.training is None
    assert not torch.equal(real.reference.tensor, real.floor.tensor)


def test_a_list_that_holds_all_is_all() -> None:
    assert choose_measures("all,layout") == choose_measures(["layout", "all"]) == choose_measures("all")


@pytest.mark.slow
def test_the_first_real_scenes_of_a_union_are_of_all_its_types(tmp_path: Path) -> None:
    for scene in ("dimsum_table", "pantry_shelf"):
        generate(scene, 16, tmp_path / scene, workers=0, verify=False, progress=False)
    union = register_scene_type(union_scene_type([get_scene_type(name) for name in ("dimsum_table", "pantry_shelf")]))
    real = RealScenes.load(union, 8, data=f"{tmp_path / 'dimsum_table'},{tmp_path / 'pantry_shelf'}")
    shelf = union.assets.index("shelf")
    for batch in (real.reference, real.floor):
        assert (batch.categories[:4] == shelf).any(dim=1).sum() == 2
        assert (batch.categories == shelf).any(dim=1).sum() == len(batch) / 2
