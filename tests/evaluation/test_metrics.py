"""Metrics on scenes built so that every figure is known in closed form."""

from __future__ import annotations

import math

import pytest
import torch

from agents.evaluation import grammar_scenes
from agents.evaluation.layouts import (
    KL_EPS,
    Support,
    category_kl,
    count_wasserstein,
    height_errors,
    workspace_fraction,
)
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from tests.helpers.built_scenes import DIMSUM, build


def raised(batch: SceneBatch, by: float, *, only: tuple[str, ...] | None = None) -> SceneBatch:
    translations = batch.translations.clone()
    names = DIMSUM.assets if only is None else only
    moved = torch.isin(batch.categories, torch.tensor([DIMSUM.assets.index(n) for n in names])) & batch.is_free
    translations[..., 2] += by * moved
    return batch.with_poses(translations, batch.rotations)


TOWER = [
    ("steamer_bottom", 0.1, 0.1, 0.0),
    ("steamer_bottom", 0.1, 0.1, 0.091),
    ("steamer_lid", 0.1, 0.1, 0.182),
    ("teacup", -0.3, 0.0, 0.0),
]


def test_category_kl_is_the_closed_form() -> None:
    reference = build([("teacup", 0, 0, 0)] * 3 + [("teapot", 0, 0, 0)])  # table .2, cup .6, pot .2
    samples = build([("teacup", 0, 0, 0)] + [("teapot", 0, 0, 0)] * 2)  # table .25, cup .25, pot .5
    shares = [(0.2, 0.25), (0.6, 0.25), (0.2, 0.5)] + [(0.0, 0.0)] * 4
    norm = 1 + 7 * KL_EPS
    expected = sum((p + KL_EPS) / norm * math.log((p + KL_EPS) / (q + KL_EPS)) for p, q in shares)
    assert category_kl(samples, reference) == pytest.approx(expected, rel=1e-9)
    assert category_kl(reference, reference) == 0.0


def test_category_kl_punishes_a_missing_asset_and_stays_finite() -> None:
    reference, samples = build([("teacup", 0, 0, 0)]), build([("teapot", 0, 0, 0)])
    assert category_kl(samples, reference) == pytest.approx(0.5 * math.log(0.5 / KL_EPS), rel=1e-3)


def test_empty_slots_do_not_count() -> None:
    scene = build([("teacup", 0, 0, 0)])
    assert category_kl(scene.with_slots(60), scene) == 0.0


def test_count_wasserstein_is_the_shift() -> None:
    few = build([("teacup", 0, 0, 0)] * 2, [("teacup", 0, 0, 0)] * 4)
    many = build([("teacup", 0, 0, 0)] * 5, [("teacup", 0, 0, 0)] * 7)
    assert count_wasserstein(many, few) == pytest.approx(3.0)
    assert count_wasserstein(few, few) == 0.0


def test_heights_of_an_exact_scene_are_exact() -> None:
    errors = height_errors(build(TOWER))
    assert {kind: len(e) for kind, e in errors.items()} == {"table": 2, "stack": 2}
    assert max(float(e.max()) for e in errors.values()) < 1e-7


def test_a_scene_shifted_by_two_millimetres_is_two_millimetres_off_the_table_and_intact_in_its_stacks() -> None:
    for sign in (1, -1):
        errors = height_errors(raised(build(TOWER), sign * 2e-3))
        assert errors["table"].tolist() == pytest.approx([2e-3, 2e-3], abs=1e-7)
        assert errors["stack"].tolist() == pytest.approx([0.0, 0.0], abs=1e-7)


def test_a_raised_lid_is_a_stack_error() -> None:
    errors = height_errors(raised(build(TOWER), 3e-3, only=("steamer_lid",)))
    assert errors["stack"].tolist() == pytest.approx([0.0, 3e-3], abs=1e-7)
    assert errors["table"].tolist() == pytest.approx([0.0, 0.0], abs=1e-7)


