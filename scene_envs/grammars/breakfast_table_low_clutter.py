"""Breakfast Table, low clutter: laid for two who face each other, with shared food and a crock of cutlery.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025). Most published scenes
lack the crock's cutlery; with it, settings are a little rarer here, so that counts match the published ones.
"""

from __future__ import annotations

import math

from scene_envs.grammars.breakfast import (
    TABLE,
    at_least,
    cereal,
    crock,
    jugs,
    place_setting,
    shared_bowls,
    shared_plates,
)
from scene_envs.grammars.dsl import Cluster, Group, OneOf
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.towers import Node, Surface
from scene_envs.grammars.wishes import Gaussian, Yaw
from scene_envs.scene_types import get_scene_type


def two_places(plate: float, bowl: float, nothing: float) -> Node:
    """Two places on the long sides, opposite each other, anywhere along the table."""
    setting = place_setting(plate, bowl, nothing, another_toast=0.2)
    sides = Group(
        Cluster(setting, Gaussian(-0.2, 0.0, along=0.0)),
        Cluster(setting, Gaussian(0.2, 0.0, along=0.0), Yaw(0.0, (math.pi,))),
    )
    return Cluster(sides, Gaussian(0.0, 0.0, along=0.0, across=0.2))


def shared(crock_present: float) -> Node:
    return Group(crock(crock_present), shared_plates(0.7, 2, 0.2), shared_bowls(0.7, 2), cereal(0.3), jugs(0.6))


USUAL = Group(two_places(0.29, 0.11, 0.60), shared(0.18))
FEAST = Group(two_places(0.90, 0.10, 0.00), shared(0.90))


@register_grammar("breakfast_table_low_clutter")
def breakfast_table_low_clutter() -> Grammar:
    """The whole table."""
    table = Surface([OneOf((0.95, USUAL), (0.05, FEAST))], TABLE)
    return Grammar("breakfast_table_low_clutter", get_scene_type("breakfast_table_low_clutter"), [table], at_least(3))
