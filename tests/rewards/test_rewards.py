"""Values of the built-in rewards on scenes where they are known."""

import numpy as np
import pytest
import torch

from rewards import (
    Clip,
    FeasibleObjects,
    FeasibleShare,
    ObjectCount,
    Product,
    RewardContext,
    RewardOutput,
    WeightedSum,
    evaluate_reward,
    facts_of,
    resolve_reward,
)
from rewards.base import declared_maximum
from rewards.process import run_reward
from scene_envs import SceneBatch
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar


def distances(batch, context):
    """Sum of the objects' x, credited to each."""
    x = batch.translations[..., 0]
    return RewardOutput(x.sum(dim=-1), per_object=x, terms={"furthest": x.amax(dim=-1)})


def half_invalid(batch, context):
    return RewardOutput(torch.ones(2), valid=torch.tensor([True, False]))


def score(reward, batch):
    return evaluate_reward(reward, batch, RewardContext(), strict=True)


def test_object_count_counts_welded_objects_and_credits_each(cups):
    output = score(ObjectCount(), cups)
    assert output.value.tolist() == [4.0, 2.0]
    assert output.per_object.tolist() == [[1, 1, 1, 1, 0, 0], [1, 1, 0, 0, 0, 0]]


def test_weighted_sum_adds_values_credits_and_names_its_terms(cups):
    output = score(WeightedSum(["object_count", distances, distances], [0.5, 10.0, -1.0]), cups)
    torch.testing.assert_close(output.value, torch.tensor([0.5 * 4 + 9 * 0.6, 1.0]))
    torch.testing.assert_close(output.per_object.sum(dim=-1), output.value)
    assert set(output.terms) == {
        "object_count", "distances", "distances.furthest", "distances_2", "distances_2.furthest"
    }  # fmt: skip
    assert score(WeightedSum(["object_count", half_invalid]), cups).per_object is None


def test_product_and_clip(cups):
    assert score(Product(["object_count", "object_count"]), cups).value.tolist() == [16.0, 4.0]
    clipped = score(Clip("object_count", low=3.0, high=3.5), cups)
    assert clipped.value.tolist() == [3.5, 3.0]
    assert clipped.per_object.abs().sum() == 0


@pytest.mark.parametrize("composite", [WeightedSum, Product])
def test_a_scene_is_valid_when_all_parts_could_score_it(composite, cups):
    assert score(composite(["object_count", half_invalid]), cups).valid.tolist() == [True, False]


def test_a_part_that_raises_makes_the_whole_invalid_and_is_named(cups):
    def breaks(batch, context):
        raise ValueError("no")

    output = evaluate_reward(WeightedSum(["object_count", breaks]), cups)
    assert not output.valid.any()
    assert "breaks" in output.problem


@pytest.mark.parametrize(
    "make",
    [
        lambda: WeightedSum([]),
        lambda: WeightedSum("object_count"),
        lambda: WeightedSum(["object_count"], [1.0, 2.0]),
        lambda: Clip("object_count"),
        lambda: Clip("object_count", low=2.0, high=1.0),
        lambda: FeasibleObjects(duration=0.0),
    ],
)
def test_wrong_settings_are_refused(make):
    with pytest.raises(InvalidInputError):
        make()


@pytest.fixture
def table() -> SceneBatch:
    """One scene: a plate standing on the table, one floating 20 cm above it, and two teapots in each other."""
    batch = SceneBatch.empty("dimsum_table", 1, slots=8)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    plate, teapot = (batch.scene_type.assets.index(name) for name in ("dinner_plate", "teapot"))
    rows = ((plate, 0.3, 0.0, 0.0), (plate, -0.3, 0.0, 0.2), (teapot, 0.0, 0.3, 0.0), (teapot, 0.02, 0.3, 0.0))
    for slot, (category, *position) in enumerate(rows, start=1):
        categories[0, slot] = category
        translations[0, slot] = torch.tensor(position)
    return SceneBatch.from_parts(translations, torch.eye(3).expand(1, 8, 3, 3), categories, batch.scene_type)


def test_feasible_objects_counts_what_neither_overlaps_nor_moves(table):
    output = score(FeasibleObjects(), table)
    assert output.value.tolist() == [1.0]
    assert output.object_flags["feasible"].nonzero().tolist() == [[0, 1]]
    assert output.per_object.tolist() == output.object_flags["feasible"].float().tolist()
    assert output.terms["free_objects"].item() == 4
    assert output.terms["feasible_fraction"].item() == 0.25
    assert output.terms["deepest_mm"].item() > 10


def test_feasible_objects_follows_its_settings(table):
    assert score(FeasibleObjects(max_displacement=10.0, max_rotation=10.0), table).value.tolist() == [2.0]


def test_a_scene_without_free_objects_is_valid_and_scores_zero():
    output = score(FeasibleObjects(), SceneBatch.empty("dimsum_table", 1))
    assert (output.value.item(), output.valid.item(), output.terms["feasible_fraction"].item()) == (0.0, True, 1.0)


