"""The Gymnasium and torchrl adapters: conformance, determinism, autoreset, and agreement with one another."""

from __future__ import annotations

import json
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode
from torchrl.envs.utils import check_env_specs

import scene_envs.envs.spaces as env_spaces
from agents.priors.testing import tiny_prior
from scene_envs.envs import DenoisingEnv, DenoisingTorchRLEnv, ResetNeededError
from scene_envs.errors import InvalidInputError, UnknownNameError

ID = "scene_envs:SceneEnvs/Denoising-v0"
MODES = ("next_sample", "noise")


@pytest.fixture
def flat_pictures(monkeypatch):
    """Pictures without a renderer: conformance of ``render`` is tested here, drawing is tested elsewhere."""
    blank = lambda batch: np.zeros((len(batch), 12, 16, 3), np.uint8)  # noqa: E731
    monkeypatch.setattr("scene_envs.envs.denoising_adapters.picture", blank)


def actions(count, steps, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(steps, count, 34, 20)).astype(np.float32)


@pytest.mark.parametrize("action_mode", MODES)
def test_check_env_passes_with_warnings_as_errors(prior, height, action_mode, flat_pictures):
    env = gym.make(ID, prior=prior, reward=height, num_steps=3, action_mode=action_mode)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_nothing_but_fixed_objects_is_seen_before_a_mixed_prior_has_drawn_categories(height):
    env = DenoisingEnv(prior=tiny_prior("dimsum_table", process="mixed"), reward=height, num_steps=3)
    observation, info = env.reset(seed=0)
    assert observation["object_mask"].nonzero()[0].tolist() == [0]  # the table
    assert info["objects"] == 1


@pytest.mark.parametrize("action_mode", MODES)
def test_two_environments_with_one_seed_live_the_same_life(prior, height, action_mode):
    first, second = (gym.make(ID, prior=prior, reward=height, num_steps=3, action_mode=action_mode) for _ in "ab")
    first.action_space.seed(1)
    assert data_equivalence(first.reset(seed=3), second.reset(seed=3), exact=True)
    for step in range(12):
        action = first.action_space.sample()
        a, b = first.step(action), second.step(action)
        assert data_equivalence(a, b, exact=True)
        assert a[2] == (step % 3 == 2)
        if a[2]:
            assert data_equivalence(first.reset(), second.reset(), exact=True)


def test_info_has_the_same_numeric_keys_at_reset_and_at_every_step(prior, height):
    env = gym.make(ID, prior=prior, reward=height, num_steps=3)
    _, info = env.reset(seed=0)
    keys = set(info)
    assert keys == {"step", "timestep", "objects", "reward_valid", "term_height"}
    for step in range(1, 4):
        observation, reward, _, _, info = env.step(np.zeros((34, 20), np.float32))
        assert set(info) == keys
        assert all(isinstance(value, (int, float)) for value in info.values())
        assert info["step"] == step
        assert info["objects"] == observation["object_mask"].sum()
        assert info["timestep"] == observation["timestep"][0]
    assert info["term_height"] == reward != 0.0


def test_the_spec_goes_to_json_and_back(prior, monkeypatch):
    monkeypatch.setattr(env_spaces, "resolve_prior", lambda name, device: prior)
    env = gym.make(ID, scene="dimsum_table", reward="object_count", num_steps=2, prior="dimsum_table", workers=0)
    spec = gym.envs.registration.EnvSpec.from_json(env.spec.to_json())
    assert spec.kwargs == {**json.loads(env.spec.to_json())["kwargs"]}
    again = gym.make(spec)
    assert data_equivalence(env.reset(seed=1), again.reset(seed=1), exact=True)


