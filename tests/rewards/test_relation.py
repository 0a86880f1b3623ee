"""The reward of claimed relations, by hand."""

from __future__ import annotations

import pytest
import torch

from rewards import Relation, RewardContext, check_reward, evaluate_reward
from scene_envs.errors import RewardError
from scene_envs.scene import SceneBatch


@pytest.fixture
def laid() -> SceneBatch:
    """A cup on the left plate of two, and a teapot to the right of both (right is +y)."""
    batch = SceneBatch.empty("dimsum_table", 1, slots=6)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    floor = 0.01
    rows = [("dinner_plate", 0, -0.3, 0), ("dinner_plate", 0, 0, 0), ("teacup", 0, -0.3, floor), ("teapot", 0, 0.3, 0)]
    for slot, (name, *position) in enumerate(rows, start=1):
        categories[0, slot] = batch.scene_type.assets.index(name)
        translations[0, slot] = torch.tensor([float(value) for value in position])
    return SceneBatch.from_parts(translations, torch.eye(3).expand(1, 6, 3, 3), categories, batch.scene_type)


def test_relations_that_hold_score_one_and_credit_their_objects(laid: SceneBatch) -> None:
    output = Relation("A scene where a cup is on top of the first plate from the left.")(laid, RewardContext())
    assert output.value.tolist() == [1.0]
    assert output.per_object[0].tolist() == [0, 0, 0, 1, 0, 0]
    assert output.terms["relations"].tolist() == [1.0]
    both = "A scene where a cup is on top of the first plate from the left and the teapot is to the left of the cup."
    wrong = Relation(both)(laid, RewardContext())
    assert wrong.value.item() == pytest.approx((1 + 0.5) / 2)
    assert wrong.terms["relations_hold"].tolist() == [0.5]
    assert wrong.per_object[0].tolist() == pytest.approx([0, 0, 0, 0.5 + 0.125, 0.125, 0])


def test_numbers_are_not_relations_and_nothing_claimed_is_nothing_broken(laid: SceneBatch) -> None:
    output = evaluate_reward(Relation(), laid, RewardContext(prompts=("A scene with nine cups.",)))
    assert output.value.tolist() == [1.0]
    assert output.terms["relations"].tolist() == [0.0]
    assert evaluate_reward(Relation(), laid, RewardContext(prompts=("",))).is_valid.tolist() == [False]
    with pytest.raises(RewardError, match="relation has no prompt"):
        evaluate_reward(Relation(), laid, RewardContext(), strict=True)


def test_it_keeps_the_contract() -> None:
    assert len(check_reward("relation")) == 6
    check_reward({"name": "relation", "prompt": "A scene where a cup is on top of a plate."})
