"""A restaurant: round tables with dim sum and four chairs each, and shelves along one wall.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from scene_envs.grammars import dimsum_table as dimsum
from scene_envs.grammars.dsl import Cluster, Geometric, Group, Object, OneOf, Repeat, Stack, at_least
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.layout import Node, Surface, Tower
from scene_envs.grammars.shelf import inner_tier, tiers, top_tier
from scene_envs.grammars.surface import Gaussian, Line, Region, Uniform, Yaw
from scene_envs.scene_types import get_scene_type

FLOOR = -0.785
"""z of the floor (m); table tops are at 0."""
ROOM = Region(4.9, 4.9)
KEEP_OUT = {"cafe_table": 0.72, "chair": 0.35}
"""Radii (m) of circles around objects; circles of two objects on the floor never overlap, so that people can pass."""
TABLES = Uniform(2.75, 3.0, x=0.25)
WALL = Line((-4.75, -3.0), (-4.75, 3.0))


def chairs() -> Node:
    """Four chairs around a table, one on each side and facing it, in the frame of the table. They have the same spread
    as in the paper, 7 cm toward the table and 17 cm along it, but no tails; a table without room for them is placed
    elsewhere.
    """
    chair = Object("chair", Uniform(0.12, 0.29, x=1.12), Yaw(0.14, (math.pi,)))
    center = Gaussian(along=0.0)
    return Group(*(Cluster(chair, center, Yaw(0.0, (quarter * math.pi / 2,))) for quarter in range(4)))


def laid(
    stacks: Geometric,
    another: float,
    lid: float,
    nothing: float,
    setting: float,
    empty: float,
    dishes: float = 0.6,
    teapots: float = 0.9,
) -> Node:
    """A table with its chairs, places, ``stacks`` of steamers, dishes and teapots (each the chance of one or two).

    ``another``, ``lid`` and ``nothing`` are the weights of what follows a steamer; ``setting`` (a plate with a cup) and
    ``empty`` those at each side of the table, where a plate alone and a cup alone have 0.05 each.
    """
    then = {"steamer_bottom": another, "steamer_lid": lid, None: nothing}
    steamers = Repeat(Stack("steamer_bottom", then, step=dimsum.STEP, where=Gaussian(along=0.158), at_most=10), stacks)
    top = Surface(
        [dimsum.places(setting, 0.05, 0.05, empty), dimsum.dishes(dishes), steamers, dimsum.teapots(teapots)],
        Region(0.475, 0.475, radius=0.625),
        keep_out=dimsum.KEEP_OUT,
        footprint=dimsum.FOOTPRINT,
        layouts=30,
    )
    return Object("cafe_table", TABLES, on=[top], beside=chairs())


def tables(numbers: Mapping[int, float], table: Node) -> Node:
    """A number of tables, drawn by weight; at least one of them carries a stack of at least three steamers."""
    conditions = {"no stack of 3": stack_of_three}
    return OneOf(*((weight, Repeat(table, Geometric(1.0, n, n), conditions)) for n, weight in numbers.items()))


def stack_of_three(towers: Sequence[Tower]) -> bool:
    """Whether a stack of at least three steamers, lid included, exists."""
    parts = (part for tower in towers for part in tower.walk())
    return any(len(part.assets) >= 3 and part.assets[0] == "steamer_bottom" for part in parts)


def shelves(count: Geometric) -> Node:
    """Shelves along the wall, filled like those of a living room, open to the room."""
    return Repeat(Object("shelf", WALL, Yaw(0.0), on=tiers(inner_tier(), top_tier())), count)


def floor(*children: Node) -> Surface:
    """The floor with ``children`` on it, placed in this order."""
    return Surface(children, ROOM, keep_out=KEEP_OUT, height=FLOOR, layouts=30)


@register_grammar("restaurant_high_clutter")
def restaurant_high_clutter() -> Grammar:
    """The whole room, with three or more tables."""
    usual = laid(Geometric(0.2, 2, 4), another=0.3, lid=0.4, nothing=0.3, setting=0.40, empty=0.50)
    few = Geometric(0.6, 2, 4)
    quiet = laid(few, another=0.15, lid=0.4, nothing=0.45, setting=0.1, empty=0.8, dishes=0.3, teapots=0.6)
    feast = laid(Geometric(0.2, 3, 4), another=0.6, lid=0.3, nothing=0.1, setting=0.8, empty=0.1)
    rooms = OneOf(
        (0.91, tables({3: 0.89, 4: 0.11}, usual)),
        (0.05, tables({3: 1.0}, quiet)),
        (0.04, tables({3: 0.6, 4: 0.4}, feast)),
    )
    room = floor(rooms, shelves(Geometric(0.2, 0, 5)))
    return Grammar("restaurant_high_clutter", get_scene_type("restaurant_high_clutter"), [room], at_least(32))


@register_grammar("restaurant_low_clutter")
def restaurant_low_clutter() -> Grammar:
    """The whole room, with one or more tables."""
    usual = laid(Geometric(0.4, 1, 4), another=0.3, lid=0.4, nothing=0.3, setting=0.52, empty=0.38)
    few = Geometric(0.9, 1, 4)
    quiet = laid(few, another=0.15, lid=0.4, nothing=0.45, setting=0.1, empty=0.8, dishes=0.2, teapots=0.5)
    feast = laid(Geometric(0.2, 3, 4), another=0.6, lid=0.3, nothing=0.1, setting=0.8, empty=0.1)
    rooms = OneOf(
        (0.95, tables({1: 0.44, 2: 0.39, 3: 0.13, 4: 0.04}, usual)),
        (0.03, tables({1: 1.0}, quiet)),
        (0.02, tables({2: 0.3, 3: 0.3, 4: 0.4}, feast)),
    )
    room = floor(rooms, shelves(Geometric(0.25, 0, 3)))
    return Grammar("restaurant_low_clutter", get_scene_type("restaurant_low_clutter"), [room])