@pytest.mark.parametrize("env_id", ["SceneEnvs/Denoising-v0", "SceneEnvs/Search-v0"])
def test_a_spec_with_a_function_says_why_it_is_no_json(env_id, height):
    key = "reward" if "Denoising" in env_id else "objective"
    env = gym.make(env_id, scene="dimsum_table", num_steps=2, **{key: height})
    with pytest.raises(InvalidInputError, match=f"{key}=.* is no text, number or list; register it"):
        env.spec.to_json()


def test_single_face_names_bad_actions(prior, height):
    env = gym.make(ID, prior=prior, reward=height, num_steps=3)
    env.reset(seed=0)
    with pytest.raises(InvalidInputError, match=r"must be \(34, 20\), that is \(slot, feature\)"):
        env.step(np.zeros((33, 20), np.float32))
    action = np.zeros((34, 20), np.float32)
    action[2, 5] = np.nan
    with pytest.raises(InvalidInputError, match="nan at slot 2, feature 5"):
        env.step(action)
    with pytest.raises(InvalidInputError, match="not an array of numbers"):
        env.step("left")
    with pytest.raises(InvalidInputError, match="render_mode='human'"):
        DenoisingEnv(prior=prior, reward=height, render_mode="human")


@pytest.mark.parametrize("action_mode", MODES)
def test_vector_rows_are_the_single_environments(height, action_mode):
    """With a real network: float tolerance, because batches of other sizes round differently."""
    prior, steps = tiny_prior(), 3
    kwargs = {"prior": prior, "reward": height, "num_steps": steps, "action_mode": action_mode}
    vector = gym.make_vec(ID, num_envs=3, **kwargs)
    singles = [gym.make(ID, **kwargs) for _ in range(3)]
    batched, _ = vector.reset(seed=10)
    rows = [env.reset(seed=10 + i)[0] for i, env in enumerate(singles)]
    for action in actions(3, 2 * steps):
        for key in batched:
            np.testing.assert_allclose(batched[key], np.stack([row[key] for row in rows]), atol=2e-4)
        batched, rewards, terminated, truncated, info = vector.step(action)
        results = [env.step(action[i]) for i, env in enumerate(singles)]
        np.testing.assert_allclose(rewards, [r[1] for r in results], atol=1e-4)
        assert terminated.tolist() == [r[2] for r in results]
        assert not truncated.any()
        final = info.get("final_info", info)
        np.testing.assert_allclose(final["term_height"], [r[4]["term_height"] for r in results], atol=1e-4)
        rows = [env.reset()[0] if r[2] else r[0] for env, r in zip(singles, results, strict=True)]


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_vector_matches_gymnasiums_own_vectorisation(prior, height, mode):
    """Same observations, rewards, ends and infos as SyncVectorEnv over single environments, in every mode."""
    kwargs = {"prior": prior, "reward": height, "num_steps": 3, "action_mode": "noise"}
    ours = gym.make_vec(ID, num_envs=2, autoreset_mode=mode.value, **kwargs)
    theirs = gym.make_vec(ID, num_envs=2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **kwargs)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is mode
    assert data_equivalence(ours.reset(seed=4), theirs.reset(seed=4))
    for action in actions(2, 8):
        a, b = ours.step(action), theirs.step(action)
        assert data_equivalence(a, b), (a, b)
        assert a[0] in ours.observation_space
        if mode is AutoresetMode.DISABLED and a[2].any():
            mask = np.array([True, True])
            assert data_equivalence(
                ours.reset(options={"reset_mask": mask}), theirs.reset(options={"reset_mask": mask.copy()})
            )


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_partial_resets_stagger_episodes_as_gymnasium_does(prior, height, mode):
    kwargs = {"prior": prior, "reward": height, "num_steps": 3, "action_mode": "noise"}
    ours = gym.make_vec(ID, num_envs=2, autoreset_mode=mode, **kwargs)
    theirs = gym.make_vec(ID, num_envs=2, vectorization_mode="sync", vector_kwargs={"autoreset_mode": mode}, **kwargs)
    ours.reset(seed=4), theirs.reset(seed=4)
    mask = np.array([False, True])
    for index, action in enumerate(actions(2, 9)):
        a, b = ours.step(action), theirs.step(action)
        assert data_equivalence(a, b), (index, a, b)
        again = a[2] if mode is AutoresetMode.DISABLED else mask & (index == 0)
        if again.any():
            options = [{"reset_mask": again.copy()} for _ in "ab"]
            assert data_equivalence(ours.reset(options=options[0]), theirs.reset(options=options[1]))


