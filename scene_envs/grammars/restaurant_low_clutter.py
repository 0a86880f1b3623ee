"""Restaurant, low clutter: one to four laid tables and up to three shelves.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025); the number of tables is
drawn from the distribution that its rejection sampling leaves. A few quiet rooms and a few feasts widen the range of
object counts to that of the published data (9 to 107).
"""

from __future__ import annotations

from scene_envs.grammars.dsl import Geometric, OneOf
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.restaurant import floor, laid, shelves, tables
from scene_envs.scene_types import get_scene_type

USUAL = tables(
    {1: 0.44, 2: 0.39, 3: 0.13, 4: 0.04},
    laid(Geometric(0.4, 1, 4), another=0.3, lid=0.4, nothing=0.3, setting=0.52, empty=0.38),
)
QUIET = tables(
    {1: 1.0},
    laid(Geometric(0.9, 1, 4), another=0.15, lid=0.4, nothing=0.45, setting=0.1, empty=0.8, dishes=0.2, teapots=0.5),
)
FEAST = tables(
    {2: 0.3, 3: 0.3, 4: 0.4},
    laid(Geometric(0.2, 3, 4), another=0.6, lid=0.3, nothing=0.1, setting=0.8, empty=0.1),
)


@register_grammar("restaurant_low_clutter")
def restaurant_low_clutter() -> Grammar:
    """The whole room."""
    room = floor(OneOf((0.95, USUAL), (0.03, QUIET), (0.02, FEAST)), shelves(Geometric(0.25, 0, 3)))
    return Grammar("restaurant_low_clutter", get_scene_type("restaurant_low_clutter"), [room])
