"""Training with Stable-Baselines3 in the denoising environments, with prompts and without."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import gymnasium as gym
import pytest
import torch

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


def test_the_example_with_settings_that_learn_starts_at_the_prior(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    prior = tiny_prior(slots=6).save(tmp_path / "prior")
    words = ["ppo.py", "--prior", str(prior), "--batch", "20", "--steps", "40"]
    monkeypatch.setattr(sys, "argv", words)
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "ppo.py"))
    example["main"]()
    assert [line.split(" steps:")[0] for line in capsys.readouterr().out.splitlines()] == ["20", "40"]
    layer = example["PerSlot"](6, 20)  # no shift of the noise: the prior's own steps
    assert layer(torch.randn(2, 121)).abs().max() == 0
