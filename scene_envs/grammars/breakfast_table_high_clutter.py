"""Breakfast Table, high clutter: laid for up to six, with more shared food.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025).
"""

from __future__ import annotations

from scene_envs.grammars.breakfast import TABLE, cereal, facing_pair, jugs, place_setting, shared_bowls, shared_plates
from scene_envs.grammars.distributions import Uniform
from scene_envs.grammars.dsl import Cluster, Group, OneOf
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.parts import at_least
from scene_envs.grammars.towers import Node, Surface
from scene_envs.scene_types import get_scene_type


def six_places(plate: float, bowl: float, nothing: float) -> Node:
    """Three pairs of places that face each other: near both ends and in the middle of the long sides."""
    pair = facing_pair(place_setting(plate, bowl, nothing, another_toast=0.25))
    ends_and_middle = (Uniform(0.0, 0.065, y=-0.40), Uniform(0.0, 0.04), Uniform(0.0, 0.065, y=0.40))
    return Group(*(Cluster(pair, where) for where in ends_and_middle))


def shared(fullness: float) -> Node:
    return Group(shared_plates(1 - fullness, 4, 0.25), shared_bowls(1 - fullness, 6), cereal(0.4), jugs(0.6))


USUAL = Group(six_places(0.535, 0.19, 0.275), shared(0.3))
QUIET = Group(six_places(0.10, 0.05, 0.85), shared(0.3))
FEAST = Group(six_places(0.95, 0.05, 0.00), shared(0.7))


@register_grammar("breakfast_table_high_clutter")
def breakfast_table_high_clutter() -> Grammar:
    """The whole table."""
    table = Surface([OneOf((0.90, USUAL), (0.03, QUIET), (0.07, FEAST))], TABLE)
    return Grammar("breakfast_table_high_clutter", get_scene_type("breakfast_table_high_clutter"), [table], at_least(3))
