"""Public names: complete, documented, the same object everywhere, and cheap to import."""

from __future__ import annotations

import ast
import inspect
import json
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import agents
import scene_envs

ROOMS = ("assets", "datasets", "envs", "export", "grammars", "physics", "render", "scene_types")
LAZY = ("scene_envs", "scene_envs.envs")


@pytest.mark.parametrize("package", ["scene_envs", *(f"scene_envs.{room}" for room in ROOMS)])
def test_every_public_name_exists_and_is_documented(package: str) -> None:
    module = import_module(package)
    assert module.__doc__
    assert sorted(set(module.__all__)) == sorted(module.__all__)
    for name in module.__all__:
        found = getattr(module, name)
        if inspect.isclass(found) or inspect.isfunction(found):
            assert inspect.getdoc(found), f"{package}.{name}"


@pytest.mark.parametrize("package", LAZY)
def test_lazy_names_are_typed(package: str) -> None:
    """Every name of ``__all__`` is imported for type checkers, from where it really is."""
    tree = ast.parse(Path(import_module(package).__file__ or "").read_text())
    guard = next(node for node in tree.body if isinstance(node, ast.If))
    typed = {alias.name: node.module for node in guard.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert set(typed) == set(import_module(package).__all__) - {"__version__"}
    for name, module in typed.items():
        assert getattr(import_module(module or ""), name) is getattr(import_module(package), name)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'scene_envs' has no attribute 'SceneBtach'"):
        scene_envs.SceneBtach  # noqa: B018


FOLDER = Path(agents.__file__).parent
AGENT_ROOMS = ("diffusion", "evaluation", "networks", "planning", "post_training", "pretraining", "priors")


@pytest.mark.parametrize("name", agents.__all__)
def test_every_public_name_is_found_and_documented(name: str) -> None:
    assert (getattr(agents, name).__doc__ or "").strip()
    assert name in dir(agents)


def test_the_names_of_the_first_page_are_public() -> None:
    assert {"ScenePrior", "pretrain", "post_train", "run_search", "evaluate"} <= set(agents.__all__)


def test_an_unknown_name_of_agents_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'agents' has no attribute 'scene_prior'"):
        _ = agents.scene_prior


def test_importing_agents_loads_nothing_heavy() -> None:
    code = "import agents, sys; print({'torch', 'pybullet', 'hydra', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("room", AGENT_ROOMS)
def test_a_room_shows_what_other_modules_define(room: str) -> None:
    """Its ``__init__`` has a docstring, imports, lazy ones perhaps, and ``__all__``, whose names are all imported."""
    tree = ast.parse((FOLDER / room / "__init__.py").read_text(encoding="utf-8"))
    lazy = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    assert {type(node) for node in tree.body[1:] if node not in lazy} <= {ast.ImportFrom, ast.Assign}
    module = import_module(f"agents.{room}")
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    shown = [alias.name for node in imports if str(node.module).startswith("agents.") for alias in node.names]
    assert sorted(module.__all__) == sorted(shown)
    assert all(hasattr(module, name) for name in module.__all__)
    assert module.__doc__


HEAVY = ("pybullet", "fcl", "trimesh", "torchrl", "rewards", "agents")
STEPS = {
    "the package": ("import scene_envs", ("torch", *HEAVY)),
    "a class": ("from scene_envs import SceneBatch, get_scene_type", ("torch._dynamo", *HEAVY)),
    "an environment": ("import scene_envs.envs.denoising", ("rewards", "agents")),
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
    shipped = {"beam", "best_of", "evolution", "gradient", "greedy", "mcts"}
    assert shipped <= {*loaded["known"]}


@pytest.mark.slow
def test_environments_are_registered(loaded: dict[str, list[str]]) -> None:
    assert {"SceneEnvs/Denoising-v0", "SceneEnvs/Search-v0"} <= {*loaded["registered"]}
