"""Restaurant, high clutter: three or four laid tables and up to five shelves.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025); the number of tables is
drawn from what its rejection leaves.
"""

from __future__ import annotations

from scene_envs.grammars.dsl import Geometric
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.restaurant import exactly, floor, laid, shelves, stack_of_three
from scene_envs.scene_types import get_scene_type

TABLE = laid(Geometric(0.2, 2, 4), another=0.3, lid=0.4, nothing=0.3, setting=0.5, empty=0.4)


@register_grammar("restaurant_high_clutter")
def restaurant_high_clutter() -> Grammar:
    """The whole room."""
    room = floor(exactly((0.89, 3), (0.11, 4), table=TABLE), shelves(Geometric(0.2, 0, 5)))
    conditions = {"no stack of 3": stack_of_three}
    return Grammar("restaurant_high_clutter", get_scene_type("restaurant_high_clutter"), [room], conditions)
