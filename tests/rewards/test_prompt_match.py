"""The reward that compares scenes with prompts, by hand."""

from __future__ import annotations

import logging

import pytest
import torch

from rewards import PromptMatch, RewardContext, check_reward, evaluate_reward, resolve_reward
from scene_envs.errors import RewardError
from scene_envs.scene import SceneBatch


def test_scores_are_those_of_the_claims(cups: SceneBatch) -> None:
    """Three cups and a table in the first scene, one cup and a table in the second."""
    prompt = "A scene with a table, four cups and a teapot."
    output = PromptMatch(prompt)(cups, RewardContext())
    expected = torch.tensor([(1 + 3 / 4 + 0) / 3, (1 + 1 / 4 + 0) / 3])
    torch.testing.assert_close(output.value, expected)
    torch.testing.assert_close(output.terms["claims_hold"], torch.tensor([1 / 3, 1 / 3]))
    assert output.terms["all_claims_hold"].tolist() == [0.0, 0.0]
    exact = PromptMatch("A scene with three cups.")(cups, RewardContext())
    assert exact.value.tolist() == pytest.approx([1.0, 1 / 3])
    assert exact.terms["all_claims_hold"].tolist() == [1.0, 0.0]


def test_each_scene_is_compared_with_its_own_prompt(cups: SceneBatch) -> None:
    context = RewardContext(prompts=("A scene with three cups.", "A scene with 2 objects."))
    assert resolve_reward("prompt_match")(cups, context).value.tolist() == [1.0, 1.0]
    fixed = resolve_reward({"name": "prompt_match", "prompt": "A scene with a cup."})
    assert fixed(cups, context).value.tolist() == pytest.approx([1 / 3, 1.0])


def test_what_cannot_be_read_is_invalid_and_said_once(cups: SceneBatch, caplog: pytest.LogCaptureFixture) -> None:
    context = RewardContext(prompts=("A scene with a zeppelin of lead.", "A scene with a cup."))
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            output = evaluate_reward(PromptMatch(), cups, context)
            assert output.valid is not None
            assert output.valid.tolist() == [False, True]
    assert caplog.text.count("zeppelin of lead'") == 1
    nothing = evaluate_reward(PromptMatch(), cups, RewardContext(prompts=("", "A scene with a cup.")))
    assert nothing.is_valid.tolist() == [False, True]
    with pytest.raises(RewardError, match="no prompt to compare with"):
        evaluate_reward(PromptMatch(), cups, RewardContext(), strict=True)
    with pytest.raises(RewardError, match="1 prompts for 2 scenes"):
        evaluate_reward(PromptMatch(), cups, RewardContext(prompts=("A scene with a cup.",)), strict=True)
    with pytest.raises(RewardError, match="expected a singular name"):
        evaluate_reward(PromptMatch("A scene with a zeppelin."), cups, RewardContext(), strict=True)


@pytest.mark.parametrize("scene_type", ["dimsum_table", "living_room_shelf"])
def test_it_keeps_the_contract(scene_type: str) -> None:
    assert len(check_reward("prompt_match", scene_type)) == 6
    check_reward({"name": "prompt_match", "prompt": "A scene with 9 objects."}, scene_type)


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


def test_relations_that_hold_score_one_and_others_a_quarter_per_object(laid: SceneBatch) -> None:
    output = PromptMatch("A scene where a cup is on top of the first plate from the left.")(laid, RewardContext())
    assert output.value.tolist() == [1.0]
    both = "A scene where a cup is on top of the first plate from the left and the teapot is to the left of the cup."
    wrong = PromptMatch(both)(laid, RewardContext())
    assert wrong.value.item() == pytest.approx((1 + 0.5) / 2)
    assert wrong.terms["claims_hold"].tolist() == [0.5]
