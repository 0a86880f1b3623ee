"""Examples of the page on grammars: each one runs, and its scenes pass the physics check."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from scene_envs import grammars, scene_types
from scene_envs.datasets import judge_scenes
from scene_envs.grammars import Grammar
from scene_envs.grammars.grammar import GRAMMARS

PAGE = (Path(__file__).parents[2] / "docs" / "grammars.md").read_text()
BLOCKS = [block for block in re.findall(r"```python\n(.*?)```", PAGE, flags=re.DOTALL) if "gym.make" not in block]


@pytest.fixture(scope="module")
def page() -> Any:
    """The names that the page defines, its blocks run in order."""
    names: dict[str, Any] = {}
    grammars.list_grammars()  # the built-in ones are registered for good, before the registry is swapped
    with patch.dict(scene_types._SCENE_TYPES), patch.dict(GRAMMARS):
        for block in BLOCKS:
            exec(compile(block, "docs/grammars.md", "exec"), names)
    return names


@pytest.mark.slow
def test_every_node_of_the_page_makes_scenes_that_are_kept(page: dict[str, Any]) -> None:
    other = grammars.Surface | grammars.Tiers
    nodes = {name: node for name, node in page.items() if hasattr(node, "draw") and not isinstance(node, other)}
    del nodes["can"]  # of another scene type
    assert {"pot", "steamers", "place", "high", "in_a_row", "left", "crock", "fruit_bowl"} <= set(nodes)
    for name, node in nodes.items():
        assert judge_scenes(page["scene_with"](node)) == [""], name


def test_its_grammars_make_what_they_say(page: dict[str, Any]) -> None:
    rng = np.random.default_rng(0)
    assert bool((page["grammar"].sample(rng, 20).counts >= 6).all())
    cans = page["cans"].sample(rng, 20)
    assert {name for names in cans.names() for name in names} == {"shelf", "soda_can"}
    tea = page["tea_table"]()
    assert isinstance(tea, Grammar)
    assert tea.sample(rng).scene_type.name == "tea_table"


def test_every_public_word_is_on_the_page() -> None:
    words = {name for name in grammars.__all__ if name[0].isupper()}
    inside = {
        "FreeSurface",
        "Outline",
        "Disc",
        "Rectangle",
        "Moved",
        "Filling",
        "Node",
        "Tower",
    }  # for those who extend it
    assert {word for word in words - inside if word not in PAGE} == set()
