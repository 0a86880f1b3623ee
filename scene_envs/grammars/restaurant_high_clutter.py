"""Restaurant, high clutter: three or four laid tables and up to five shelves.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025); the number of tables is
drawn from the distribution that its rejection sampling leaves. A few quiet rooms and a few feasts widen the range of
object counts to that of the published data (33 to 125).
"""

from __future__ import annotations

from scene_envs.grammars.dsl import Geometric, OneOf
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.parts import at_least
from scene_envs.grammars.restaurant import floor, laid, shelves, tables
from scene_envs.scene_types import get_scene_type

USUAL = tables(
    {3: 0.89, 4: 0.11},
    laid(Geometric(0.2, 2, 4), another=0.3, lid=0.4, nothing=0.3, setting=0.40, empty=0.50),
)
QUIET = tables(
    {3: 1.0},
    laid(Geometric(0.6, 2, 4), another=0.15, lid=0.4, nothing=0.45, setting=0.1, empty=0.8, dishes=0.3, teapots=0.6),
)
FEAST = tables(
    {3: 0.6, 4: 0.4},
    laid(Geometric(0.2, 3, 4), another=0.6, lid=0.3, nothing=0.1, setting=0.8, empty=0.1),
)


@register_grammar("restaurant_high_clutter")
def restaurant_high_clutter() -> Grammar:
    """The whole room."""
    room = floor(OneOf((0.91, USUAL), (0.05, QUIET), (0.04, FEAST)), shelves(Geometric(0.2, 0, 5)))
    return Grammar("restaurant_high_clutter", get_scene_type("restaurant_high_clutter"), [room], at_least(32))
