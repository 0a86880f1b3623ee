"""A restaurant: round tables with dim sum and four chairs each, and shelves along one wall.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from scene_envs.grammars import dimsum_table as dimsum
from scene_envs.grammars.distributions import Gaussian, Line, Uniform, Yaw
from scene_envs.grammars.dsl import Cluster, Geometric, Group, Object, OneOf, Repeat, Stack
from scene_envs.grammars.living_room_shelf import inner_tier, top_tier
from scene_envs.grammars.shelf import tiers
from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface, Tower

FLOOR = -0.785
"""z of the floor (m); table tops are at 0."""
ROOM = Region(4.9, 4.9)
KEEP_OUT = {"cafe_table": 0.72, "chair": 0.35}
"""Radii (m) of circles around objects; circles of two objects on the floor never overlap, so that people can pass."""
TABLES = Uniform(2.75, 3.0, x=0.25)
WALL = Line((-4.75, -3.0), (-4.75, 3.0))


def chairs() -> Node:
    """Four chairs around a table, one on each side and facing it, in the frame of the table.

    The places have the same spread as in the paper, 7 cm toward the table and 17 cm along it, but no tails. A table
    without room for its chairs is placed somewhere else.
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
    """A table with its chairs, places, stacks of steamers, dishes and teapots.

    Args:
        stacks: Distribution of the number of stacks of steamers.
        another, lid, nothing: Weights of another steamer, a lid and nothing after each steamer.
        setting, empty: Weights of a plate with a cup, and of nothing, on each side of the table; a plate alone and
            a cup alone have 0.05 each.
        dishes, teapots: Chances of one or two of them.
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
