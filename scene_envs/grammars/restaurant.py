"""A restaurant: round tables with dim sum and four chairs each, and shelves along one wall.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from scene_envs.grammars import dimsum_table as dimsum
from scene_envs.grammars.dsl import Cluster, Geometric, Group, Object, OneOf, Repeat, Stack
from scene_envs.grammars.living_room_shelf import inner_tier, top_tier
from scene_envs.grammars.shelf import tiers
from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface, Tower
from scene_envs.grammars.wishes import Gaussian, Line, Uniform, Yaw

FLOOR = -0.785
"""z of the floor (m); table tops are at 0."""
ROOM = Region(4.9, 4.9)
KEEP_OUT = {"cafe_table": 0.64}
TABLES = Uniform(2.75, 3.0, x=0.25)
WALL = Line((-4.75, -3.0), (-4.75, 3.0))


def chairs() -> Node:
    """Four chairs around a table, each facing it."""
    return Group(
        *(
            Cluster(
                Object("chair", Gaussian(1.1, 0.0, along=0.07, across=0.17), Yaw(0.14, (math.pi,))),
                Gaussian(along=0.0),
                Yaw(0.0, (quarter * math.pi / 2,)),
            )
            for quarter in range(4)
        )
    )


def laid(stacks: Geometric, another: float, lid: float, nothing: float, setting: float, empty: float) -> Node:
    """A table with its chairs and what is on it."""
    then = {"steamer_bottom": another, "steamer_lid": lid, None: nothing}
    steamers = Repeat(Stack("steamer_bottom", then, step=dimsum.STEP, where=Gaussian(along=0.158), at_most=10), stacks)
    top = Surface(
        [dimsum.places(setting, 0.05, 0.05, empty), dimsum.dishes(0.6), steamers, dimsum.teapots(0.9)],
        Region(0.475, 0.475, radius=0.625),
        keep_out=dimsum.KEEP_OUT,
        footprint=dimsum.FOOTPRINT,
        layouts=30,
    )
    return Object("cafe_table", TABLES, on=[top], beside=chairs())


def shelves(count: Geometric) -> Node:
    """Shelves along the wall, filled like those of a living room, open to the room."""
    return Repeat(Object("shelf", WALL, Yaw(0.0), on=tiers(inner_tier(), top_tier())), count)


def exactly(*weights: tuple[float, int], table: Node) -> Node:
    """So many tables, by weight."""
    return OneOf(*((weight, Group(*[table] * count)) for weight, count in weights))


def floor(*children: Node) -> Surface:
    """The floor with tables first, then shelves."""
    return Surface(children, ROOM, keep_out=KEEP_OUT, height=FLOOR, layouts=30)


def stack_of_three(towers: Sequence[Tower]) -> bool:
    """Whether a stack of at least three steamers stands somewhere."""
    return any(len(tower.assets) >= 3 and tower.assets[0] == "steamer_bottom" for tower in towers)
