"""Rewards from names, mappings, functions and objects, and errors for wrong specifications."""

import functools

import pytest
import torch

from rewards import (
    ObjectCount,
    RewardContext,
    RewardOutput,
    allow_reward_targets,
    make_reward,
    register_reward,
    registry,
    resolve_reward,
    reward_info,
    reward_label,
    reward_name,
)
from scene_envs.errors import InvalidInputError, UnknownNameError


def low(batch, context, *, factor=1.0):
    """Lowness."""
    return -factor * batch.translations[..., 2].sum(dim=-1)


def test_functions_of_batch_or_batch_and_context_work(cups):
    def with_context(batch, context):
        return torch.full((len(batch),), float(context.seed))

    assert resolve_reward(lambda batch: batch.counts)(cups, RewardContext()).value.tolist() == [4.0, 2.0]
    assert resolve_reward(with_context)(cups, RewardContext(seed=7)).value.tolist() == [7.0, 7.0]
    partial = functools.partial(low, factor=2.0)
    assert resolve_reward(partial)(cups, RewardContext()).value.tolist() == [0.0, 0.0]


def test_registered_functions_and_classes_take_settings(cups):
    @register_reward("fixed")
    class Fixed:
        def __init__(self, value=1.0):
            self.value = value

        def __call__(self, batch, context):
            return RewardOutput(torch.full((len(batch),), self.value))

    register_reward("low")(low)
    assert make_reward("fixed", value=3.0)(cups, RewardContext()).value.tolist() == [3.0, 3.0]
    assert resolve_reward({"name": "fixed", "value": 4.0})(cups, RewardContext()).value.tolist() == [4.0, 4.0]
    assert resolve_reward({"name": "low", "factor": 2.0})(cups, RewardContext()).value.shape == (2,)
    assert reward_info("low").parameters == ("factor=1.0",)
    with pytest.raises(InvalidInputError, match=r"'fixed'.*unexpected keyword.*'vaule'"):
        make_reward("fixed", vaule=3.0)
    with pytest.raises(InvalidInputError, match=r"'low'.*'fcator'"):
        make_reward("low", fcator=3.0)


def test_an_object_comes_back_as_it_is_and_a_class_is_built():
    reward = ObjectCount()
    assert resolve_reward(reward) is reward
    assert resolve_reward(ObjectCount) == reward
    assert reward_name(reward) == reward_name("object_count") == "object_count"


def test_a_label_is_short(tmp_path):
    def local(batch):
        return batch.counts

    assert reward_label("feasible_share") == reward_label({"name": "feasible_share"}) == "feasible share"
    assert reward_label(f"{tmp_path}/my_rewards.py:wide_tables") == "my_rewards.py:wide_tables"
    assert reward_label(local) == "local"


def test_an_unknown_name_offers_the_nearest():
    with pytest.raises(UnknownNameError, match="unknown reward 'object_cuont'; did you mean 'object_count'"):
        resolve_reward("object_cuont")


def test_a_name_cannot_be_taken_twice_but_a_cell_can_be_run_again():
    with pytest.raises(InvalidInputError, match=r"'object_count' is taken by rewards\.counts\.ObjectCount"):
        register_reward("object_count")(low)
    register_reward("low")(low)
    register_reward("low")(low)


@pytest.mark.parametrize(
    "target", ["os.system", "rewards.registry.import_module", "rewards.registry.os.system", "rewardsfoo.bar", "system"]
)
def test_targets_outside_the_allow_list_are_refused(target):
    with pytest.raises(InvalidInputError, match="_target_"):
        resolve_reward({"_target_": target})


def test_targets_of_allowed_packages_are_built(monkeypatch):
    monkeypatch.setattr(registry, "_allowed_targets", ["rewards"])
    assert resolve_reward({"_target_": "rewards.ObjectCount"}) == ObjectCount()
    with pytest.raises(InvalidInputError, match="outside"):
        resolve_reward({"_target_": "fractions.Fraction"})
    allow_reward_targets("fractions")
    with pytest.raises(InvalidInputError, match="cannot be found"):
        resolve_reward({"_target_": "fractions.NotThere"})


@pytest.mark.parametrize("wrong", [3, None, {"nmae": "object_count"}, ["object_count"]])
def test_what_is_no_reward_is_refused(wrong):
    with pytest.raises(InvalidInputError):
        resolve_reward(wrong)
