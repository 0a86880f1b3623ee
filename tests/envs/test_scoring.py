"""Scoring in environments: rewards and priors by name, and prompts."""

from __future__ import annotations

import json
import logging
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence
from torchrl.envs.utils import check_env_specs

import scene_envs.envs.spaces as env_spaces
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.datasets.prompts import parse_prompt
from scene_envs.envs import DenoisingTorchRLEnv, SearchProblem
from scene_envs.envs import scoring as resolvers
from scene_envs.envs.scoring import grammar_prompts
from scene_envs.errors import InvalidInputError, MissingDependencyError, UnknownNameError
from scene_envs.scene_types import get_scene_type

ID = "scene_envs:SceneEnvs/Denoising-v0"


def test_unknown_names_offer_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'feasible_objects'"):
        gym.make(ID, reward="feasible_object")
    with pytest.raises(UnknownNameError, match="did you mean 'dimsum_table'"):
        gym.make(ID, prior="dimsum_tabel")


def test_without_a_resolver_the_error_says_how_to_get_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resolvers, "plugin_entry_points", lambda group: {})
    resolvers._resolver.cache_clear()
    with pytest.raises(MissingDependencyError, match=r"resolves a reward.*pip install -e"):
        resolvers.resolve_reward("object_count")
    resolvers._resolver.cache_clear()


@pytest.mark.parametrize("name", ["Denoising-v0", "Search-v0", "SearchMask-v0"])
def test_the_scene_type_is_that_of_the_prior(name: str, tmp_path: Path) -> None:
    own = tiny_prior("pantry_shelf").save(tmp_path)
    goal = "reward" if name == "Denoising-v0" else "objective"
    made = {goal: "object_count", "num_steps": 2, "prior": str(own)}
    env = gym.make(f"scene_envs:SceneEnvs/{name}", **made)
    pantry = get_scene_type("pantry_shelf")
    assert env.observation_space["object_mask"].n == pantry.slots
    assert "scene" not in env.spec.kwargs
    with pytest.raises(InvalidInputError, match="makes scenes of 'pantry_shelf', the environment asks for"):
        gym.make(f"scene_envs:SceneEnvs/{name}", scene="dimsum_table", **made)


_WRONG = {
    "slots": [0, 10**9, 10**5000, True, "6"],
    "num_steps": [0, 10**30, True, 1.5],
    "guidance": ["1", None, [], float("nan"), 10**5000, object()],
    "max_action": ["1", None, [1, 2], -1, 10**400],
    "max_depth": [10**30, True, "a"],
    "branching": [10**30, True],
    "objective_scale": ["", [1], {"name": "a"}, 0, 10**400],
}


@pytest.mark.parametrize("name", _WRONG)
def test_numbers_of_wrong_type_or_size_are_refused_in_words(name):
    env = "Search-v0" if name in ("max_depth", "branching", "objective_scale") else "Denoising-v0"
    for value in _WRONG[name]:
        with pytest.raises(InvalidInputError, match=f"{name}=.* must be"):
            gym.make(f"SceneEnvs/{env}", disable_env_checker=True, **{name: value})


SEARCH = "scene_envs:SceneEnvs/Search-v0"
PROMPTS = ["A scene with two cups.", "A scene with three plates and a table.", "A scene with 9 objects."]


@pytest.fixture(scope="module")
def reader() -> ScenePrior:
    return tiny_prior(process="mixed", text=True)


def make(reader: ScenePrior, **settings: Any) -> gym.Env[Any, Any]:
    return gym.make(ID, prior=reader, num_steps=2, **settings)


@pytest.mark.parametrize("action_mode", ["next_sample", "noise"])
def test_check_env_passes_with_warnings_as_errors(reader, action_mode):
    env = make(reader, prompt=PROMPTS, action_mode=action_mode, reward="prompt_match")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("prompt", [None, PROMPTS])
def test_check_env_specs(reader, prompt):
    env = DenoisingTorchRLEnv(2, prior=reader, num_steps=2, action_mode="noise", prompt=prompt)
    check_env_specs(env, break_when_any_done="both", seed=0)


def test_the_prompt_is_seen_as_the_tokens_of_the_prior(reader, prior):
    observation, _ = make(reader, prompt=PROMPTS[1]).reset(seed=0)
    assert observation["prompt"].tolist() == reader.read_prompts([PROMPTS[1]], 34)[0].tolist()
    nothing, _ = make(reader).reset(seed=0)
    assert nothing["prompt"].tolist() == reader.read_prompts([""], 34)[0].tolist()
    assert np.array_equal(nothing["scene"], observation["scene"])  # x_T does not hang on the prompt
    plain, _ = make(prior).reset(seed=0)
    assert set(plain) == {"scene", "timestep", "object_mask"}


