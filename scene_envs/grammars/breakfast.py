"""Breakfast tables for six and for two: place settings, shared food, a crock of cutlery.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025).
"""

from __future__ import annotations

import math

from scene_envs.grammars.dsl import (
    NOTHING,
    Cluster,
    Geometric,
    Group,
    Object,
    OneOf,
    Repeat,
    at_least,
    maybe,
    middle,
    toast,
)
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.layout import Heap, Node, Standing, Surface
from scene_envs.grammars.surface import Gaussian, PositionDistribution, Region, Uniform, Yaw
from scene_envs.scene_types import get_scene_type

HALF_DEPTH, HALF_LENGTH = 0.2575, 0.65
"""Largest distances (m) in x and y of object frames from the middle of the table."""
ANYWHERE = Uniform(HALF_DEPTH, HALF_LENGTH)
TABLE = Region(HALF_DEPTH, HALF_LENGTH, overhang=0.09)
"""Nothing hangs over the edge of the table, which is 0.375 and 0.75 m from its middle."""

CROCK_RADIUS = 0.055
"""Inner radius of the utensil crock, m."""

ALONG = Yaw(std=0.06)
"""Turn of cutlery next to the plate: it points to the middle of the table."""
ACROSS = Yaw(std=0.06, choices=(math.pi / 2, -math.pi / 2))
"""Cutlery above the plate lies across."""


def near(x: float, y: float) -> Uniform:
    """A place of the setting, within 1.5 cm: x toward the middle of the table, y to the left of the person there, m."""
    return Uniform(0.015, 0.015, x, y)


def bowl_of_food(
    where: PositionDistribution, yaw: Yaw, bread: float, apple: float, pear: float, beside: Node = NOTHING
) -> Node:
    """A bowl with bread leaning in it, fruit, or nothing, with these chances."""
    fruit = OneOf((apple, Object("apple_gala")), (pear, Object("pear_bosc")), (1.0 - bread - apple - pear, NOTHING))
    leaning = Heap(Object("bread_slice"), radius=0.01, upright=True)
    return OneOf(
        (bread, Object("bowl", where, yaw, inside=leaning, beside=beside)),
        (1.0 - bread, Object("bowl", where, yaw, on=middle(fruit), beside=beside)),
    )


def place_setting(plate: float, bowl: float, nothing: float, another_toast: float) -> Node:
    """One person's place, in a frame whose x axis points to the middle of the table: a plate, a bowl, or nothing."""
    top = near(0.135, 0.0)
    cutlery = Group(
        maybe(0.7, Object("fork", near(0.0, 0.135), ALONG)),
        maybe(0.8, Object("knife", near(0.0, -0.130), ALONG)),
        OneOf((0.2, Object("dinner_spoon", top, ACROSS)), (0.2, Object("teaspoon", top, ACROSS)), (0.6, NOTHING)),
        maybe(0.8, Object("mug", near(0.125, -0.175))),
    )
    on_plate = OneOf(
        (0.2, toast(another_toast)),
        (0.1, Object("apple_gala")),
        (0.1, Object("pear_bosc")),
        (0.2, Object("bowl")),
        (0.4, NOTHING),
    )
    right, above = near(0.0, -0.115), near(0.115, 0.0)
    spoons = Group(
        OneOf((1.0, Object("dinner_spoon", right, ALONG)), (1.0, Object("teaspoon", right, ALONG)), (4.0, NOTHING)),
        OneOf((1.0, Object("dinner_spoon", above, ACROSS)), (1.0, Object("teaspoon", above, ACROSS)), (4.0, NOTHING)),
    )
    here, straight = Uniform(0.03, 0.03), Yaw(std=0.0)
    return OneOf(
        (plate, Object("plate", here, straight, on=middle(on_plate), beside=cutlery)),
        (bowl, bowl_of_food(here, straight, 0.1, 0.1, 0.1, beside=spoons)),
        (nothing, NOTHING),
    )


