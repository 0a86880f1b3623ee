"""Metrics on scenes built so that every figure is known in closed form."""

from __future__ import annotations

import math

import pytest
import torch

from agents.evaluation.metrics import (
    KL_EPS,
    Support,
    category_kl,
    count_wasserstein,
    height_errors,
    workspace_fraction,
)
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

DIMSUM = get_scene_type("dimsum_table")


def build(*scenes: list[tuple[str, float, float, float]]) -> SceneBatch:
    """Dimsum scenes from (asset, x, y, z) lists; the table comes first."""
    batch = SceneBatch.empty(DIMSUM, len(scenes))
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories
    for row, objects in enumerate(scenes):
        for slot, (name, *position) in enumerate(objects, start=1):
            translations[row, slot] = torch.tensor(position)
            rotations[row, slot] = torch.eye(3)
            categories[row, slot] = DIMSUM.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, DIMSUM)


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
