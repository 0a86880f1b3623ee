"""Imports of the packages: environments are registered, and no heavy dependency is loaded."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

HEAVY = ("pybullet", "fcl", "trimesh", "torchrl", "rewards", "agents")
STEPS = {
    "the package": ("import scene_envs", ("torch", *HEAVY)),
    "a class": ("from scene_envs import SceneBatch, get_scene_type", HEAVY),
    "an environment": ("import scene_envs.envs.denoising", ("rewards", "agents")),
    "gym.make": ("gymnasium.make('SceneEnvs/Denoising-v0', reward='object_count', num_steps=1).reset(seed=0)", ()),
    "planners": ("from agents.planning import list_planners; found['known'] = list(list_planners())", ()),
    "text encoders": ("import agents.networks.text_encoders", ("transformers",)),
}
"""What one process does, one after another, and the modules that it has not loaded then."""


@pytest.fixture(scope="module")
def loaded() -> dict[str, list[str]]:
    """Names of all modules after each step of a fresh process."""
    code = ["import json, sys, gymnasium", "found = {}"]
    for name, (statement, _) in STEPS.items():
        code += [statement, f"found[{name!r}] = list(sys.modules)"]
    code += ["found['registered'] = list(gymnasium.registry)", "print(json.dumps(found))"]
    done = subprocess.run([sys.executable, "-c", "\n".join(code)], capture_output=True, text=True, check=True)
    answer: dict[str, list[str]] = json.loads(done.stdout.splitlines()[-1])
    return answer


@pytest.mark.slow
@pytest.mark.parametrize("step", STEPS)
def test_what_is_not_needed_is_not_loaded(loaded: dict[str, list[str]], step: str) -> None:
    assert {*STEPS[step][1]} & {*loaded[step]} == set()


@pytest.mark.slow
def test_the_planners_that_ship_are_known_without_further_imports(loaded: dict[str, list[str]]) -> None:
    shipped = {"beam", "best_of", "evolution", "feynman_kac", "gradient", "greedy", "mcts"}
    assert shipped <= {*loaded["known"]}


@pytest.mark.slow
def test_environments_are_registered(loaded: dict[str, list[str]]) -> None:
    assert {"SceneEnvs/Denoising-v0", "SceneEnvs/Search-v0"} <= {*loaded["registered"]}