@pytest.mark.slow
def test_adapters_agree_and_prompts_hang_on_the_seed(reader):
    kwargs = {"prior": reader, "num_steps": 2, "action_mode": "noise", "prompt": PROMPTS, "guidance": 0.5}
    vector, env = gym.make_vec(ID, num_envs=3, **kwargs), DenoisingTorchRLEnv(3, **kwargs)
    singles = [gym.make(ID, **kwargs) for _ in range(3)]
    batched, _ = vector.reset(seed=5)
    env.set_seed(5)
    current = env.reset()
    rows = [single.reset(seed=5 + i)[0] for i, single in enumerate(singles)]
    draw = torch.Generator().manual_seed(0)
    seen = set()
    for _ in range(6):
        for key in ("scene", "timestep", "object_mask", "prompt"):
            assert torch.equal(current[key], torch.from_numpy(batched[key]))
            np.testing.assert_allclose(batched[key], np.stack([row[key] for row in rows]), atol=2e-4)
        seen |= {tuple(tokens) for tokens in batched["prompt"].tolist()}
        action = torch.randn(3, 34, 20, generator=draw)
        batched, *_ = vector.step(action.numpy())
        _, current = env.step_and_maybe_reset(current.set("action", action))
        results = [single.step(action[i].numpy()) for i, single in enumerate(singles)]
        rows = [single.reset()[0] if r[2] else r[0] for single, r in zip(singles, results, strict=True)]
    assert len(seen) > 1
    again, _ = vector.reset(seed=5)
    assert data_equivalence(again, vector.reset(seed=5)[0], exact=True)


@pytest.mark.parametrize("guidance", [0.0, 2.0])
def test_noise_mode_follows_the_prompt_and_normal_noise_samples_the_prior(reader, guidance):
    env = DenoisingTorchRLEnv(2, prior=reader, num_steps=3, action_mode="noise", prompt=PROMPTS[0], guidance=guidance)
    other = DenoisingTorchRLEnv(2, prior=reader, num_steps=3, action_mode="noise", prompt=PROMPTS[2])
    rngs = [np.random.default_rng(seed) for seed in (0, 1)]
    env.core.reset(rngs)
    other.core.reset([np.random.default_rng(seed) for seed in (0, 1)])
    x, table = env.core.x, reader.step_table(3)
    text = reader.encode_prompts([PROMPTS[0]] * 2)
    for step in range(3):
        noise = torch.randn(2, 34, 20, generator=torch.Generator().manual_seed(step))
        x = reader.clamp(reader.transition(x, step, table, text=text, guidance=guidance).from_noise(noise))
        env.core.step(noise)
        other.core.step(noise)
        torch.testing.assert_close(env.core.x, x, atol=1e-5, rtol=1e-5)
    assert not torch.equal(env.core.x, other.core.x)


def test_next_sample_mode_only_shows_the_prompt(reader, monkeypatch):
    monkeypatch.setattr(type(reader), "encode_tokens", lambda *_: pytest.fail("the text was encoded"))
    env = make(reader, prompt=PROMPTS)
    env.reset(seed=0)
    env.step(np.zeros((34, 20), np.float32))


def test_the_reward_is_told_the_prompt_of_every_episode(reader):
    seen: list[tuple[str, ...] | None] = []

    def reward(batch, context):
        seen.append(context.prompts)
        return batch.counts.float()

    env = DenoisingTorchRLEnv(4, prior=reader, num_steps=1, reward=reward, prompt=PROMPTS)
    env.set_seed(0)
    env.rollout(1)
    assert env.core.prompts == seen[-1]
    assert set(env.core.prompts) <= set(PROMPTS)
    env.rollout(1, auto_reset=False, tensordict=env.reset(prompts=["A scene with a cup."] * 4))
    assert seen[-1] == ("A scene with a cup.",) * 4
    DenoisingTorchRLEnv(1, prior=reader, num_steps=1, reward=reward).rollout(1)
    assert seen[-1] is None


def test_prompts_of_the_grammar_are_true_english(reader):
    scene_type = get_scene_type("dimsum_table")
    bank = grammar_prompts(scene_type, 34)
    assert len(bank) > 100
    for prompt in bank[:20]:
        parse_prompt(prompt, scene_type)
    env = DenoisingTorchRLEnv(8, prior=reader, num_steps=1, prompt="grammar")
    env.set_seed(0)
    env.reset()
    assert len(set(env.core.prompts)) > 3
    assert set(env.core.prompts) <= set(bank)


def test_prompts_go_to_json_and_back(reader, monkeypatch):
    monkeypatch.setattr(env_spaces, "resolve_prior", lambda name, device: reader)
    env = gym.make(ID, num_steps=2, prior="mine", prompt=PROMPTS, guidance=1.0, action_mode="noise")
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert json.loads(env.spec.to_json())["kwargs"]["prompt"] == PROMPTS
    assert data_equivalence(env.reset(seed=1), gym.make(spec).reset(seed=1), exact=True)


