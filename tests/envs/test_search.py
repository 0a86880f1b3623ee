"""The search MDP: conformance, seeded trees, masks, Φ, and the planner's interface."""

from __future__ import annotations

import pickle
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence

from agents.priors.testing import tiny_prior
from rewards.base import RewardOutput
from scene_envs.envs import ResetNeededError, SearchEnv
from scene_envs.envs.masks import infeasible_mask, random_mask
from scene_envs.envs.scoring import Score
from scene_envs.envs.search import NodeRandomness
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.scene import SceneBatch

ID = "scene_envs:SceneEnvs/Search-v0"


@pytest.fixture
def env(prior, free_objects):
    return SearchEnv(prior=prior, objective=free_objects, branching=3, max_depth=3, num_steps=2)


@pytest.mark.slow
def test_check_env_passes_with_warnings_as_errors(prior, free_objects, monkeypatch):
    blank = lambda batch: np.zeros((len(batch), 12, 16, 3), np.uint8)  # noqa: E731
    monkeypatch.setattr("scene_envs.envs.search_gymnasium.picture", blank)
    env = gym.make(ID, prior=prior, objective=free_objects, branching=3, max_depth=3, num_steps=2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped)


def test_two_environments_with_one_seed_live_the_same_life(prior, free_objects):
    kwargs = {"prior": prior, "objective": free_objects, "branching": 3, "max_depth": 3, "num_steps": 2}
    first, second = gym.make(ID, **kwargs), gym.make(ID, **kwargs)
    assert data_equivalence(first.reset(seed=3), second.reset(seed=3), exact=True)
    for action in (2, 0, 1):
        a, b = first.step(action), second.step(action)
        assert data_equivalence(a, b, exact=True)
    assert a[2]


def test_make_vec_runs_copies_with_their_own_seeds(prior, free_objects):
    kwargs = {"prior": prior, "objective": free_objects, "branching": 3, "max_depth": 3, "num_steps": 2}
    vector, single = gym.make_vec(ID, num_envs=2, **kwargs), gym.make(ID, **kwargs)
    batched, _ = vector.reset(seed=3)
    row, _ = single.reset(seed=4)
    assert data_equivalence({key: value[1] for key, value in batched.items()}, row, exact=True)
    assert vector.step(np.array([0, 2]))[1][1] == single.step(2)[1]


def test_rewards_telescope_to_the_gain_in_phi(env):
    env.reset(seed=0)
    start = env.evaluate()
    total = 0.0
    for action in (0, 1, 2):
        observation, reward, terminated, truncated, info = env.step(action)
        total += reward
        assert observation["value"][0] == pytest.approx(info["value"])
        assert not truncated
    assert terminated
    assert total == pytest.approx(env.evaluate() - start)
    assert env.legal_actions() == []
    assert env.action_masks().tolist() == [False] * 3
    with pytest.raises(ResetNeededError, match="max_depth=3"):
        env.step(0)


def test_phi_is_objective_over_free_slots(env):
    """FreeObjects counts the free objects in even slots: 16 of the 33 free slots at most."""
    env.reset(seed=0)
    scene = env.scene()
    good = int((scene.is_free[0] & (torch.arange(34) % 2 == 0)).sum())
    assert env.state.objective == good
    assert env.evaluate() == pytest.approx(good / 33)


def test_phi_is_clipped_to_the_unit_interval(prior):
    for sign, expected in ((1.0, 1.0), (-1.0, 0.0)):
        objective = lambda b, c, s=sign: RewardOutput(torch.full((len(b),), s * 1e3))  # noqa: E731
        env = SearchEnv(prior=prior, objective=objective, num_steps=1)
        env.reset(seed=0)
        assert env.evaluate() == expected


def test_children_do_not_depend_on_order_or_company(env):
    env.reset(seed=1)
    root = env.clone_state()
    together = env.expand_batch([(root, 0), (root, 1), (root, 2)])
    backwards = [env.expand(root, action) for action in (2, 1, 0)][::-1]
    assert together == backwards  # equality compares seed, path, scene and mask
    grandchild = env.expand(together[1], 2)
    assert grandchild.path == (1, 2)
    assert grandchild.depth == 2
    mixed = env.expand_batch([(root, 2), (together[1], 2)])
    assert mixed == [together[2], grandchild]
    assert not torch.equal(together[0].scene, together[1].scene)
    env.step(1)
    env.step(2)
    assert env.clone_state() == grandchild


def test_a_real_network_agrees_up_to_rounding(free_objects):
    """Batches of other sizes round differently in a network; the noise is the same."""
    env = SearchEnv(prior=tiny_prior(), objective=free_objects, branching=3, max_depth=2, num_steps=2)
    env.reset(seed=0)
    root = env.clone_state()
    together = env.expand_batch([(root, a) for a in range(3)])
    for action, child in enumerate(together):
        alone = env.expand(root, action)
        torch.testing.assert_close(alone.scene, child.scene, atol=1e-4, rtol=1e-4)
        kept = ~root.mask
        assert torch.equal(child.scene[kept], root.scene[kept])


