"""Evaluation of faulty rewards: invalid scenes, and one warning with the reason."""

import logging

import pytest
import torch

from rewards import RewardContext, RewardOutput, check_reward, evaluate_reward, resolve_reward
from scene_envs import SceneBatch
from scene_envs.errors import RewardError


def raises(batch, context):
    raise ZeroDivisionError("no objects to divide by")


BROKEN = {
    "raised ZeroDivisionError: no objects": raises,
    r"value has shape \(2, 1\), expected \(2,\)": lambda b, c: torch.zeros(2, 1),
    r"value has shape \(\)": lambda b, c: torch.tensor(1.0),
    "returned float": lambda b, c: 1.0,
    "value has dtype torch.int64": lambda b, c: RewardOutput(b.counts),
    "value is a list": lambda b, c: RewardOutput([1.0, 2.0]),
    r"per_object has shape \(2,\), expected \(2, 6\)": lambda b, c: RewardOutput(torch.zeros(2), torch.zeros(2)),
    "valid has dtype torch.float32": lambda b, c: RewardOutput(torch.zeros(2), valid=torch.ones(2)),
    r"terms\['x'\] has shape \(3,\)": lambda b, c: RewardOutput(torch.zeros(2), terms={"x": torch.zeros(3)}),
    r"object_flags\['x'\] has dtype": lambda b, c: RewardOutput(torch.zeros(2), object_flags={"x": torch.zeros(2, 6)}),
    "changed the scenes": lambda b, c: b.tensor.add_(1.0)[:, 0, 0],
    "is on meta": lambda b, c: torch.zeros(2, device="meta"),
}


@pytest.mark.parametrize("message", BROKEN)
def test_a_broken_reward_is_invalid_or_an_error_when_strict(message, cups, caplog):
    with pytest.raises(RewardError, match=message):
        evaluate_reward(BROKEN[message], cups, strict=True)

    def fresh(batch, context):
        return BROKEN[message](batch, context)

    with caplog.at_level(logging.WARNING):
        first = evaluate_reward(fresh, cups)
        evaluate_reward(fresh, cups)
    assert first.valid.tolist() == [False, False]
    assert bool(first.value.isnan().all())
    assert first.problem
    assert len(caplog.records) == 1
    assert "2 scenes of this batch count as invalid" in caplog.text


def test_values_that_are_not_finite_make_their_own_row_invalid(cups):
    output = evaluate_reward(lambda b, c: torch.tensor([1.0, torch.inf]), cups)
    assert output.valid.tolist() == [True, False]


@pytest.mark.parametrize("reward", ["object_count", lambda batch: batch.counts])
def test_scenes_of_inference_mode_are_scored(reward, cups):
    with torch.inference_mode():
        scenes = SceneBatch(cups.tensor.clone(), cups.scene_type)
    assert evaluate_reward(resolve_reward(reward), scenes).value.tolist() == [4.0, 2.0]
    with pytest.raises(RewardError, match="changed the scenes"):
        evaluate_reward(BROKEN["changed the scenes"], scenes, strict=True)


def test_gradients_stop_at_a_reward_and_numbers_become_float32(cups):
    weight = torch.ones((), requires_grad=True, dtype=torch.float64)
    output = evaluate_reward(lambda b, c: weight * b.counts, cups)
    assert output.value.dtype == torch.float32
    assert not output.value.requires_grad


@pytest.mark.parametrize(
    ("reward", "clause"),
    [
        (lambda batch: batch.translations[:, 3, 0], "order of the slots"),
        (lambda batch: batch.translations.mean(dim=(1, 2)), "number of empty slots"),
        (lambda batch: batch.counts - batch.counts.float().mean(), "alone and in a batch"),
        (lambda batch: torch.rand(len(batch)), "called again"),
        (lambda batch: torch.full((len(batch),), torch.nan), "welded objects"),
        (lambda batch: batch.translations[batch.is_free].reshape(len(batch), -1)[:, 0], "raised RuntimeError"),
    ],
)
def test_check_reward_names_the_broken_clause(reward, clause):
    with pytest.raises(RewardError, match=clause):
        check_reward(reward)


def test_the_context_reaches_the_reward(cups):
    seen = []

    def remember(batch, context):
        seen.append(context)
        return batch.counts

    context = RewardContext(prompts=("a", "b"), seed=3)
    evaluate_reward(remember, cups, context)
    assert seen == [context]