def test_prompts_that_cannot_be_followed_are_refused(reader, prior, caplog):
    for wrong, settings, message in (
        (prior, {"prompt": PROMPTS[0]}, "trained without text"),
        (reader, {"guidance": 1.0, "action_mode": "noise"}, "guidance=1 strengthens a prompt, and prompt=None"),
        (reader, {"prompt": PROMPTS[0], "guidance": 1.0}, "action_mode='next_sample' takes none"),
        (reader, {"prompt": PROMPTS[0], "guidance": float("nan"), "action_mode": "noise"}, "finite"),
        (reader, {"prompt": "A scene with 99 objects."}, "asks for 99 objects"),
        (reader, {"prompt": []}, r"prompt=\[\] must be"),
        (reader, {"prompt": 3}, "prompt=3 must be"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            make(wrong, **settings)
    with caplog.at_level(logging.WARNING):
        env = make(reader, prompt="A scene with a zeppelin.")
        for _ in range(3):
            env.reset(seed=0)
    assert caplog.text.count("zeppelin") == 1


# -- search ------------------------------------------------------------------------------------------


def test_search_inpaints_under_the_prompt(reader):
    kwargs = {"prior": reader, "objective": "prompt_match", "num_steps": 2, "max_depth": 2, "branching": 2}
    first = SearchProblem(prompt=PROMPTS[0], objective_scale=1.0, **kwargs)
    second = SearchProblem(prompt=PROMPTS[2], objective_scale=1.0, **kwargs)
    guided = SearchProblem(prompt=PROMPTS[0], objective_scale=1.0, guidance=1.0, **kwargs)
    roots = [problem.root(seed=3) for problem in (first, second, guided)]
    assert roots[0] == first.root(seed=3)
    assert not torch.equal(roots[0].scene, roots[1].scene)
    assert not torch.equal(roots[0].scene, roots[2].scene)
    assert all(root.valid and 0.0 <= root.value <= 1.0 for root in roots)
    (child,) = first.expand_batch([(roots[0], 0)])
    kept = ~roots[0].mask
    assert torch.equal(child.scene[kept], roots[0].scene[kept])
    assert (first.evaluations, guided.evaluations) == (6, 4)  # two roots and a child; one root with both branches


def test_search_hands_on_claim_and_physics_guidance(reader, monkeypatch):
    told, inpaint = [], reader.inpaint

    def listening(*args, claim_guidance=0.0, physics_guidance=0.0, **kwargs):
        told.append((claim_guidance, physics_guidance))
        return inpaint(*args, claim_guidance=claim_guidance, physics_guidance=physics_guidance, **kwargs)

    monkeypatch.setattr(reader, "inpaint", listening)
    for claims, physics in ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0)):
        settings = {"num_steps": 2, "claim_guidance": claims, "physics_guidance": physics}
        problem = SearchProblem(prior=reader, prompt=PROMPTS[0], objective="prompt_match", **settings)
        assert problem.root(seed=3).valid
    assert SearchProblem(prior=reader, objective="object_count", num_steps=2, physics_guidance=1.0).root(seed=3).valid
    assert told == [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)]


def test_search_shows_its_prompt(reader):
    kwargs = {"prior": reader, "objective": "prompt_match", "num_steps": 2, "max_depth": 2, "objective_scale": 1.0}
    env = gym.make(SEARCH, prompt=PROMPTS[0], **kwargs)
    observation, _ = env.reset(seed=0)
    assert observation["prompt"].tolist() == reader.read_prompts([PROMPTS[0]], 34)[0].tolist()
    check_env(env.unwrapped, skip_render_check=True)
    assert "prompt" not in gym.make(SEARCH, prior=reader, num_steps=2).observation_space.spaces


def test_search_refuses_what_it_cannot_follow(reader, prior):
    with pytest.raises(InvalidInputError, match="trained without text"):
        gym.make(SEARCH, prior=prior, prompt=PROMPTS[0])
    with pytest.raises(InvalidInputError, match="strengthens a prompt"):
        gym.make(SEARCH, prior=reader, guidance=1.0)
    with pytest.raises(InvalidInputError, match=r"claim_guidance=2 guides scenes .* prompt=None has none"):
        gym.make(SEARCH, prior=reader, claim_guidance=2.0)
    with pytest.raises(InvalidInputError, match="claim_guidance=-1 must be a finite number of at least 0"):
        gym.make(SEARCH, prior=reader, prompt=PROMPTS[0], claim_guidance=-1)
    with pytest.raises(InvalidInputError, match="physics_guidance=2 must be a number from 0 to 1"):
        gym.make(SEARCH, prior=reader, physics_guidance=2)
    with pytest.raises(InvalidInputError, match="one text"):
        gym.make(SEARCH, prior=reader, prompt=PROMPTS)
