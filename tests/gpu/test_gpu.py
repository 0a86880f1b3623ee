"""A GPU beside the CPU: chains, guidance, rewards, environments, post-training and search.

``make test-gpu`` runs these tests on a GPU. ``make test-gpu DEVICE=cpu`` compares the CPU with itself, which shows that
the tests run, and nothing about a GPU.
"""

from __future__ import annotations

import os
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch

from agents import ScenePrior, evaluate, run_search
from agents.post_training import post_train
from agents.post_training.policy import DenoisingPolicy
from agents.priors.testing import tiny_prior
from rewards import RewardContext, resolve_reward
from rewards.evaluation import evaluate_reward
from scene_envs.envs import DenoisingTorchRLEnv, DenoisingVectorEnv
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import small_config

DEVICE = os.environ.get("SCENE_ENVS_TEST_DEVICE", "")
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not DEVICE, reason="make test-gpu runs it")]

STEP = {"rtol": 0.0, "atol": 1e-5}
"""Tolerance of one step of float32, in normalised units: poses of a few hundredths of a millimetre."""


@pytest.fixture(scope="module", autouse=True)
def _plain_float32() -> None:
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = False


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 16)


def both(prior: ScenePrior) -> tuple[ScenePrior, ScenePrior]:
    return prior, deepcopy(prior).to(DEVICE)


def states(prior: ScenePrior, scenes: SceneBatch, level: int, seed: int) -> torch.Tensor:
    """Scenes with the noise of a level, the same on every machine."""
    noised = prior.noised(prior.encode(scenes), torch.Generator().manual_seed(seed), torch.full((len(scenes),), level))
    return noised.x_t


@pytest.mark.parametrize("name", ["dimsum_table", "dimsum_table_continuous", "restaurant_low_clutter"])
@pytest.mark.parametrize("prompt", ["", "A scene with two cups."])
def test_every_step_is_that_of_the_cpu(name: str, prompt: str) -> None:
    here, there = both(ScenePrior.load(name))
    if prompt and not here.conditional:
        pytest.skip("it reads no prompts")
    batch = get_grammar(here.scene_type).sample(np.random.default_rng(0), 4).with_slots(here.config.slots)
    table = here.step_table(8)
    extra = {"guidance": 1.0} if prompt else {}
    for step in range(len(table)):
        x = states(here, batch, int(table.timesteps[step]), step)
        noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(step))
        moved = []
        for prior in (here, there):
            if prompt:
                extra["text"] = prior.encode_prompts([prompt] * len(x))
            reverse = prior.transition(x.to(prior.device), step, table, **extra)
            assert reverse.from_noise(noise.to(prior.device)).device.type == prior.device.type
            moved.append([part.cpu() for part in (reverse.mean, reverse.std)])
        for ours, theirs in zip(*moved, strict=True):
            torch.testing.assert_close(ours, theirs, **STEP)


@pytest.mark.parametrize("strengths", [{"physics_guidance": 1.0}, {"claim_guidance": 2.0}])
def test_guidance_corrects_as_on_the_cpu(strengths: dict[str, float], scenes: SceneBatch) -> None:
    here, there = both(ScenePrior.load("dimsum_table"))
    prompts = ["A scene with three cups and a teapot."] * len(scenes) if "claim_guidance" in strengths else None
    table, means = here.step_table(20), []
    steps = range(len(table) - 4, len(table) - 1)
    for prior in (here, there):
        hook = prior.sampling_hook(len(scenes), 34, len(table), prompts=prompts, **strengths)
        text = None if prompts is None else prior.encode_prompts(prompts)
        assert hook is not None
        for step in steps:
            x = states(here, scenes, int(table.timesteps[step]), step).to(prior.device)
            reverse = hook(step, x, prior.transition(x, step, table, text=text))
            assert reverse.mean.device.type == prior.device.type
            means.append(reverse.mean.cpu())
    for ours, theirs in zip(means[: len(steps)], means[len(steps) :], strict=True):
        # a contact may be corrected along another of two faces that are as near
        apart = (ours - theirs).abs().amax(dim=(1, 2))
        assert (apart < 1e-4).float().mean() >= 0.8


