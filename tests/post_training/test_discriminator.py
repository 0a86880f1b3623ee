"""Reward ``discriminator``: what it learns, its state, its contract, and runs that train it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from agents import post_train
from agents.post_training import learner as learned_rewards
from agents.post_training.discriminator import Discriminator
from agents.priors.testing import tiny_prior
from rewards import allow_local_rewards, check_reward, learned_parts, resolve_reward
from rewards.base import RewardContext
from rewards.process import IsolatedReward
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import small_config


def disturbed(batch: SceneBatch, seed: int) -> tuple[SceneBatch, torch.Tensor]:
    """Scenes in which one free object in five is 5 cm too high, and which objects are (B, N)."""
    chance = torch.rand(batch.is_free.shape, generator=torch.Generator().manual_seed(seed))
    moved = batch.is_free & (chance < 0.2)
    shift = torch.tensor([0.0, 0.0, 0.05]) * moved[..., None]
    return batch.with_poses(batch.translations + shift, batch.rotations), moved


@pytest.fixture(scope="module")
def trained() -> Discriminator:
    grammar = get_grammar("dimsum_table")
    reward = Discriminator(batch_size=24)
    reward.begin(grammar.sample(np.random.default_rng(0), 96), seed=0)
    reward.learn(disturbed(grammar.sample(np.random.default_rng(1), 96), 1)[0], steps=80)
    return reward


def test_it_tells_which_objects_are_out_of_place(trained: Discriminator) -> None:
    real = get_grammar("dimsum_table").sample(np.random.default_rng(2), 24)
    scenes, moved = disturbed(real, 0)
    output = trained(scenes, RewardContext())
    others = output.per_object[scenes.is_free & ~moved]
    assert float(output.per_object[moved].mean()) < 0.1
    assert float(others.mean()) > 0.4  # four in five objects of the samples are where real ones are
    assert float((trained(real, RewardContext()).value > output.value).float().mean()) > 0.9


def test_value_is_the_mean_of_its_credit(trained: Discriminator) -> None:
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(3), 5)
    output = trained(scenes, RewardContext())
    assert not output.per_object[~scenes.is_free].any()
    expected = output.per_object.sum(dim=1) / scenes.is_free.sum(dim=1)
    torch.testing.assert_close(output.value, expected)


def test_furniture_of_rooms_is_judged_and_does_not_change_the_value() -> None:
    grammar = get_grammar("restaurant_low_clutter")
    real, samples = (grammar.sample(np.random.default_rng(seed), 8) for seed in (0, 1))
    shift = torch.tensor([0.0, 0.0, 0.3]) * samples.is_furniture[..., None]
    reward = Discriminator(batch_size=8)
    reward.begin(real, seed=0)
    reward.learn(samples.with_poses(samples.translations + shift, samples.rotations), steps=50)
    output = reward(samples, RewardContext())
    moved = reward(samples.with_poses(samples.translations + shift, samples.rotations), RewardContext())
    furniture = samples.is_furniture
    assert float(moved.per_object[furniture].mean()) < 0.2 < 0.5 < float(output.per_object[furniture].mean())
    assert torch.equal(output.object_flags["judged"], samples.is_free | furniture)
    expected = (output.per_object * samples.is_free).sum(dim=1) / samples.is_free.sum(dim=1)
    torch.testing.assert_close(output.value, expected)


def test_a_network_without_samples_is_reported(caplog: pytest.LogCaptureFixture) -> None:
    reward = Discriminator()
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(3), 2)
    assert reward(scenes, RewardContext()).value.tolist() == [0.5, 0.5]
    assert "only post-train trains it" in caplog.text


def test_the_contract_holds_before_and_after_learning(trained: Discriminator) -> None:
    check_reward(trained)
    check_reward("discriminator")


def test_a_restored_state_goes_on_as_the_first_one() -> None:
    grammar = get_grammar("dimsum_table")
    real, samples = grammar.sample(np.random.default_rng(0), 24), grammar.sample(np.random.default_rng(1), 24)
    first, second = Discriminator(steps=2), Discriminator(steps=2)
    first.begin(real, seed=3)
    first.learn(samples)
    second.begin(real, seed=3)
    second.load_state_dict(first.state_dict())
    for reward in (first, second):
        reward.learn(samples[:8])
    scores = [reward(samples, RewardContext()).value for reward in (first, second)]
    assert torch.equal(*scores)


@pytest.mark.parametrize(
    "settings", [{"steps": 0}, {"memory": 1.5}, {"batch_size": -1}, {"learning_rate": 0.0}, {"learning_rate": "x"}]
)
def test_wrong_settings_are_named(settings: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(settings))):
        Discriminator(**settings)


def test_learning_needs_real_scenes() -> None:
    with pytest.raises(InvalidInputError, match="begin"):
        Discriminator().learn(SceneBatch.empty("dimsum_table", 1))


def test_a_composite_with_foreign_parts_is_refused(tmp_path: Path) -> None:
    foreign = tmp_path / "mine.py"
    allow_local_rewards(foreign)
    foreign.write_text("def flat(batch):\n    return -batch.translations[..., 2].sum(dim=-1)\n")
    mapping = {"name": "weighted_sum", "rewards": ["discriminator", f"{foreign}:flat"]}
    with pytest.raises(InvalidInputError, match="'discriminator' learns"):
        IsolatedReward(mapping, timeout=60.0)


def test_the_parts_of_a_composite_that_learn_are_found() -> None:
    total = {"name": "weighted_sum", "rewards": ["feasible_share", "discriminator"]}
    clip = {"name": "clip", "reward": {"name": "product", "rewards": ["discriminator"]}, "high": 1.0}
    reward = resolve_reward({"name": "weighted_sum", "rewards": [total, "object_count", clip]})
    assert [type(part) for part in learned_parts(reward)] == [Discriminator, Discriminator]


def test_a_resumed_run_equals_one_without_a_break(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned_rewards, "FIRST_STEPS", 2)
    judge = {"name": "discriminator", "steps": 2, "batch_size": 6}
    reward = {"name": "clip", "reward": judge, "high": 0.9}
    prior = tiny_prior(process="mixed")
    whole = post_train(small_config(tmp_path / "whole", reward=reward, guard_every=1, iterations=2), prior=prior)
    post_train(small_config(tmp_path / "parts", reward=reward, guard_every=1, iterations=1), prior=prior)
    parts = post_train(small_config(tmp_path / "parts", reward=reward, guard_every=1, iterations=2), prior=prior)
    rewards = [[row["reward"] for row in result.history] for result in (whole, parts)]
    assert rewards[0] == rewards[1]
    assert len(set(rewards[0])) > 1
    for name, weights in whole.prior.state_dict().items():
        assert torch.equal(weights, parts.prior.state_dict()[name])
