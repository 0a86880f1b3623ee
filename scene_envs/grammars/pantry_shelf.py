"""Pantry Shelf: four tiers of cans, bottles and fruit, from nearly empty to packed.

Kinds and counts follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025). There a solver removes
overlap and objects fall off the shelf; here every object is placed where there is room.
"""

from __future__ import annotations

from scene_envs.grammars.containers import Heap
from scene_envs.grammars.distributions import Uniform
from scene_envs.grammars.dsl import Geometric, Group, Object, OneOf, Repeat, Tiers
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.parts import at_least, maybe
from scene_envs.grammars.shelf import HALF_DEPTH, HALF_WIDTH, MIDDLE, tiers
from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface
from scene_envs.scene_types import get_scene_type

FRUIT = ("apple_gala", "apple_golden", "apple_green", "apple_red", "pear_anjou", "pear_bosc", "pear_red",
         "avocado_a", "avocado_b", "avocado_c")  # fmt: skip
ANYWHERE = Uniform(HALF_DEPTH, HALF_WIDTH, x=MIDDLE)


def goods(p: float) -> Node:
    """Some of each kind, anywhere on the tier."""
    kinds = ("tea_bottle", "soda_can", *FRUIT)
    return Group(*(Repeat(Object(kind, ANYWHERE), Geometric(p, 0, 10)) for kind in kinds))


def fruit_bowl() -> Node:
    """A bowl with up to three pieces of fruit."""
    piece = OneOf(*((1.0, Object(kind)) for kind in FRUIT))
    return Object("fruit_bowl", ANYWHERE, inside=Heap(Repeat(piece, Geometric(0.5, 0, 3)), 0.03))


def pantry(p: float) -> Node:
    """The whole shelf; ``p`` is the parameter of the geometric distribution of the number of each kind."""
    top = Group(maybe(0.2, fruit_bowl()), goods(p))
    return Tiers(tiers(goods(p), top))


@register_grammar("pantry_shelf")
def pantry_shelf() -> Grammar:
    """Shelves from nearly empty to packed."""
    shelves = OneOf((0.02, pantry(0.93)), (0.90, pantry(0.649)), (0.08, pantry(0.5)))
    room = Surface([shelves], Region(1.0, 1.0))
    return Grammar("pantry_shelf", get_scene_type("pantry_shelf"), [room], at_least(2))
