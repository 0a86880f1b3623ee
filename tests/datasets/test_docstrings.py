"""The examples in the docstrings run."""

from __future__ import annotations

import doctest
from importlib import import_module

import pytest

MODULES = ["dataset", "mixing", "splits", "stream"]
MODULES += [f"prompts.{name}" for name in ("claims", "facts", "language", "parser")]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name: str) -> None:
    result = doctest.testmod(import_module(f"scene_envs.datasets.{name}"))
    assert result.attempted > 0
    assert result.failed == 0
