"""The search MDP, with one mask and with several: conformance, seeded trees, Φ, and the planner's interface."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Mapping
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence

from agents.planning import BeamPlanner, BestOfPlanner, GreedyPlanner, Journal, MCTSPlanner, Session
from agents.priors.testing import tiny_prior
from rewards.base import RewardOutput
from rewards.composite import Clip
from scene_envs.envs import ResetNeededError, SearchEnv, SearchMaskEnv
from scene_envs.envs.search import node_randomness
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.render import render
from scene_envs.scene import SceneBatch
from tests.helpers.batch_reward import AboveTheMean

ID = "scene_envs:SceneEnvs/Search-v0"


@pytest.fixture
def env(prior, free_objects):
    return SearchEnv(prior=prior, objective=free_objects, branching=3, max_depth=3, num_steps=2)


def test_check_env_passes_with_warnings_as_errors(prior, free_objects, monkeypatch):
    blank = lambda batch, highlight: np.zeros((len(batch), 12, 16, 3), np.uint8)  # noqa: E731
    monkeypatch.setattr("scene_envs.envs.search_gymnasium.picture", blank)
    monkeypatch.setattr("webbrowser.open", lambda address: True)
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
    assert a[2:4] == (False, True)  # truncated at max_depth


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
        assert not terminated
    assert truncated
    assert total == pytest.approx(env.evaluate() - start)
    assert list(env.legal_actions()) == []
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


def plain_parts(value: Any) -> list[Any]:
    """The leaves of nested data."""
    if is_dataclass(value):
        value = [getattr(value, field.name) for field in fields(value)]
    if isinstance(value, Mapping):
        value = list(value.values())
    return [part for item in value for part in plain_parts(item)] if isinstance(value, list | tuple) else [value]


@pytest.mark.parametrize("name", ["env", "mask_env"])
def test_planners_can_rely_on_states(name: str, request: pytest.FixtureRequest) -> None:
    """States are immutable plain data, and expansion changes neither its state nor the current one."""
    env = request.getfixturevalue(name)
    env.reset(seed=0)
    root = env.clone_state()
    before = pickle.dumps(root)
    actions = list(env.legal_actions(root))[:3]
    children = env.expand_batch([(root, action) for action in actions])
    backwards = [env.expand(pickle.loads(before), action) for action in reversed(actions)][::-1]
    assert children == backwards
    assert [child.value for child in children] == [child.value for child in backwards]
    assert pickle.dumps(root) == before
    assert env.clone_state() is root
    for state in (root, *children):
        assert pickle.loads(pickle.dumps(state)) == state
        assert 0.0 <= env.evaluate(state) <= 1.0
        assert all(isinstance(part, bool | int | float | torch.Tensor | None) for part in plain_parts(state))
        with pytest.raises(FrozenInstanceError):
            state.value = 1.0
        env.restore_state(state)
        assert env.clone_state() is state


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
    assert torch.equal(root.mask, blamed)


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
        node_randomness(seed, path)[0].initial_seed()
        for seed in (0, 1)
        for path in ((), (0,), (1,), (0, 0), (0, 1), (1, 0))
    }
    assert len(seeds) == 12


def test_nothing_masked_ends_the_episode(prior, free_objects):
    nothing = lambda scene, score, rng: torch.zeros(34, dtype=torch.bool)  # noqa: E731
    env = SearchEnv(prior=prior, objective=free_objects, num_steps=1, mask=lambda s, r, rng: s.is_empty[0])
    env.reset(seed=0)
    env.problem.mask_generators = [nothing]
    _, _, terminated, truncated, _ = env.step(0)
    assert (terminated, truncated) == (True, False)
    assert list(env.legal_actions()) == []
    with pytest.raises(ResetNeededError, match="nothing left to improve"):
        env.step(0)
    with pytest.raises(InvalidInputError, match="nothing is left to improve"):
        env.expand(env.state, 0)


@pytest.mark.parametrize(
    ("objective", "scale"), [("object_count", 34), ("feasible_objects", 33), ("feasible_share", 1)]
)
def test_the_scale_is_the_largest_value_that_the_objective_declares(prior, objective, scale):
    assert SearchEnv(prior=prior, objective=objective, num_steps=1).problem.scale == scale
    assert SearchEnv(prior=prior, objective=objective, num_steps=1, objective_scale=7.0).problem.scale == 7


def test_the_largest_value_ends_the_episode_and_a_larger_objective_is_told(prior, caplog):
    env = SearchEnv(prior=prior, objective=lambda b, c: RewardOutput(torch.full((len(b),), 50.0)), num_steps=1)
    env.reset(seed=0)
    assert (env.evaluate(), env.state.objective) == (1.0, 50.0)
    assert list(env.legal_actions()) == []
    assert "the objective is 50, more than objective_scale=33" in caplog.text


def test_an_nfe_budget_truncates(prior, free_objects):
    env = SearchEnv(prior=prior, objective=free_objects, num_steps=2, max_nfe=6)
    env.reset(seed=0)
    assert env.step(0)[2:4] == (False, False)
    assert env.step(0)[2:4] == (False, True)
    with pytest.raises(ResetNeededError, match="max_nfe=6"):
        env.step(0)


def test_without_masked_removes_what_is_still_masked(env):
    env.reset(seed=0)
    state = env.clone_state()
    scene, cleaned = env.scene(state), env.scene(env.without_masked(state))
    assert bool((state.mask & scene.is_free[0]).any())
    assert torch.equal(cleaned.is_free[0], scene.is_free[0] & ~state.mask)
    assert torch.equal(cleaned.tensor[0][~state.mask], scene.tensor[0][~state.mask])


def test_fingerprints_are_of_the_set_of_objects(env):
    env.reset(seed=0)
    state = env.clone_state()
    shuffled = replace(state, scene=state.scene[torch.randperm(34)], path=(1,))
    moved = replace(state, scene=state.scene + torch.tensor(0.01))
    assert state.fingerprint == shuffled.fingerprint != moved.fingerprint


def test_spec_goes_to_json_and_actions_are_checked(env, prior, free_objects, monkeypatch):
    monkeypatch.setattr("scene_envs.envs.spaces.resolve_prior", lambda name, device: prior)
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


# -- rendering ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_pictures_show_the_masked_objects_in_red(prior, free_objects):
    everything = lambda scene, reward, rng: scene.is_free[0]  # noqa: E731
    env = SearchEnv(prior=prior, objective=free_objects, mask=everything, num_steps=2, render_mode="rgb_array")
    env.reset(seed=0)
    scene, mask = env.scene(), env.state.mask.unsqueeze(0)
    assert bool(mask.any())
    np.testing.assert_array_equal(env.render(), render(scene, highlight=mask)[0])
    assert (env.render() != render(scene)[0]).any()


def test_an_unknown_render_mode_names_those_there_are(prior, free_objects):
    with pytest.raises(InvalidInputError, match="use 'rgb_array' or None"):
        SearchEnv(prior=prior, objective=free_objects, render_mode="ansi")


@pytest.mark.parametrize("settings", [{"max_nfe": 2}, {"mask": lambda scene, score, rng: scene.is_empty[0] & False}])
def test_an_episode_that_is_over_at_its_reset_ends_with_the_first_step(prior, free_objects, settings):
    env = SearchEnv(prior=prior, objective=free_objects, branching=3, max_depth=3, num_steps=2, **settings)
    before, _ = env.reset(seed=1)
    after, reward, terminated, truncated, _ = env.step(0)
    assert data_equivalence(before, after, exact=True)
    assert reward == 0.0
    assert terminated != truncated
    with pytest.raises(ResetNeededError):
        env.step(0)
    env.reset(seed=1)
    assert env.step(0)[1] == 0.0


@pytest.mark.parametrize("objective", [AboveTheMean(), Clip(AboveTheMean(), low=0.0)])
def test_an_objective_that_depends_on_the_batch_is_refused(prior, objective):
    with pytest.raises(InvalidInputError, match="by the other scenes of its batch"):
        SearchEnv(prior=prior, objective=objective, branching=3, num_steps=2)


MASK_ID = "scene_envs:SceneEnvs/SearchMask-v0"
MASKS = ["infeasible", "empty", "random"]


def nothing(scene: Any, score: Any, rng: Any) -> torch.Tensor:
    """A mask that never has a slot."""
    return torch.zeros_like(scene.is_empty[0])


@pytest.fixture
def mask_kwargs(prior: Any, free_objects: Any) -> dict[str, Any]:
    return {"prior": prior, "objective": free_objects, "branching": 2, "max_depth": 3, "num_steps": 2, "masks": MASKS}


@pytest.fixture
def mask_env(mask_kwargs: dict[str, Any]) -> SearchMaskEnv:
    mask_env = SearchMaskEnv(**mask_kwargs)
    mask_env.reset(seed=0)
    return mask_env


def test_check_env_passes_with_a_choice_of_masks(mask_kwargs: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    blank = lambda batch, highlight: np.zeros((len(batch), 12, 16, 3), np.uint8)  # noqa: E731
    monkeypatch.setattr("scene_envs.envs.search_gymnasium.picture", blank)
    monkeypatch.setattr("webbrowser.open", lambda address: True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gym.make(MASK_ID, **mask_kwargs).unwrapped)


@pytest.mark.parametrize("copies", [None, 2])
@pytest.mark.parametrize("name", ["Denoising-v0", "Search-v0", "SearchMask-v0"])
def test_torchrl_wraps_every_environment(name: str, copies: int | None, mask_kwargs: dict[str, Any]) -> None:
    from torchrl.envs import GymWrapper
    from torchrl.envs.utils import check_env_specs

    name, kwargs = f"scene_envs:SceneEnvs/{name}", dict(mask_kwargs)
    if "Search-" in name:
        del kwargs["masks"]
    if "Denoising" in name:
        kwargs = {"prior": kwargs["prior"], "reward": "object_count", "num_steps": 2}
    if copies is None:
        env = GymWrapper(gym.make(name, **kwargs))
    else:
        makers = [lambda: gym.make(name, **kwargs)] * copies
        env = GymWrapper(gym.vector.SyncVectorEnv(makers, autoreset_mode=gym.vector.AutoresetMode.DISABLED))
    check_env_specs(env, seed=0, break_when_any_done="both")
    assert env.rollout(2).batch_size == (() if copies is None else (copies,)) + (2,)


def test_two_environments_with_a_choice_of_masks_live_the_same_life(mask_kwargs: dict[str, Any]) -> None:
    first, second = gym.make(MASK_ID, **mask_kwargs), gym.make(MASK_ID, **mask_kwargs)
    assert data_equivalence(first.reset(seed=3), second.reset(seed=3), exact=True)
    for action in (5, 0, 2):
        a, b = first.step(action), second.step(action)
        assert data_equivalence(a, b, exact=True)
    assert a[2:4] == (False, True)  # truncated at max_depth


@pytest.mark.parametrize("mask", MASKS)
def test_with_one_mask_the_tree_is_that_of_the_search(mask_kwargs: dict[str, Any], mask: str) -> None:
    plain = SearchEnv(**{key: value for key, value in mask_kwargs.items() if key != "masks"}, mask=mask)
    choice = SearchMaskEnv(**{**mask_kwargs, "masks": [mask]})
    assert choice.action_space == plain.action_space
    for mask_env in (plain, choice):
        mask_env.reset(seed=5)
    for action in (1, 0):
        assert plain.step(action)[1:] == choice.step(action)[1:]
        assert torch.equal(plain.state.scene, choice.state.scene)
        assert torch.equal(plain.state.mask, choice.state.masks[0])


def test_an_action_regenerates_the_slots_of_its_mask(mask_env: SearchMaskEnv) -> None:
    root = mask_env.clone_state()
    scene = mask_env.scene(root)
    odd = torch.arange(34) % 2 == 1
    assert torch.equal(root.masks[0], scene.is_free[0] & odd)  # what the objective blames
    assert torch.equal(root.masks[1], scene.is_empty[0])
    assert not root.masks[:, 0].any()  # the table
    children = mask_env.expand_batch([(root, action) for action in range(6)])
    for action, child in enumerate(children):
        kept = ~root.masks[action // 2]
        assert torch.equal(child.scene[kept], root.scene[kept])
        assert not torch.equal(child.scene[~kept], root.scene[~kept])
    assert not torch.equal(children[0].scene, children[1].scene)


def test_observation_and_planner_see_all_masks_before_more_inpaintings(mask_env: SearchMaskEnv) -> None:
    observation, info = mask_env.reset(seed=1)
    assert mask_env.observation_space.contains(observation)
    np.testing.assert_array_equal(observation["regenerate"], mask_env.state.masks.numpy())
    assert info["regenerate"] == int(mask_env.state.masks.any(dim=0).sum())
    assert list(mask_env.legal_actions()) == [0, 2, 4, 1, 3, 5]
    assert mask_env.action_masks().all()


def test_masks_without_slots_are_not_legal(mask_kwargs: dict[str, Any]) -> None:
    mask_env = SearchMaskEnv(**{**mask_kwargs, "masks": [nothing, "random"]})
    mask_env.reset(seed=0)
    root = mask_env.state
    assert mask_env.action_masks().tolist() == [False, False, True, True]
    with pytest.raises(InvalidInputError, match=r"mask 'nothing' has no slot.*legal actions are \[2, 3\]"):
        mask_env.expand(root, 0)
    spent = mask_env.nfe
    _, reward, terminated, truncated, info = mask_env.step(1)
    assert (reward, terminated, truncated, info["depth"], mask_env.nfe) == (0.0, False, False, 1, spent)
    assert torch.equal(mask_env.state.scene, root.scene)
    assert [mask_env.step(0)[3] for _ in range(2)] == [False, True]  # the depth is spent all the same


def test_nothing_in_any_mask_ends_the_episode(mask_kwargs: dict[str, Any]) -> None:
    mask_env = SearchMaskEnv(**{**mask_kwargs, "masks": ["random", nothing]})
    mask_env.reset(seed=0)
    mask_env.problem.mask_generators[0] = nothing
    assert mask_env.step(0)[2:4] == (True, False)
    assert not mask_env.action_masks().any()


def test_states_with_masks_survive_pickling_and_restoring(mask_env: SearchMaskEnv, mask_kwargs: dict[str, Any]) -> None:
    mask_env.step(4)
    state = mask_env.clone_state()
    after = mask_env.step(1)
    other = SearchMaskEnv(**mask_kwargs)
    other.reset(seed=99)
    other.restore_state(pickle.loads(pickle.dumps(state)))
    assert other.state == state
    assert data_equivalence(after[0], other.step(1)[0], exact=True)
    fewer = SearchMaskEnv(**{**mask_kwargs, "masks": ["random"]})
    with pytest.raises(InvalidInputError, match="the state has 3 masks, this environment 1"):
        fewer.reset(options={"state": state})
    plain = SearchEnv(prior=mask_kwargs["prior"], num_steps=1, objective=mask_kwargs["objective"])
    plain.reset(seed=0)
    with pytest.raises(InvalidInputError, match="the state has 1 masks, this environment 3"):
        mask_env.restore_state(plain.state)


@pytest.mark.parametrize("planner", [BeamPlanner, BestOfPlanner, GreedyPlanner, MCTSPlanner])
def test_planners_search_it(mask_env: SearchMaskEnv, planner: type, tmp_path: Any) -> None:
    root = mask_env.clone_state()
    plan = planner().make(3)
    (result,) = Session(mask_env, journal=Journal(tmp_path / "journal", {})).run(plan, [root], budget=9)
    assert 0 < len(result.values) <= 9
    assert result.best_value == max(result.values)
    assert {path // 2 for path in result.best_path} <= {0, 1, 2}
    again = Journal(tmp_path / "journal", {})
    assert len(list(again.states())) == len(result.values)
    spent = mask_env.nfe
    assert Session(mask_env, journal=again).run(plan, [root], budget=9)[0].values == result.values
    assert mask_env.nfe == spent  # all came from the journal


def test_the_spec_goes_to_json_and_bad_masks_are_named(
    mask_kwargs: dict[str, Any], prior: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scene_envs.envs.spaces.resolve_prior", lambda name, device: prior)
    masks = ["random", {"name": "empty", "count": 3}]
    made = gym.make(MASK_ID, objective="object_count", masks=masks, num_steps=2)
    again = gym.make(gym.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    assert data_equivalence(made.reset(seed=1), again.reset(seed=1), exact=True)
    assert made.unwrapped.problem.mask_names == ("random", "empty")
    with pytest.raises(UnknownNameError, match="did you mean 'random'"):
        SearchMaskEnv(**{**mask_kwargs, "masks": ["randm"]})
    for bad in ([], "random", None):
        with pytest.raises(InvalidInputError, match="give a list of at least one mask"):
            SearchMaskEnv(**{**mask_kwargs, "masks": bad})
