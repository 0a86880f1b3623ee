"""Public names: complete, documented, and the same object wherever they are exported."""

from __future__ import annotations

import ast
import inspect
from importlib import import_module
from pathlib import Path

import pytest

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
