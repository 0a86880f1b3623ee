"""Breakfast Table, low clutter: laid for two who face each other, with shared food and a crock of cutlery.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025). Most published scenes
lack the crock's cutlery. Here the crock holds its cutlery, and settings are rarer, so that counts match the published
ones.
"""

from __future__ import annotations

from scene_envs.grammars.breakfast import (
    TABLE,
    cereal,
    crock,
    facing_pair,
    jugs,
    place_setting,
    shared_bowls,
    shared_plates,
)
from scene_envs.grammars.distributions import Gaussian
from scene_envs.grammars.dsl import Cluster, Group, OneOf
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.parts import at_least
from scene_envs.grammars.towers import Node, Surface
from scene_envs.scene_types import get_scene_type


def two_places(plate: float, bowl: float, nothing: float) -> Node:
    """Two places on the long sides, opposite each other, anywhere along the table."""
    pair = facing_pair(place_setting(plate, bowl, nothing, another_toast=0.2))
    return Cluster(pair, Gaussian(0.0, 0.0, along=0.0, across=0.2))


def shared(crock_present: float) -> Node:
    return Group(crock(crock_present), shared_plates(0.7, 2, 0.2), shared_bowls(0.7, 2), cereal(0.58), jugs(0.6))


USUAL = Group(two_places(0.36, 0.12, 0.52), shared(0.12))
FEAST = Group(two_places(0.90, 0.10, 0.00), shared(0.90))


@register_grammar("breakfast_table_low_clutter")
def breakfast_table_low_clutter() -> Grammar:
    """The whole table."""
    table = Surface([OneOf((0.98, USUAL), (0.02, FEAST))], TABLE)
    return Grammar("breakfast_table_low_clutter", get_scene_type("breakfast_table_low_clutter"), [table], at_least(3))