def facing_pair(setting: Node) -> Node:
    """Two settings on the long sides of the table, opposite each other."""
    return Group(
        Cluster(setting, Gaussian(-0.2, 0.0, along=0.0)),
        Cluster(setting, Gaussian(0.2, 0.0, along=0.0), Yaw(0.0, (math.pi,))),
    )


def shared_plates(p: float, most: int, another_toast: float) -> Node:
    """Plates for all, each with toast or fruit."""
    food = OneOf((0.5, toast(another_toast)), (0.25, Object("apple_gala")), (0.25, Object("pear_bosc")))
    return Repeat(Object("shared_plate", ANYWHERE, on=middle(food)), Geometric(p, 0, most))


def shared_bowls(p: float, most: int) -> Node:
    """Bowls for all, each with bread or fruit."""
    return Repeat(bowl_of_food(ANYWHERE, Yaw(), 0.2, 0.4, 0.4), Geometric(p, 0, most))


def cereal(p: float) -> Node:
    return Repeat(Object("cereal_box", ANYWHERE), Geometric(p, 0, 3))


def jugs(p: float) -> Node:
    return Repeat(Object("water_jug", ANYWHERE), Geometric(p, 0, 2))


def crock(present: float) -> Node:
    """A crock in which up to ten forks, knives and spoons stand."""
    utensil = OneOf(*((1.0, Object(name)) for name in ("fork", "knife", "dinner_spoon", "teaspoon")))
    cutlery = Standing(Repeat(utensil, Geometric(0.1, 0, 10)), CROCK_RADIUS)
    return maybe(present, Object("utensil_crock", ANYWHERE, inside=cutlery))


def six_places(plate: float, bowl: float, nothing: float) -> Node:
    """Three pairs of places that face each other: near both ends and in the middle of the long sides."""
    pair = facing_pair(place_setting(plate, bowl, nothing, another_toast=0.25))
    ends_and_middle = (Uniform(0.0, 0.065, y=-0.40), Uniform(0.0, 0.04), Uniform(0.0, 0.065, y=0.40))
    return Group(*(Cluster(pair, where) for where in ends_and_middle))


def food_for_six(fullness: float) -> Node:
    return Group(shared_plates(1 - fullness, 4, 0.25), shared_bowls(1 - fullness, 6), cereal(0.4), jugs(0.6))


@register_grammar("breakfast_table_high_clutter")
def breakfast_table_high_clutter() -> Grammar:
    """The whole table for six."""
    usual = Group(six_places(0.535, 0.19, 0.275), food_for_six(0.3))
    quiet = Group(six_places(0.10, 0.05, 0.85), food_for_six(0.3))
    feast = Group(six_places(0.95, 0.05, 0.00), food_for_six(0.7))
    table = Surface([OneOf((0.90, usual), (0.03, quiet), (0.07, feast))], TABLE)
    return Grammar("breakfast_table_high_clutter", get_scene_type("breakfast_table_high_clutter"), [table], at_least(3))


def two_places(plate: float, bowl: float, nothing: float) -> Node:
    """Two places on the long sides, opposite each other, anywhere along the table."""
    pair = facing_pair(place_setting(plate, bowl, nothing, another_toast=0.2))
    return Cluster(pair, Gaussian(0.0, 0.0, along=0.0, across=0.2))


def food_for_two(crock_present: float) -> Node:
    return Group(crock(crock_present), shared_plates(0.7, 2, 0.2), shared_bowls(0.7, 2), cereal(0.58), jugs(0.6))


@register_grammar("breakfast_table_low_clutter")
def breakfast_table_low_clutter() -> Grammar:
    """The whole table for two."""
    usual = Group(two_places(0.36, 0.12, 0.52), food_for_two(0.12))
    feast = Group(two_places(0.90, 0.10, 0.00), food_for_two(0.90))
    table = Surface([OneOf((0.98, usual), (0.02, feast))], TABLE)
    return Grammar("breakfast_table_low_clutter", get_scene_type("breakfast_table_low_clutter"), [table], at_least(3))
