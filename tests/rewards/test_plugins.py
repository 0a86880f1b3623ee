"""Rewards of other installed packages: use by name in commands, functions and environments."""

import pytest
import torch

from agents.cli import main
from rewards import RewardContext, check_reward, list_rewards, make_reward, resolve_reward
from scene_envs.errors import RewardError, UnknownNameError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("plugin")]  # pip installs a package


def test_an_installed_reward_class_is_used_by_name(cups):
    output = make_reward("open_space", scale=2.0)(cups, RewardContext())
    torch.testing.assert_close(output.value, torch.tensor([0.4, 0.8]))


def test_a_module_entry_point_registers_through_its_decorators(cups):
    assert torch.equal(resolve_reward("flat")(cups, RewardContext()).value, torch.zeros(2))


def test_installed_rewards_are_listed_and_keep_the_contract():
    assert {"flat", "object_count", "open_space"} <= set(list_rewards())
    assert len(check_reward("open_space")) == 6


def test_a_target_in_an_installed_reward_package_is_allowed(cups):
    reward = resolve_reward({"_target_": "open_space_rewards.open_space.OpenSpace", "scale": 1.0})
    torch.testing.assert_close(reward(cups, RewardContext()).value, torch.tensor([0.2, 0.4]))


@pytest.mark.usefixtures("copied_workers")
def test_a_broken_installed_package_is_named(capsys):
    with pytest.raises(RewardError, match=r"open-space-rewards.*not_there"):
        resolve_reward("missing_module")
    assert main(["rewards"]) == 0
    printed = capsys.readouterr().out
    assert "missing_module: cannot be used." in printed
    assert "from: open_space_rewards.open_space" in printed


def test_a_near_miss_offers_the_installed_name():
    with pytest.raises(UnknownNameError, match="did you mean 'open_space'"):
        resolve_reward("open_spaec")


def test_the_environment_takes_the_installed_name(cups):
    from scene_envs.envs.scoring import RewardScorer

    torch.testing.assert_close(RewardScorer("open_space")(cups).value, torch.tensor([0.2, 0.4]))