def test_disabled_mode_asks_for_the_reset_it_needs(prior, height):
    env = gym.make_vec(ID, num_envs=2, autoreset_mode="Disabled", prior=prior, reward=height, num_steps=1)
    env.reset(seed=0)
    env.step(np.zeros((2, 34, 20), np.float32))
    env.reset(options={"reset_mask": np.array([True, False])})
    with pytest.raises(ResetNeededError, match="environment 1 ended"):
        env.step(np.zeros((2, 34, 20), np.float32))


def test_returned_arrays_do_not_alias_the_state(prior, height):
    env = gym.make_vec(ID, num_envs=2, prior=prior, reward=height, num_steps=3, action_mode="noise")
    twin = gym.make_vec(ID, num_envs=2, prior=prior, reward=height, num_steps=3, action_mode="noise")
    observation, _ = env.reset(seed=0)
    twin.reset(seed=0)
    observation["scene"][:] = 99.0
    action = actions(2, 1)[0]
    assert data_equivalence(env.step(action), twin.step(action), exact=True)


def test_vector_seeds_and_bad_arguments(prior, height):
    env = gym.make_vec(ID, num_envs=2, prior=prior, reward=height, num_steps=1)
    by_number, _ = env.reset(seed=5)
    by_list, _ = env.reset(seed=[5, 6])
    assert data_equivalence(by_number, by_list, exact=True)
    assert env.np_random_seed == (5, 6)
    with pytest.raises(InvalidInputError, match="3 seeds for 2 environments"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(InvalidInputError, match="reset_mask"):
        env.reset(options={"reset_mask": np.array([False, False])})
    with pytest.raises(UnknownNameError, match="did you mean 'SameStep'"):
        gym.make_vec(ID, num_envs=2, prior=prior, reward=height, autoreset_mode="SameStp")
    with pytest.raises(InvalidInputError, match="num_envs=0"):
        gym.make_vec(ID, num_envs=0, prior=prior, reward=height)


@pytest.mark.slow
def test_physics_rewards_bring_their_terms_and_pictures_their_shape():
    pytest.importorskip("pybullet")
    kwargs = {"prior": tiny_prior(slots=6), "slots": 6, "reward": "feasible_objects", "num_steps": 1}
    vector = gym.make_vec(ID, num_envs=2, render_mode="rgb_array", **kwargs)
    _, info = vector.reset(seed=0)
    terms = {"term_free_objects", "term_feasible_fraction", "term_deepest_mm"}
    assert terms <= set(info)
    _, rewards, _, _, info = vector.step(vector.action_space.sample())
    final = info["final_info"]
    np.testing.assert_allclose(rewards, final["term_free_objects"] * final["term_feasible_fraction"], rtol=1e-6)
    frames = vector.render()
    assert len(frames) == 2
    assert frames[0].dtype == np.uint8
    assert frames[0].ndim == 3


def test_wrappers_of_gymnasium_work_on_the_vector_face(prior, height):
    env = gym.make_vec(ID, num_envs=2, prior=prior, reward=height, num_steps=3)
    env = gym.wrappers.vector.RecordEpisodeStatistics(env)
    env.reset(seed=0)
    for action in actions(2, 3):
        _, rewards, _, _, info = env.step(action)
    np.testing.assert_allclose(info["episode"]["r"], rewards, rtol=1e-6)
    assert info["episode"]["l"].tolist() == [3, 3]


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
