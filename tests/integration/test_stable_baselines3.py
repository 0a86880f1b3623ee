"""Training with Stable-Baselines3 in the denoising environments, with prompts and without."""

from __future__ import annotations

import gymnasium as gym
import pytest

from agents.priors.testing import tiny_prior

sb3 = pytest.importorskip("stable_baselines3")

ID = "scene_envs:SceneEnvs/Denoising-v0"
PROMPTS = ["A scene with two cups.", "A scene with three plates and a table.", "A scene with 9 objects."]


def test_ppo_trains_on_noise_mode() -> None:
    env = gym.make(ID, prior=tiny_prior(slots=6), slots=6, reward="object_count", num_steps=2, action_mode="noise")
    model = sb3.PPO("MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(16)
    assert model.num_timesteps == 16
    assert any(not p.equal(q) for p, q in zip(model.policy.parameters(), before, strict=True))


def test_ppo_trains_on_prompts() -> None:
    from stable_baselines3.common.env_checker import check_env

    reader = tiny_prior(process="mixed", text=True)
    env = gym.make(ID, prior=reader, num_steps=2, prompt=PROMPTS, action_mode="noise", reward="prompt_match")
    check_env(env.unwrapped)
    sb3.PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1, device="cpu").learn(4)