def test_feasible_share_is_the_verdict_over_the_free_objects(table):
    output = score(FeasibleShare(), table)
    assert output.value.tolist() == [0.25]
    assert output.terms["feasible_objects"].tolist() == [1.0]
    assert torch.equal(output.per_object, score(FeasibleObjects(), table).per_object)
    assert score(FeasibleShare(), SceneBatch.empty("dimsum_table", 2)).value.tolist() == [0.0, 0.0]


def test_feasible_share_gives_furniture_credit_for_standing_apart(table):
    assert torch.equal(score(FeasibleShare(), table).object_flags["judged"], table.is_free)
    rooms = get_grammar("restaurant_low_clutter").sample(np.random.default_rng(0), 3)
    apart = score(FeasibleShare(), rooms)
    assert bool((apart.per_object[rooms.is_furniture] == 1).all())
    assert torch.equal(apart.object_flags["judged"], rooms.is_free | rooms.is_furniture)
    first, second = rooms.is_furniture[0].nonzero().flatten()[:2].tolist()
    translations, rotations = rooms.translations.clone(), rooms.rotations.clone()
    translations[0, second], rotations[0, second] = translations[0, first] + 0.05, rotations[0, first]
    joined = score(FeasibleShare(), rooms.with_poses(translations, rotations))
    assert joined.per_object[0, [first, second]].tolist() == [0.0, 0.0]
    assert torch.equal(joined.per_object[1:], apart.per_object[1:])
    assert joined.value.tolist() == (joined.terms["feasible_objects"] / joined.terms["free_objects"]).tolist()
    summed = score(WeightedSum(["feasible_share", "object_count"]), rooms)
    assert torch.equal(summed.object_flags["judged"], rooms.is_free)


def test_what_stands_outside_the_workspace_counts_for_nothing(table):
    """The same plate at rest on a second table: welded, and 2 m away."""
    translations, categories = table.translations.clone(), table.categories.clone()
    translations[0, 6], categories[0, 6] = torch.tensor([2.0, 0.0, 0.0]), categories[0, 0]
    translations[0, 1, 0] += 2.0
    moved = SceneBatch.from_parts(translations, torch.eye(3).expand(1, 8, 3, 3), categories, table.scene_type)
    assert score(FeasibleObjects(), moved).value.tolist() == [0.0]
    assert score(FeasibleShare(), moved).value.tolist() == [0.0]
    assert score(ObjectCount(), moved).value.tolist() == [6.0]


@pytest.mark.parametrize(
    ("reward", "largest"),
    [
        ("object_count", 40.0),
        ("feasible_objects", 39.0),
        ("feasible_share", 1.0),
        ("stability", 1.0),
        ("clearance", 1.0),
        ({"name": "clip", "reward": "object_count", "high": 12.0}, 12.0),
        ({"name": "clip", "reward": "feasible_share", "low": 0.5}, 1.0),
        ("penetration", None),
        (lambda batch: batch.counts, None),
    ],
)
def test_the_largest_value_is_declared(reward, largest):
    """By the reward itself, and as runs use it."""
    assert declared_maximum(resolve_reward(reward), 40, 39) == largest
    assert declared_maximum(run_reward(reward), 40, 39) == largest


@pytest.mark.parametrize(
    ("reward", "averages"),
    [
        ("object_count", False),
        ("feasible_objects", False),
        ("feasible_share", True),
        ("stability", True),
        ("reachability", True),
        ("clearance", True),
        ({"name": "clip", "reward": "feasible_share", "low": 0.5}, True),
        ({"name": "weighted_sum", "rewards": ["feasible_share", "stability"]}, True),
        ({"name": "weighted_sum", "rewards": ["feasible_share", "object_count"]}, False),
        (lambda batch: batch.counts, False),
    ],
)
def test_means_over_objects_say_so(reward, averages):
    assert facts_of(resolve_reward(reward))["averages_objects"] == averages


@pytest.mark.parametrize(
    "reward",
    [
        {"name": "weighted_sum", "rewards": ["object_count", "prompt_match"]},
        {"name": "product", "rewards": ["object_count", "prompt_match"]},
        {"name": "clip", "reward": "prompt_match", "high": 0.5},
    ],
)
def test_a_composite_needs_prompts_when_a_part_does(reward):
    assert facts_of(resolve_reward(reward))["needs_prompts"]
    fixed = repr(reward).replace("'prompt_match'", "{'name': 'prompt_match', 'prompt': 'A scene with a cup.'}")
    assert not facts_of(resolve_reward(eval(fixed)))["needs_prompts"]


def test_a_function_declares_its_largest_value_by_an_attribute():
    def share(batch):
        return batch.counts / 40

    share.maximum = 1.0
    assert declared_maximum(resolve_reward(share), 40, 39) == 1.0
