"""Runs with rewards of users' files: the same seed gives the same run, and no reward ends one silently."""

from pathlib import Path

import pytest
import torch

from agents.post_training import post_train
from agents.priors.testing import tiny_prior
from rewards import allow_local_rewards
from scene_envs.errors import TrainingError
from tests.helpers import hostile_rewards
from tests.helpers.small_runs import small_config

FILE = Path(hostile_rewards.__file__)


def rewards_of(output: Path, seed: int) -> list[float]:
    config = small_config(output, reward=hostile_rewards.noisy, iterations=2, seed=seed)
    return [row["reward"] for row in post_train(config, prior=tiny_prior()).history]


@pytest.mark.slow
def test_a_reward_that_draws_from_global_generators_gives_the_same_run_for_the_same_seed(tmp_path):
    torch.manual_seed(1)
    first = rewards_of(tmp_path / "a", 0)
    torch.manual_seed(2)
    assert rewards_of(tmp_path / "b", 0) == first
    assert rewards_of(tmp_path / "c", 1) != first


@pytest.mark.slow
@pytest.mark.usefixtures("copied_workers")
def test_a_reward_that_ends_its_process_ends_a_run_with_an_error_and_never_with_success(tmp_path, caplog):
    allow_local_rewards(FILE)
    config = small_config(tmp_path, reward=f"{FILE}:quits")
    with pytest.raises(TrainingError, match="scored none of 2 real scenes"):
        post_train(config, prior=tiny_prior())
    assert "ended its process (exit status 0)" in caplog.text


@pytest.mark.slow
@pytest.mark.usefixtures("copied_workers")
def test_a_reward_of_a_file_gives_the_run_of_the_same_function(tmp_path):
    allow_local_rewards(FILE)
    runs = [
        post_train(small_config(tmp_path / name, reward=reward, iterations=2), prior=tiny_prior()).history
        for name, reward in (("file", f"{FILE}:noisy"), ("function", hostile_rewards.noisy))
    ]
    assert [row["reward"] for row in runs[0]] == [row["reward"] for row in runs[1]]
    assert [row["gradient_norm"] for row in runs[0]] == [row["gradient_norm"] for row in runs[1]]
