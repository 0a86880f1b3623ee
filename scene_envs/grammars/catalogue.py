"""Registry of grammars: built-in ones, those of installed packages, and yours."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from scene_envs.errors import unknown_name
from scene_envs.grammars.grammar import GRAMMARS, Grammar
from scene_envs.plugins import load_plugins
from scene_envs.scene_types import SceneType
from scene_envs.scene_types.registry import PLUGINS


@cache
def _load_built_in() -> None:
    """Import the modules of this package that register a grammar."""
    from scene_envs.grammars import (  # noqa: F401
        breakfast_table_high_clutter,
        breakfast_table_low_clutter,
        dimsum_table,
        living_room_shelf,
        pantry_shelf,
        restaurant_high_clutter,
        restaurant_low_clutter,
    )


def get_grammar(scene_type: str | SceneType | Grammar) -> Grammar:
    """A fresh grammar by its name (built-in grammars are called like their scene type)."""
    if isinstance(scene_type, Grammar):
        return scene_type
    return grammar_factory(scene_type.name if isinstance(scene_type, SceneType) else scene_type)()


def grammar_factory(name: str) -> Callable[[], Grammar]:
    """The function registered as ``name``; raises UnknownNameError with the nearest known name."""
    _load_built_in()
    if name not in GRAMMARS:
        load_plugins(PLUGINS)
    if name not in GRAMMARS:
        raise unknown_name("grammar", name, GRAMMARS)
    return GRAMMARS[name]


def list_grammars() -> list[str]:
    """Names of all registered grammars, those of installed packages included, sorted."""
    _load_built_in()
    load_plugins(PLUGINS)
    return sorted(GRAMMARS)
