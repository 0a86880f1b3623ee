"""Registry of grammars: built-in ones, those of installed packages, and users' own."""

from __future__ import annotations

from collections.abc import Callable

from scene_envs.grammars.grammar import GRAMMARS, Grammar
from scene_envs.scene_types import SceneType


def get_grammar(scene_type: str | SceneType | Grammar) -> Grammar:
    """A fresh grammar by its name (built-in grammars are called like their scene type)."""
    if isinstance(scene_type, Grammar):
        return scene_type
    return grammar_factory(scene_type.name if isinstance(scene_type, SceneType) else scene_type)()


def grammar_factory(name: str) -> Callable[[], Grammar]:
    """The function registered as ``name``; raises UnknownNameError with the nearest known name."""
    return GRAMMARS[name]


def list_grammars() -> list[str]:
    """Names of all registered grammars, those of installed packages included, sorted."""
    return GRAMMARS.names()
