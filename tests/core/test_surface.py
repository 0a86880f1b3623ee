"""The public surface: short imports from ``agents``, and rooms that show concepts alone."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import agents

FOLDER = Path(agents.__file__).parent
ROOMS = ("diffusion", "evaluation", "networks", "planning", "post_training", "pretraining", "priors")


@pytest.mark.parametrize("name", agents.__all__)
def test_every_public_name_is_found_and_documented(name: str) -> None:
    assert (getattr(agents, name).__doc__ or "").strip()
    assert name in dir(agents)


def test_the_names_of_the_first_page_are_public() -> None:
    assert {"ScenePrior", "pretrain", "post_train", "run_search", "evaluate"} <= set(agents.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'agents' has no attribute 'scene_prior'"):
        _ = agents.scene_prior


def test_importing_agents_loads_nothing_heavy() -> None:
    code = "import agents, sys; print({'torch', 'pybullet', 'hydra', 'matplotlib'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.mark.parametrize("room", ROOMS)
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
