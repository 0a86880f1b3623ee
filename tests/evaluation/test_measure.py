"""The flat dict of figures on scenes with known answers, and measures of other packages."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from agents.cli.commands.evaluate import choose_measures
from agents.evaluation import evaluate, figure_table, grammar_scenes, measure_samples, stable_fraction
from agents.evaluation.measure import MEASURES, EvaluationInputs, RealScenes, compute_measure
from agents.evaluation.physics_figures import stability_figures
from agents.priors.testing import tiny_prior
from scene_envs.datasets import SceneDataset
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.physics import feasibility
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, union_scene_type
from tests.helpers.built_scenes import build


@pytest.fixture(scope="module")
def real() -> SceneBatch:
    return grammar_scenes("dimsum_table", 6, seed=1)


def lifted(batch: SceneBatch, by: float) -> SceneBatch:
    """All free objects ``by`` metres higher."""
    translations = batch.translations.clone()
    translations[..., 2] += by * batch.is_free
    return batch.with_poses(translations, batch.rotations)


def one_object(name: str, z: float) -> SceneBatch:
    return build([(name, 0.1, 0.1, z)])


def test_real_scenes_score_as_real(real: SceneBatch) -> None:
    figures = measure_samples(real, real, ready=False)
    assert figures["scenes"] == 6
    assert figures["objects_mean"] == pytest.approx(float(real.counts.double().mean()))
    assert figures["free_objects_mean"] == figures["objects_mean"] - 1  # the table
    assert (figures["objects_min"], figures["objects_max"]) == (int(real.counts.min()), int(real.counts.max()))
    assert figures["category_kl"] == figures["category_kl_e4"] == figures["count_wasserstein"] == 0.0
    assert figures["collision_rate"] == figures["out_of_workspace_rate"] == figures["duplicates"] == 0.0
    assert figures["median_total_penetration_cm"] == figures["median_total_pair_penetration_cm"] == 0.0
    assert figures["stable_fraction"] == 1.0
    assert figures["workspace_fraction"] == figures["feasible_fraction"] == 1.0
    assert figures["feasible_objects"] == figures["free_objects_mean"]
    assert figures["height_error_table_mm"] < 1e-3
    assert figures["height_error_stack_mm"] < 1e-3
    assert figures["deeper_than_1mm_fraction"] == figures["deeper_than_1cm_fraction"] == 0.0
    assert figures["invalid_fraction"] == 0.0


def test_scenes_two_millimetres_too_high_are_measured_as_such(real: SceneBatch) -> None:
    figures = measure_samples(lifted(real, 2e-3), real, ready=False)
    assert figures["height_error_table_mm"] == pytest.approx(2.0, abs=1e-3)
    assert figures["height_error_stack_mm"] == pytest.approx(0.0, abs=1e-3)
    assert figures["feasible_fraction"] == 0.0  # everything falls further than 1 mm
    assert figures["stable_fraction"] == 0.0
    assert figures["deeper_than_1mm_fraction"] == 0.0


def test_scenes_five_millimetres_into_the_table_overlap_by_that(real: SceneBatch) -> None:
    sunk = lifted(real, -5e-3)
    figures = measure_samples(sunk, real, ready=False)
    on_table = (sunk.is_free & (sunk.translations[..., 2] < 0)).sum() / sunk.is_free.sum()
    assert figures["height_error_table_mm"] == pytest.approx(5.0, abs=1e-3)
    assert figures["overlap_median_mm"] == pytest.approx(5.0, abs=0.05)
    assert figures["overlap_p95_mm"] == pytest.approx(5.0, abs=0.05)
    assert figures["deeper_than_1mm_fraction"] == pytest.approx(float(on_table))
    assert figures["deeper_than_1cm_fraction"] == 0.0
    assert figures["overlapping_pairs"] == pytest.approx(float(on_table * sunk.is_free.sum() / len(sunk)))


def test_the_deep_ones_are_counted_apart(real: SceneBatch) -> None:
    batch = SceneBatch.concatenate([one_object("teapot", -0.012), one_object("teapot", 0.0)])
    figures = measure_samples(batch, real, ready=False)
    assert figures["deeper_than_1mm_fraction"] == figures["deeper_than_1cm_fraction"] == 0.5
    assert figures["overlapping_pairs"] == 0.5
    assert figures["overlap_median_mm"] == pytest.approx(12.0, abs=0.05)
    assert figures["feasible_fraction"] == figures["feasible_objects"] == 0.5
    assert figures["collision_rate"] == 0.5
    assert figures["median_total_pair_penetration_cm"] == pytest.approx(0.6, abs=5e-3)  # half of 12 mm
    assert figures["median_total_penetration_cm"] >= figures["median_total_pair_penetration_cm"]
    assert "height_error_stack_mm" not in figures  # nothing is on a stack


def test_rooms_whose_tables_overlap_are_counted(real: SceneBatch) -> None:
    rooms = grammar_scenes("restaurant_low_clutter", 2, seed=1)
    assert measure_samples(rooms, rooms, ready=False)["furniture_collision_rate"] == 0.0
    first, second = rooms.is_furniture[1].nonzero().flatten()[:2].tolist()
    translations, rotations = rooms.translations.clone(), rooms.rotations.clone()
    translations[1, second], rotations[1, second] = translations[1, first] + 0.05, rotations[1, first]
    joined = measure_samples(rooms.with_poses(translations, rotations), rooms, ready=False)
    assert joined["furniture_collision_rate"] == 0.5
    assert "furniture_collision_rate" not in measure_samples(real, real, ready=False)


def test_ready_figures_are_those_after_projection_and_settling() -> None:
    reference = one_object("teapot", 0.0)
    figures = measure_samples(one_object("teapot", -4e-3), reference)
    assert figures["feasible_objects"] == 0.0
    assert figures["ready_objects"] == figures["ready_fraction"] == 1.0
    assert figures["ready_invalid_fraction"] == 0.0


def test_the_category_divergence_is_printed_in_ten_thousandths() -> None:
    figures = measure_samples(one_object("teapot", 0.0), one_object("teacup", 0.0), ready=False)
    assert figures["category_kl_e4"] == pytest.approx(1e4 * figures["category_kl"])
    table = figure_table(figures)
    assert "| category_kl_e4 |" in table
    assert "| category_kl |" not in table


def test_objects_outside_the_workspace_are_counted_among_free_ones(real: SceneBatch) -> None:
    moved = one_object("teapot", 0.0)
    translations = moved.translations.clone()
    translations[0, 1, 0] = 0.6
    figures = measure_samples(moved.with_poses(translations, moved.rotations), real, ready=False)
    assert figures["out_of_workspace_rate"] == 1.0
    assert figures["workspace_fraction"] == 0.5  # the table is in it


def test_overlap_does_not_make_an_object_unstable_that_does_not_move() -> None:
    raised = one_object("teapot", 0.5)
    figures = measure_samples(raised, raised, ready=False)
    assert figures["stable_fraction"] == 0.0  # it falls
    assert figures["collision_rate"] == 0.0


def test_the_floor_is_the_same_figures_of_real_scenes(real: SceneBatch) -> None:
    other = grammar_scenes("dimsum_table", 4, seed=2)
    figures = measure_samples(lifted(real, 2e-3), real, floor=other, ready=False)
    alone = measure_samples(other, real, ready=False)
    assert {k.removeprefix("floor_"): v for k, v in figures.items() if k.startswith("floor_")} == alone


def test_a_prior_is_measured_on_its_own_samples(real: SceneBatch) -> None:
    prior = tiny_prior(slots=6)
    figures = evaluate(prior, 3, real, num_steps=2, seed=5, ready=False)
    samples = prior.sample(3, num_steps=2, seed=5)
    assert figures["num_steps"] == 2
    assert figures["objects_mean"] == pytest.approx(float(samples.counts.double().mean()))
    assert figures["feasible_objects"] == pytest.approx(float(feasibility(samples).counts.double().mean()))
    assert all(isinstance(v, float) and math.isfinite(v) for v in figures.values())
    assert json.loads(json.dumps(figures)) == figures


def test_grammar_scenes_follow_their_seed() -> None:
    first, again, other = (grammar_scenes("dimsum_table", 2, seed=s) for s in (7, 7, 8))
    assert torch.equal(first.tensor, again.tensor)
    assert not torch.equal(first.tensor, other.tensor)


def test_table_lists_every_figure(real: SceneBatch) -> None:
    figures = measure_samples(real, real, ready=False)
    rows = figure_table(figures).splitlines()[2:]
    assert [row.split("|")[1].strip() for row in rows] == [name for name in figures if name != "category_kl"]
    assert all(row.split("|")[4].strip() for row in rows)  # each says how to read it


def test_nothing_to_measure_is_refused(real: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="cannot measure 0 scenes against 6"):
        measure_samples(real[:0], real)


def test_what_is_centimetres_deep_is_not_stable() -> None:
    for depth, stable in ((0.0, 1.0), (0.02, 0.0)):
        assert stable_fraction(one_object("teapot", -depth)) == stable


def test_what_falls_less_than_a_centimetre_in_two_seconds_is_stable_as_the_literature_counts() -> None:
    heights = (0.0, 0.008, 0.5)  # at rest; falls 8 mm onto its foot; falls half a metre
    batch = build(*[[("teapot", 0.1, 0.1, height)] for height in heights])
    shares = [stability_figures(batch[row])["stable_2s_fraction"] for row in range(3)]
    assert shares == [1.0, 1.0, 0.0]
    assert stability_figures(batch) == {"stable_2s_invalid_fraction": 0.0, "stable_2s_fraction": pytest.approx(2 / 3)}
    assert stability_figures(SceneBatch.empty("dimsum_table", 1)) == {"stable_2s_invalid_fraction": 0.0}


def test_two_of_three_objects_collide_in_one_of_two_scenes() -> None:
    apart = [("teapot", 0.1, 0.1, 0.0), ("teapot", -0.2, 0.1, 0.0), ("teapot", -0.2, -0.2, 0.0)]
    figures = measure_samples(build(apart, [*apart[:2], ("teapot", -0.19, 0.1, 0.0)]), build(apart), ready=False)
    assert figures["collision_rate"] == 1 / 2  # colliding scenes
    assert figures["deeper_than_1mm_fraction"] == 2 / 6  # colliding objects


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
def test_a_union_takes_as_many_scenes_of_each_of_its_types_in_turn(scenes: SceneBatch, tmp_path: Path) -> None:
    shelves = grammar_scenes("pantry_shelf", 8, seed=6)
    union = union_scene_type(["dimsum_table", "pantry_shelf"])
    folders = f"{save(scenes, tmp_path / 'a')},{save(shelves, tmp_path / 'b')}"
    real = RealScenes.load(union, 6, data=folders)
    assert real.reference.scene_type.name == "dimsum_table+pantry_shelf"
    on_table = ["cafe_table" in names for names in real.reference.names()]
    assert sum(on_table) == 3
    assert sum(on_table[:4]) == 2  # in turn, so that the first scenes are of all types


def test_too_few_held_out_scenes_are_refused(scenes: SceneBatch, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="at least 4 are needed"):
        RealScenes.load(get_scene_type("dimsum_table"), 8, data=save(scenes[:4], tmp_path / "few"))


def test_the_grammar_gives_two_different_sets() -> None:
    real = RealScenes.load(get_scene_type("dimsum_table"), 3)
    assert real.training is None
    assert not torch.equal(real.reference.tensor, real.floor.tensor)


def test_a_list_that_holds_all_is_all() -> None:
    assert choose_measures(["layout", "all"]) == choose_measures("all")
