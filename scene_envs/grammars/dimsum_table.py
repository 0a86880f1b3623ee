"""Dimsum Table: up to four places around a table, and shared teapots, dishes and steamer stacks.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025). A few quiet
tables and a few feasts widen the range of object counts to that of the published data (7 to 34).
"""

from __future__ import annotations

import math

from scene_envs.grammars.dsl import NOTHING, Geometric, Group, Object, OneOf, Repeat, Stack
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.layout import Node, Surface
from scene_envs.grammars.surface import Gaussian, Region
from scene_envs.scene_types import get_scene_type

KEEP_OUT = {"dinner_plate": 0.14, "teacup": 0.07, "teapot": 0.10, "serving_dish": 0.20, "steamer_bottom": 0.12}
"""Radii (m) of circles around objects; the circles of two objects on the table never overlap."""

FOOTPRINT = {"dinner_plate": 0.135, "teacup": 0.07, "teapot": 0.10, "serving_dish": 0.191, "steamer_bottom": 0.12}
"""Radii (m) of circles around objects that lie wholly on the table top."""

STEP = 0.091
"""Height of one steamer, m."""


def places(setting: float, plate: float, cup: float, nothing: float) -> Node:
    """Four places on the sides of the table: a plate near the rim, its cup 25 cm further in."""

    def place(angle: float) -> Node:
        cos, sin = math.cos(angle), math.sin(angle)
        the_plate = Object("dinner_plate", Gaussian(0.50 * cos, 0.50 * sin, along=0.032))
        the_cup = Object("teacup", Gaussian(0.25 * cos, 0.25 * sin, along=0.032, across=0.071, direction=angle))
        return OneOf((setting, Group(the_plate, the_cup)), (plate, the_plate), (cup, the_cup), (nothing, NOTHING))

    return Group(*(place(quarter * math.pi / 2) for quarter in range(4)))


def dishes(present: float) -> Node:
    return Repeat(Object("serving_dish", Gaussian(along=0.141)), Geometric(0.5, 1, 2, present))


def steamers(another: float, lid: float, nothing: float, three: float = 0.6) -> Node:
    """Three or four stacks of steamers; the tallest has at least four objects."""
    then = {"steamer_bottom": another, "steamer_lid": lid, None: nothing}
    return Repeat(
        Stack("steamer_bottom", then, step=STEP, where=Gaussian(along=0.158), at_most=10),
        Geometric(three, 3, 4),
        such_that={"no stack of 4": lambda stacks: max(len(stack.assets) for stack in stacks) >= 4},
    )


def teapots(present: float) -> Node:
    return Repeat(Object("teapot", Gaussian(along=0.1)), Geometric(0.5, 1, 2, present))


@register_grammar("dimsum_table")
def dimsum_table() -> Grammar:
    """The whole table."""
    usual = Group(places(0.70, 0.025, 0.025, 0.20), dishes(0.6), steamers(0.30, 0.40, 0.30), teapots(0.9))
    quiet = Group(places(0.14, 0.03, 0.03, 0.80), dishes(0.2), steamers(0.15, 0.35, 0.50), teapots(0.4))
    feast = Group(places(0.80, 0.025, 0.025, 0.15), dishes(0.6), steamers(0.72, 0.20, 0.08, three=0.5), teapots(0.9))
    table = Surface(
        children=[OneOf((0.86, usual), (0.04, quiet), (0.10, feast))],
        region=Region(0.475, 0.475, radius=0.625),
        keep_out=KEEP_OUT,
        footprint=FOOTPRINT,
    )
    return Grammar("dimsum_table", get_scene_type("dimsum_table"), [table])