def test_a_steamer_out_of_reach_is_measured_from_the_table() -> None:
    scene = build([("steamer_bottom", 0.0, 0.0, 0.0), ("steamer_bottom", 0.07, 0.0, 0.091)])
    errors = height_errors(scene)
    assert errors["table"].tolist() == pytest.approx([0.0, 0.091], abs=1e-7)
    assert not len(errors["stack"])


def test_only_steamers_ride_on_steamers() -> None:
    errors = height_errors(build([("steamer_bottom", 0, 0, 0), ("teacup", 0, 0, 0.091)]))
    assert errors["table"].tolist() == pytest.approx([0.0, 0.091], abs=1e-7)


def test_own_supports_can_be_given() -> None:
    errors = height_errors(build([("teacup", 0, 0, 0.0)]), [Support("shelf", height=0.25)])
    assert errors["shelf"].tolist() == pytest.approx([0.25])


@pytest.mark.slow
@pytest.mark.parametrize("scene_type", ["breakfast_table_low_clutter", "living_room_shelf", "restaurant_low_clutter"])
def test_real_scenes_rest_where_supports_say(scene_type: str) -> None:
    batch = grammar_scenes(scene_type, 4, seed=1)
    errors = height_errors(batch)
    assert max(float(e.max()) for e in errors.values() if len(e)) < 1e-6
    assert sum(map(len, errors.values())) >= 0.8 * int(batch.is_free.sum())


def test_a_scene_lifted_by_a_millimetre_is_that_far_off_every_fixed_surface() -> None:
    for scene_type, kind in (("pantry_shelf", "tier"), ("breakfast_table_low_clutter", "table")):
        batch = grammar_scenes(scene_type, 2, seed=1)
        translations = batch.translations.clone()
        translations[..., 2] += 1e-3 * batch.is_free
        errors = height_errors(batch.with_poses(translations, batch.rotations))
        assert float(errors[kind].median()) == pytest.approx(1e-3, abs=1e-6)


def test_food_is_measured_from_its_plate_even_when_the_table_is_nearer() -> None:
    scene = build([("plate", 0, 0, 0), ("apple_gala", 0, 0, 0.002)], scene_type="breakfast_table_low_clutter")
    errors = height_errors(scene)
    assert errors["plate"].tolist() == pytest.approx([0.004], abs=1e-6)
    assert errors["table"].tolist() == pytest.approx([0.0], abs=1e-6)


def test_what_lies_in_a_container_has_no_height_error() -> None:
    bowl = ("fruit_bowl", 0.0, 0.0, 0.4075)
    inside = height_errors(build([bowl, ("apple_gala", 0.02, 0, 0.44)], scene_type="pantry_shelf"))
    beside = height_errors(build([bowl, ("apple_gala", 0.0, 0.2, 0.41)], scene_type="pantry_shelf"))
    assert inside["tier"].tolist() == pytest.approx([0.0], abs=1e-6)
    assert beside["tier"].tolist() == pytest.approx([0.0, 0.0025], abs=1e-6)


def test_tables_of_a_room_are_measured_and_carry_their_dishes_along() -> None:
    room = build([("cafe_table", 1.0, 1.0, 0.003), ("teacup", 1.2, 1.0, 0.004)], scene_type="restaurant_low_clutter")
    errors = height_errors(room)
    assert errors["furniture"].tolist() == pytest.approx([0.003], abs=1e-6)
    assert errors["table"].tolist() == pytest.approx([0.001], abs=1e-6)


def test_workspace_fraction_counts_objects() -> None:
    scene = build([("teacup", 0, 0, 0), ("teacup", 0.6, 0, 0), ("teapot", 0, 0, 1.5)])
    assert workspace_fraction(scene) == pytest.approx(2 / 4)  # the table and one cup


def test_scenes_without_objects_are_refused() -> None:
    empty = SceneBatch.from_parts(
        torch.zeros(2, 5, 3), torch.zeros(2, 5, 3, 3), torch.full((2, 5), DIMSUM.num_assets), DIMSUM
    )
    with pytest.raises(InvalidInputError, match="2 scenes without any object"):
        category_kl(empty, build(TOWER))
    with pytest.raises(InvalidInputError, match="2 scenes without any object"):
        workspace_fraction(empty)