def test_only_masked_slots_change_and_welded_ones_never(prior, free_objects):
    env = SearchEnv(prior=prior, objective=free_objects, num_steps=2, mask="infeasible")
    env.reset(seed=2)
    root = env.clone_state()
    assert root.mask.any()
    assert not root.mask[0]  # the table
    child = env.expand(root, 0)
    assert torch.equal(child.scene[~root.mask], root.scene[~root.mask])
    assert not torch.equal(child.scene[root.mask], root.scene[root.mask])
    scene = env.scene(root)
    blamed = scene.is_free[0] & (torch.arange(34) % 2 == 1)
    assert torch.equal(root.mask, blamed | scene.is_empty[0])


def test_states_survive_pickling_and_restoring(env, prior, free_objects):
    env.reset(seed=4)
    env.step(1)
    state = env.clone_state()
    after = env.step(2)
    other = SearchEnv(prior=prior, objective=free_objects, branching=3, max_depth=3, num_steps=2)
    other.reset(seed=99)
    other.restore_state(pickle.loads(pickle.dumps(state)))
    assert other.state == state
    again = other.step(2)
    assert data_equivalence(after[0], again[0], exact=True)
    assert after[1:4] == again[1:4]


def test_reset_from_a_given_state_or_scene(env):
    env.reset(seed=4)
    state, scene = env.clone_state(), env.scene()
    env.reset(seed=5, options={"state": state})
    assert env.state == state
    env.reset(seed=5, options={"scene": scene})
    assert torch.equal(env.state.scene, scene.tensor[0])
    assert env.nfe == 0  # nothing was generated
    with pytest.raises(InvalidInputError, match="34 slots"):
        env.reset(options={"scene": SceneBatch.empty("dimsum_table", 2)})
    with pytest.raises(InvalidInputError, match="SearchState"):
        env.restore_state("here")


def test_best_state_is_the_highest_phi_seen_by_steps_and_expansions(env):
    env.reset(seed=6)
    root = env.clone_state()
    children = env.expand_batch([(root, a) for a in range(3)])
    best = max([root, *children], key=lambda state: state.value)
    assert env.best_state() == best
    env.step(0)
    assert env.best_state().value >= best.value
    env.reset(seed=6)
    assert env.best_state() == root  # forgotten at reset


def test_invalid_children_keep_the_parents_phi_and_are_flagged(prior):
    class Moody:
        fails = False

        def __call__(self, batch, context):
            if self.fails:
                raise RuntimeError("not today")
            return RewardOutput(torch.full((len(batch),), 11.0))

    objective = Moody()
    env = SearchEnv(prior=prior, objective=objective, num_steps=1)
    _, info = env.reset(seed=0)
    assert info["reward_valid"] == 1
    objective.fails = True
    _, reward, _, _, info = env.step(0)
    assert reward == 0.0
    assert info["reward_valid"] == 0
    assert env.evaluate() == pytest.approx(11 / 33)
    assert env.best_state().path == ()


def test_nfe_counts_denoiser_evaluations_per_scene(env):
    _, info = env.reset(seed=0)
    assert info["nfe"] == 2  # one root, two steps
    env.expand_batch([(env.state, a) for a in range(3)])
    assert env.nfe == 8


def test_randomness_of_nodes_is_theirs_alone():
    seeds = {
        NodeRandomness.at(seed, path).noise.initial_seed()
        for seed in (0, 1)
        for path in ((), (0,), (1,), (0, 0), (0, 1), (1, 0))
    }
    assert len(seeds) == 12


def test_masks_fall_back_to_a_random_half():
    everything = torch.zeros(1, 34, dtype=torch.long) + 1
    everything[0, 0] = 0
    full = SceneBatch.from_parts(torch.zeros(1, 34, 3), torch.eye(3).expand(1, 34, 3, 3), everything, "dimsum_table")
    value, valid = torch.zeros(1), torch.ones(1, dtype=torch.bool)
    all_good = Score(value, valid, object_flags={"feasible": full.is_free})
    silent = Score(value, valid)
    for score in (all_good, silent):
        mask = infeasible_mask(full, score, np.random.default_rng(0))
        assert int(mask.sum()) == 17  # half of 33, rounded up
        assert not mask[0]
        assert torch.equal(mask, random_mask(full, score, np.random.default_rng(0)))
    by_credit = Score(value, valid, per_object=torch.arange(34)[None] - 3.0)
    assert torch.nonzero(infeasible_mask(full, by_credit, np.random.default_rng(0))).flatten().tolist() == [1, 2, 3]


def test_spec_goes_to_json_and_actions_are_checked(env, prior, free_objects, monkeypatch):
    monkeypatch.setattr("scene_envs.envs.spaces.resolve_prior", lambda name: prior)
    made = gym.make(ID, objective="object_count", branching=2, num_steps=2)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    assert data_equivalence(made.reset(seed=1), again.reset(seed=1), exact=True)
    env.reset(seed=0)
    for bad in (3, -1, 0.5, "left"):
        with pytest.raises(InvalidInputError, match=r"inpaintings 0\.\.2"):
            env.step(bad)
    with pytest.raises(UnknownNameError, match="did you mean 'random'"):
        SearchEnv(prior=prior, objective=free_objects, mask="randm")
    with pytest.raises(InvalidInputError, match="branching=0"):
        SearchEnv(prior=prior, objective=free_objects, branching=0)
    with pytest.raises(ResetNeededError):
        SearchEnv(prior=prior, objective=free_objects).clone_state()