@pytest.mark.parametrize(
    "reward", ["clearance", "clutter", "feasible_share", "object_count", "penetration",
               "prompt_match", "reachability", "stability"],
)  # fmt: skip
def test_rewards_are_those_of_the_cpu(reward: str, scenes: SceneBatch) -> None:
    context = RewardContext(prompts=("A scene with two cups.",) * 4)
    scored = [evaluate_reward(resolve_reward(reward), scenes[:4].to(d), context, strict=True) for d in ("cpu", DEVICE)]
    ours, theirs = scored
    assert theirs.value.device.type == torch.device(DEVICE).type
    torch.testing.assert_close(theirs.value.cpu(), ours.value, rtol=1e-4, atol=1e-5)
    assert torch.equal(theirs.is_valid.cpu(), ours.is_valid)
    for name, term in ours.terms.items():
        torch.testing.assert_close(theirs.terms[name].cpu(), term, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_adapters_agree_on_the_device(process: str) -> None:
    """The torchrl environment and the vector environment take the same steps, bit for bit."""
    from torchrl.envs.utils import check_env_specs

    prior = tiny_prior(process=process).to(DEVICE)
    keys = {"prior": prior, "num_steps": 4, "action_mode": "noise", "reward": "object_count"}
    env, vector = DenoisingTorchRLEnv(3, **keys), DenoisingVectorEnv(3, **keys)
    check_env_specs(env)
    assert env.device is not None
    assert env.device.type == torch.device(DEVICE).type
    env.set_seed(5)
    state, (observation, _) = env.reset(), vector.reset(seed=5)
    for step in range(4):
        action = torch.randn(3, 34, prior.features, generator=torch.Generator().manual_seed(step))
        state["action"] = action.to(DEVICE)
        state = env.step(state)["next"]
        observation, reward, ended, _, _ = vector.step(action.numpy())
        if step < 3:
            assert np.array_equal(state["scene"].cpu().numpy(), observation["scene"])
    assert ended.all()
    assert np.array_equal(state["reward"][:, 0].cpu().numpy(), reward)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_steps_of_an_environment_are_those_of_the_cpu(process: str) -> None:
    envs = [
        DenoisingVectorEnv(2, prior=prior, num_steps=5, action_mode="noise")
        for prior in both(tiny_prior(process=process))
    ]
    start = torch.randn(2, 34, envs[0].core.features, generator=torch.Generator().manual_seed(0))
    for env in envs:
        env.reset(seed=0)
        env.core._x = env.core.prior.initial_from_noise(start.to(env.core.device))  # generators of devices differ
    for step in range(5):
        action = torch.randn(start.shape, generator=torch.Generator().manual_seed(step)).numpy()
        results = [env.step(action) for env in envs]
    finals = [result[4]["final_obs"][0]["scene"] for result in results]
    np.testing.assert_allclose(*finals, atol=1e-4)


@pytest.mark.parametrize("algorithm", ["ddpo_sf", "nft"])
def test_a_resumed_run_is_the_uninterrupted_one(algorithm: str, tmp_path: Path) -> None:
    """Sums of a GPU have no fixed order, so that two runs are equal up to rounding; on a CPU they are equal."""
    keys = {"algorithm": algorithm, "device": DEVICE, "guard_every": 1}
    prior = tiny_prior(process="mixed")
    whole = post_train(small_config(tmp_path / "whole", iterations=2, **keys), prior=prior)
    post_train(small_config(tmp_path / "parts", iterations=1, **keys), prior=prior)
    parts = post_train(small_config(tmp_path / "parts", iterations=2, **keys), prior=prior)
    assert parts.prior.device.type == torch.device(DEVICE).type
    for ours, theirs in zip(parts.history, whole.history, strict=True):
        assert {k: v for k, v in ours.items() if k != "seconds"} == pytest.approx(
            {k: v for k, v in theirs.items() if k != "seconds"}, rel=1e-3, abs=1e-4, nan_ok=True
        )
    tensors = whole.prior.state_dict()
    for name, tensor in parts.prior.state_dict().items():
        torch.testing.assert_close(tensor, tensors[name], rtol=1e-3, atol=1e-4)


def test_log_probabilities_of_the_sampler_and_of_the_loss_agree(scenes: SceneBatch) -> None:
    policy = DenoisingPolicy(tiny_prior(process="mixed").to(DEVICE), 4)
    prior = policy.prior
    x = states(tiny_prior(process="mixed"), scenes, 400, 0).to(DEVICE)
    action, log_prob = policy.draw(x, 2, torch.Generator(DEVICE).manual_seed(0))
    assert torch.equal(policy.log_prob(x, 2, action).detach(), log_prob)
    assert prior.device.type == log_prob.device.type


def test_search_finds_the_scenes_of_the_cpu() -> None:
    """Noise of the search follows from seed and path on the CPU, so that the trees are the same up to rounding."""
    keys = {"num_steps": 4, "budget": 8, "max_depth": 3, "planner": "greedy", "baseline": False}
    found = [run_search(tiny_prior(process="continuous"), "object_count", device=d, **keys) for d in ("cpu", DEVICE)]
    ours, theirs = (outcome.metrics for outcome in found)
    assert ours["search"]["objective"] == pytest.approx(theirs["search"]["objective"], abs=1.0)
    assert ours["nfe"] == theirs["nfe"]
    assert all(outcome.best.tensor.device.type == "cpu" for outcome in found)


def test_evaluation_measures_samples_of_the_device() -> None:
    figures = evaluate("dimsum_table", 8, num_steps=4, device=DEVICE, ready=False)
    assert 0 < figures["objects_mean"] <= 34
