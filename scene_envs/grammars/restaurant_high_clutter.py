"""Restaurant, high clutter: three or four laid tables and up to five shelves.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025); the number of tables is
drawn from what its rejection leaves.
"""

from __future__ import annotations

from scene_envs.grammars.breakfast import at_least
from scene_envs.grammars.dsl import Geometric, OneOf
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.restaurant import exactly, floor, laid, shelves, stack_of_three
from scene_envs.scene_types import get_scene_type

TABLES = (0.89, 3), (0.11, 4)
"""Weights of the number of tables."""
USUAL = exactly(*TABLES, table=laid(Geometric(0.2, 2, 4), another=0.3, lid=0.4, nothing=0.3, setting=0.44, empty=0.46))
QUIET = exactly(*TABLES, table=laid(Geometric(0.6, 2, 4), another=0.15, lid=0.4, nothing=0.45, setting=0.1, empty=0.8))
FEAST = exactly(*TABLES, table=laid(Geometric(0.2, 3, 4), another=0.6, lid=0.3, nothing=0.1, setting=0.8, empty=0.1))


@register_grammar("restaurant_high_clutter")
def restaurant_high_clutter() -> Grammar:
    """The whole room."""
    tables = OneOf((0.92, USUAL), (0.05, QUIET), (0.03, FEAST))
    room = floor(tables, shelves(Geometric(0.2, 0, 5)))
    conditions = {"no stack of 3": stack_of_three} | at_least(32)
    return Grammar("restaurant_high_clutter", get_scene_type("restaurant_high_clutter"), [room], conditions)
