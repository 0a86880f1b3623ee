"""The torchrl adapter: specs, bit-identity with the vector environment, partial resets, collectors."""

from __future__ import annotations

import gymnasium as gym
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from agents.priors.testing import tiny_prior
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import InvalidInputError

ID = "scene_envs:SceneEnvs/Denoising-v0"
MODES = ("next_sample", "noise")


@pytest.mark.parametrize("action_mode", MODES)
@pytest.mark.parametrize("num_steps", [2, 5])
def test_check_env_specs(prior, height, action_mode, num_steps):
    env = DenoisingTorchRLEnv(2, prior=prior, reward=height, num_steps=num_steps, action_mode=action_mode)
    check_env_specs(env, break_when_any_done="both", seed=0)


@pytest.mark.parametrize("action_mode", MODES)
def test_bit_identical_to_the_vector_face(height, action_mode):
    """Over two episodes, with a real network, the second episode started by autoreset."""
    kwargs = {"prior": tiny_prior(), "reward": height, "num_steps": 3, "action_mode": action_mode}
    vector, env = gym.make_vec(ID, num_envs=4, **kwargs), DenoisingTorchRLEnv(4, **kwargs)
    observation, _ = vector.reset(seed=7)
    env.set_seed(7)
    current = env.reset()
    draw = torch.Generator().manual_seed(0)
    for _ in range(6):
        for key in ("scene", "timestep", "object_mask"):
            assert torch.equal(current[key], torch.from_numpy(observation[key]))
        action = torch.randn(4, 34, 20, generator=draw)
        observation, rewards, terminated, _, info = vector.step(action.numpy())
        stepped, current = env.step_and_maybe_reset(current.set("action", action))
        assert torch.equal(stepped["next", "reward"].squeeze(-1).double(), torch.from_numpy(rewards))
        assert stepped["next", "terminated"].squeeze(-1).tolist() == terminated.tolist()
        if terminated.all():
            final = torch.stack([torch.from_numpy(row["scene"]) for row in info["final_obs"]])
            assert torch.equal(stepped["next", "scene"], final)


def test_partial_reset_restarts_only_the_asked_episodes(prior, height):
    env = DenoisingTorchRLEnv(3, prior=prior, reward=height, num_steps=4)
    env.set_seed(0)
    current = env.reset()
    stepped = env.step(current.set("action", torch.zeros(3, 34, 20)))["next"]
    again = env.reset(stepped.clone().set("_reset", torch.tensor([[False], [True], [False]])))
    assert again["timestep"].squeeze(-1).tolist() == [67, 100, 67]
    assert torch.equal(again["scene"][[0, 2]], stepped["scene"][[0, 2]])


def test_valid_key_tells_unscored_episodes(prior, picky_height):
    env = DenoisingTorchRLEnv(3, prior=prior, reward=picky_height, num_steps=1)
    env.set_seed(0)
    action = torch.full((3, 34, 20), -1.0)
    action[..., 13] = 1.0
    action[1, 1, 19] = 2.0
    after = env.step(env.reset().set("action", action))["next"]
    assert after["valid"].squeeze(-1).tolist() == [True, False, True]
    assert after["reward"][1].item() == 0.0


def test_bad_actions_are_named(prior, height):
    env = DenoisingTorchRLEnv(2, prior=prior, reward=height, num_steps=2)
    current = env.reset()
    action = torch.zeros(2, 34, 20)
    action[1, 3, 5] = float("nan")
    with pytest.raises(InvalidInputError, match="nan at environment 1, slot 3, feature 5"):
        env.step(current.set("action", action))


def test_episodes_carry_no_graph(height):
    prior = tiny_prior()
    env = DenoisingTorchRLEnv(2, prior=prior, reward=height, num_steps=2, action_mode="noise")
    weight = torch.ones(1, requires_grad=True)
    episodes = env.rollout(2, lambda td: td.set("action", weight * td["scene"]))
    assert not episodes["next", "scene"].requires_grad
    current = env.reset()
    assert not env.step(current.set("action", weight * current["scene"]))["next", "scene"].requires_grad


def test_torchrl_collector_runs_whole_episodes(prior, height):
    from torchrl.collectors import Collector

    env = DenoisingTorchRLEnv(2, prior=prior, reward=height, num_steps=3)
    collector = Collector(env, frames_per_batch=12, total_frames=12)
    (batch,) = list(collector)
    assert batch["next", "terminated"].squeeze(-1).tolist() == [[False, False, True, False, False, True]] * 2
    collector.shutdown()
