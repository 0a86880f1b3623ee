"""Runs whose reward is normalised: fixed statistics, exact resume, and figures that can be compared."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from agents.post_training import PostTrainer, post_train
from agents.post_training.comparison_run import trained_reward
from agents.priors.testing import tiny_prior
from rewards import RewardContext
from rewards.isolation import IsolatedReward, run_reward
from rewards.local_files import allow_local_rewards
from rewards.normalised import Normalised
from rewards.statistics import fit_statistics, has_open_statistics, load_statistics, statistics_of
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import small_config

REWARD: dict[str, Any] = {
    "name": "weighted_sum",
    "rewards": [
        {"name": "normalised", "reward": "object_count"},
        {"name": "normalised", "reward": {"name": "clip", "reward": "object_count", "high": 20}, "std": 2.0},
    ],
}


@pytest.fixture(autouse=True)
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("agents.post_training.learned_rewards", "agents.post_training.learner"):
        monkeypatch.setattr(f"{module}.FIRST_SAMPLES", 12)


def test_mean_and_std_are_those_of_samples_of_the_base_prior(tmp_path: Path) -> None:
    prior = tiny_prior()
    trainer = PostTrainer(small_config(tmp_path, reward=REWARD), prior=prior)
    trainer.prepare()
    samples = prior.sample(12, num_steps=5, seed=trainer.learner.learned._seed, batch_size=6)
    counts = samples.counts.double()
    (mean, std), (clipped, given) = statistics_of(trainer.learner.reward)
    assert (mean, std) == (pytest.approx(float(counts.mean())), pytest.approx(float(counts.std(correction=0))))
    assert (clipped, given) == (pytest.approx(float(counts.clamp(max=20).mean())), 2.0)
    rollout = trainer.learner.rollout(0)
    expected = (rollout.batch.counts - mean) / std + (rollout.batch.counts.clamp(max=20) - clipped) / given
    torch.testing.assert_close(rollout.reward.double(), expected.double(), rtol=1e-4, atol=1e-4)
    trainer.close()


def test_a_resumed_run_equals_one_without_a_break(tmp_path: Path) -> None:
    whole = post_train(small_config(tmp_path / "whole", reward=REWARD, iterations=3), prior=tiny_prior())
    post_train(small_config(tmp_path / "parts", reward=REWARD, iterations=2), prior=tiny_prior())
    parts = post_train(small_config(tmp_path / "parts", reward=REWARD, iterations=3), prior=tiny_prior())
    assert [row["reward"] for row in whole.history] == [row["reward"] for row in parts.history]
    assert max(abs(row["reward"]) for row in whole.history) > 1e-3  # with statistics of each batch all of them are 0


def test_the_report_has_the_statistics_of_the_run(tmp_path: Path) -> None:
    config = small_config(tmp_path, reward=REWARD, iterations=1)
    post_train(config, prior=tiny_prior())
    statistics = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["learner"]["reward_statistics"]
    reward = run_reward(REWARD)
    with trained_reward(reward, config):
        assert statistics_of(reward) == statistics
    assert has_open_statistics(reward)


def test_a_reward_object_keeps_no_memory_of_a_run(tmp_path: Path) -> None:
    reward = Normalised("object_count")
    results = [
        post_train(small_config(tmp_path / name, reward=reward, iterations=1), prior=tiny_prior(seed=seed))
        for name, seed in (("other", 1), ("after", 0))
    ]
    alone = post_train(
        small_config(tmp_path / "alone", reward=Normalised("object_count"), iterations=1), prior=tiny_prior()
    )
    assert results[1].history[0]["reward"] == alone.history[0]["reward"]
    assert reward.statistics() == (None, None)


@pytest.mark.slow
def test_a_reward_in_its_own_process_keeps_its_statistics_when_the_process_is_replaced(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("def number(batch):\n    return batch.counts\n")
    allow_local_rewards(file)
    batch = tiny_prior().sample(6, num_steps=2, seed=0)
    mapping = {"name": "normalised", "reward": f"{file}:number"}
    with IsolatedReward(mapping, timeout=60.0) as reward:
        assert has_open_statistics(reward)
        fit_statistics(reward, batch, RewardContext())
        kept = statistics_of(reward)
        one = SceneBatch(batch.tensor[:1], batch.scene_type)
        value = float(reward(one, RewardContext()).value)
        counts = batch.counts.double()
        assert value == pytest.approx(float((counts[0] - counts.mean()) / counts.std(correction=0)), abs=1e-5)
        reward.close()
        assert float(reward(one, RewardContext()).value) == value
        assert statistics_of(reward) == kept
        load_statistics(reward, None)
        assert reward.statistics is None
