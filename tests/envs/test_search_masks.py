"""The search MDP with a choice of masks: conformance, legal actions, and its agreement with the search MDP."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence

from agents.planning import BeamPlanner, BestOfPlanner, GreedyPlanner, Journal, MCTSPlanner, Session
from scene_envs import check_branchable
from scene_envs.envs import SearchEnv, SearchMaskEnv
from scene_envs.errors import InvalidInputError, UnknownNameError

ID = "scene_envs:SceneEnvs/SearchMask-v0"
MASKS = ["infeasible", "empty", "random"]


def nothing(scene: Any, score: Any, rng: Any) -> torch.Tensor:
    """A mask that never has a slot."""
    return torch.zeros_like(scene.is_empty[0])


@pytest.fixture
def kwargs(prior: Any, free_objects: Any) -> dict[str, Any]:
    return {"prior": prior, "objective": free_objects, "branching": 2, "max_depth": 3, "num_steps": 2, "masks": MASKS}


@pytest.fixture
def env(kwargs: dict[str, Any]) -> SearchMaskEnv:
    env = SearchMaskEnv(**kwargs)
    env.reset(seed=0)
    return env


def test_check_env_passes_with_warnings_as_errors(kwargs: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    blank = lambda batch, highlight: np.zeros((len(batch), 12, 16, 3), np.uint8)  # noqa: E731
    monkeypatch.setattr("scene_envs.envs.search_gymnasium.picture", blank)
    monkeypatch.setattr("webbrowser.open", lambda address: True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(ID, **kwargs).unwrapped)
        check_branchable(gym.make(ID, **kwargs), children=6)


def test_two_environments_with_one_seed_live_the_same_life(kwargs: dict[str, Any]) -> None:
    first, second = gym.make(ID, **kwargs), gym.make(ID, **kwargs)
    assert data_equivalence(first.reset(seed=3), second.reset(seed=3), exact=True)
    for action in (5, 0, 2):
        a, b = first.step(action), second.step(action)
        assert data_equivalence(a, b, exact=True)
    assert a[2:4] == (False, True)  # truncated at max_depth


@pytest.mark.parametrize("mask", MASKS)
def test_with_one_mask_the_tree_is_that_of_the_search(kwargs: dict[str, Any], mask: str) -> None:
    plain = SearchEnv(**{key: value for key, value in kwargs.items() if key != "masks"}, mask=mask)
    choice = SearchMaskEnv(**{**kwargs, "masks": [mask]})
    assert choice.action_space == plain.action_space
    for env in (plain, choice):
        env.reset(seed=5)
    for action in (1, 0):
        assert plain.step(action)[1:] == choice.step(action)[1:]
        assert torch.equal(plain.state.scene, choice.state.scene)
        assert torch.equal(plain.state.mask, choice.state.masks[0])


def test_an_action_regenerates_the_slots_of_its_mask(env: SearchMaskEnv) -> None:
    root = env.clone_state()
    scene = env.scene(root)
    odd = torch.arange(34) % 2 == 1
    assert torch.equal(root.masks[0], scene.is_free[0] & odd)  # what the objective blames
    assert torch.equal(root.masks[1], scene.is_empty[0])
    assert not root.masks[:, 0].any()  # the table
    children = env.expand_batch([(root, action) for action in range(6)])
    for action, child in enumerate(children):
        kept = ~root.masks[action // 2]
        assert torch.equal(child.scene[kept], root.scene[kept])
        assert not torch.equal(child.scene[~kept], root.scene[~kept])
    assert not torch.equal(children[0].scene, children[1].scene)


def test_observation_and_planner_see_all_masks_before_more_inpaintings(env: SearchMaskEnv) -> None:
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    np.testing.assert_array_equal(observation["regenerate"], env.state.masks.numpy())
    assert info["regenerate"] == int(env.state.masks.any(dim=0).sum())
    assert list(env.legal_actions()) == [0, 2, 4, 1, 3, 5]
    assert env.action_masks().all()


def test_masks_without_slots_are_not_legal(kwargs: dict[str, Any]) -> None:
    env = SearchMaskEnv(**{**kwargs, "masks": [nothing, "random"]})
    env.reset(seed=0)
    root = env.state
    assert env.action_masks().tolist() == [False, False, True, True]
    with pytest.raises(InvalidInputError, match=r"mask 'nothing' has no slot.*legal actions are \[2, 3\]"):
        env.expand(root, 0)
    spent = env.nfe
    _, reward, terminated, truncated, info = env.step(1)
    assert (reward, terminated, truncated, info["depth"], env.nfe) == (0.0, False, False, 1, spent)
    assert torch.equal(env.state.scene, root.scene)
    assert [env.step(0)[3] for _ in range(2)] == [False, True]  # the depth is spent all the same


def test_nothing_in_any_mask_ends_the_episode(kwargs: dict[str, Any]) -> None:
    env = SearchMaskEnv(**{**kwargs, "masks": ["random", nothing]})
    env.reset(seed=0)
    env.problem.mask_generators[0] = nothing
    assert env.step(0)[2:4] == (True, False)
    assert not env.action_masks().any()


def test_states_survive_pickling_and_restoring(env: SearchMaskEnv, kwargs: dict[str, Any]) -> None:
    env.step(4)
    state = env.clone_state()
    after = env.step(1)
    other = SearchMaskEnv(**kwargs)
    other.reset(seed=99)
    other.restore_state(pickle.loads(pickle.dumps(state)))
    assert other.state == state
    assert data_equivalence(after[0], other.step(1)[0], exact=True)
    fewer = SearchMaskEnv(**{**kwargs, "masks": ["random"]})
    with pytest.raises(InvalidInputError, match="the state has 3 masks, this environment 1"):
        fewer.reset(options={"state": state})
    plain = SearchEnv(prior=kwargs["prior"], num_steps=1, objective=kwargs["objective"])
    plain.reset(seed=0)
    with pytest.raises(InvalidInputError, match="a MaskChoiceState is needed"):
        env.restore_state(plain.state)


@pytest.mark.parametrize("planner", [BeamPlanner, BestOfPlanner, GreedyPlanner, MCTSPlanner])
def test_planners_search_it(env: SearchMaskEnv, planner: type, tmp_path: Any) -> None:
    root = env.clone_state()
    plan = planner().make(3)
    (result,) = Session(env, journal=Journal(tmp_path / "journal", {})).run(plan, [root], budget=9)
    assert 0 < len(result.values) <= 9
    assert result.best_value == max(result.values)
    assert {path // 2 for path in result.best_path} <= {0, 1, 2}
    again = Journal(tmp_path / "journal", {})
    assert len(again) == len(result.values)
    spent = env.nfe
    assert Session(env, journal=again).run(plan, [root], budget=9)[0].values == result.values
    assert env.nfe == spent  # all came from the journal


def test_the_spec_goes_to_json_and_bad_masks_are_named(
    kwargs: dict[str, Any], prior: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scene_envs.envs.spaces.resolve_prior", lambda name: prior)
    masks = ["random", {"name": "empty", "count": 3}]
    made = gym.make(ID, objective="object_count", masks=masks, num_steps=2)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    assert data_equivalence(made.reset(seed=1), again.reset(seed=1), exact=True)
    assert made.unwrapped.problem.mask_names == ("random", "empty")
    with pytest.raises(UnknownNameError, match="did you mean 'random'"):
        SearchMaskEnv(**{**kwargs, "masks": ["randm"]})
    for bad in ([], "random", None):
        with pytest.raises(InvalidInputError, match="give a list of at least one mask"):
            SearchMaskEnv(**{**kwargs, "masks": bad})
