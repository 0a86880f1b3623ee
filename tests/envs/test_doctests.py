"""The examples in the docstrings run."""

from __future__ import annotations

import doctest
from importlib import import_module

import pytest

MODULES = ["denoising", "denoising_envs", "denoising_torchrl", "env_reward", "search_problem", "search_state"]
MODULES += ["errors", "normalizer", "rotations", "scene", "scene_types", "assets.base", "assets.shapes"]
MODULES += [f"grammars.{name}" for name in ("dsl", "grammar", "plan", "surface")]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name):
    result = doctest.testmod(import_module(f"scene_envs.{name}"), optionflags=doctest.ELLIPSIS)
    assert result.attempted > 0
    assert result.failed == 0
