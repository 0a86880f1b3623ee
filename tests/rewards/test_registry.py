"""Rewards from names, mappings, functions, objects and installed packages, and errors for wrong specifications."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import pytest
import torch

from agents.cli import main
from rewards import (
    ObjectCount,
    RewardContext,
    RewardOutput,
    allow_reward_targets,
    check_reward,
    list_rewards,
    make_reward,
    register_reward,
    registry,
    resolve_reward,
    reward_info,
    reward_label,
    reward_name,
)
from scene_envs.errors import InvalidInputError, RewardError, UnknownNameError


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


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_an_installed_reward_class_is_used_by_name(cups):
    output = make_reward("open_space", scale=2.0)(cups, RewardContext())
    torch.testing.assert_close(output.value, torch.tensor([0.4, 0.8]))


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_a_module_entry_point_registers_through_its_decorators(cups):
    assert torch.equal(resolve_reward("flat")(cups, RewardContext()).value, torch.zeros(2))


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_installed_rewards_are_listed_and_keep_the_contract():
    assert {"flat", "object_count", "open_space"} <= set(list_rewards())
    assert len(check_reward("open_space")) == 6


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_a_target_in_an_installed_reward_package_is_allowed(cups):
    reward = resolve_reward({"_target_": "open_space_rewards.open_space.OpenSpace", "scale": 1.0})
    torch.testing.assert_close(reward(cups, RewardContext()).value, torch.tensor([0.2, 0.4]))


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_a_broken_installed_package_is_named(capsys):
    with pytest.raises(RewardError, match=r"open-space-rewards.*not_there"):
        resolve_reward("missing_module")
    assert main(["rewards"]) == 0
    printed = capsys.readouterr().out
    assert "missing_module: cannot be used." in printed
    assert "from: open_space_rewards.open_space" in printed


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_a_near_miss_offers_the_installed_name():
    with pytest.raises(UnknownNameError, match="did you mean 'open_space'"):
        resolve_reward("open_spaec")


@pytest.mark.slow
@pytest.mark.usefixtures("plugin")
def test_the_environment_takes_the_installed_name(cups):
    from scene_envs.envs.scoring import RewardScorer

    torch.testing.assert_close(RewardScorer("open_space")(cups).value, torch.tensor([0.2, 0.4]))


ROOT = Path(__file__).parents[2]


def python_blocks(path: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / path).read_text(), re.DOTALL)


def test_the_readmes_reward_is_short_and_keeps_the_contract(cups):
    (block,) = [block for block in python_blocks("README.md") if "@register_reward" in block]
    assert len([line for line in block.splitlines() if line.strip()]) < 15
    definition = block.partition("env =")[0]
    exec(definition, {})
    check_reward("spread")
    assert make_reward("spread")(cups, None).value.tolist() == pytest.approx([0.2, 0.4])


def test_the_rewards_of_the_documentation_keep_the_contract():
    blocks = python_blocks("docs/rewards/README.md")
    for name in ("spread", "upright"):
        (block,) = [block for block in blocks if f'@register_reward("{name}")' in block]
        exec(block, {})
        check_reward(name)
    (mapping,) = [block for block in blocks if "weighted_sum" in block]
    resolve_reward(eval(mapping))
