"""Names of rewards and priors: resolution by packages that the environments do not import."""

from __future__ import annotations

from importlib.metadata import EntryPoints
from pathlib import Path

import gymnasium as gym
import pytest

from agents.priors.testing import tiny_prior
from scene_envs import registry as plugins
from scene_envs.envs import scoring as resolvers
from scene_envs.errors import InvalidInputError, MissingDependencyError, UnknownNameError
from scene_envs.scene_types import get_scene_type

ID = "scene_envs:SceneEnvs/Denoising-v0"


def test_unknown_names_offer_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'feasible_objects'"):
        gym.make(ID, reward="feasible_object")
    with pytest.raises(UnknownNameError, match="did you mean 'dimsum_table'"):
        gym.make(ID, prior="dimsum_tabel")


def test_entry_points_of_a_checkout_do_not_depend_on_installed_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    """An editable install keeps the metadata of the day it was made."""
    monkeypatch.setattr(plugins, "entry_points", lambda group: EntryPoints())
    assert set(plugins.plugin_entry_points(resolvers.ENTRY_POINT_GROUP)) == {"prior", "reward"}


def test_the_pyproject_of_another_project_is_not_ours(tmp_path: Path) -> None:
    page = tmp_path / "pyproject.toml"
    page.write_text('[project]\nname = "other"\n[project.entry-points."scene_envs.resolvers"]\nreward = "x:y"\n')
    assert plugins._checkout_entry_points(page) == {}
    assert plugins._checkout_entry_points(tmp_path / "missing.toml") == {}


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
