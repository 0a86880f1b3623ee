"""Restaurant, low clutter: one to four laid tables and up to three shelves.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025); the number of tables is
drawn from what its rejection leaves.
"""

from __future__ import annotations

from scene_envs.grammars.dsl import Geometric, OneOf
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.restaurant import exactly, floor, laid, shelves, stack_of_three
from scene_envs.scene_types import get_scene_type

TABLES = (0.44, 1), (0.39, 2), (0.13, 3), (0.04, 4)
"""Weights of the number of tables."""
USUAL = exactly(*TABLES, table=laid(Geometric(0.6, 1, 4), another=0.25, lid=0.4, nothing=0.35, setting=0.4, empty=0.5))
FEAST = exactly(*TABLES, table=laid(Geometric(0.2, 3, 4), another=0.6, lid=0.3, nothing=0.1, setting=0.8, empty=0.1))


@register_grammar("restaurant_low_clutter")
def restaurant_low_clutter() -> Grammar:
    """The whole room."""
    tables = OneOf((0.97, USUAL), (0.03, FEAST))
    room = floor(tables, shelves(Geometric(0.25, 0, 3)))
    conditions = {"no stack of 3": stack_of_three}
    return Grammar("restaurant_low_clutter", get_scene_type("restaurant_low_clutter"), [room], conditions)
