"""What a breakfast table is laid with: place settings, shared food, a crock of cutlery.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from scene_envs.grammars.containers import Heap, Standing
from scene_envs.grammars.dsl import NOTHING, Geometric, Group, Object, OneOf, Repeat, Stack
from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface, Tower
from scene_envs.grammars.wishes import Gaussian, Uniform, Wish, Yaw

TABLE = Region(0.2575, 0.60, overhang=0.10)
"""Frames stay 10 cm from the edge of the table, so that nothing hangs over it."""

CROCK_RADIUS = 0.055
"""Inner radius of the utensil crock, m."""

ALONG = Yaw(std=0.06)
"""Cutlery points to the middle of the table."""
ACROSS = Yaw(std=0.06, choices=(math.pi / 2, -math.pi / 2))
"""Cutlery above the plate lies across."""


def middle(child: Node) -> list[Surface]:
    """Something in the middle of a plate or on the floor of a bowl."""
    return [Surface([child], Region(0.01, 0.01), height=None)]


def near(x: float, y: float) -> Gaussian:
    """A place of the setting: x toward the middle of the table, y to the left of who sits there, m."""
    return Gaussian(x, y, along=0.01)


def toast(another: float) -> Node:
    """A slice of bread, with more on top by chance."""
    return Stack("bread_slice", {"bread_slice": another, None: 1.0 - another})


def fruit(name: str) -> Node:
    return Object(name)


def place_setting(plate: float, bowl: float, nothing: float, another_toast: float) -> Node:
    """One person's place, in a frame whose x axis points to the middle of the table."""
    cutlery = Group(
        OneOf((0.7, Object("fork", near(0.0, 0.135), ALONG)), (0.3, NOTHING)),
        OneOf((0.8, Object("knife", near(0.0, -0.125), ALONG)), (0.2, NOTHING)),
        OneOf(
            (0.2, Object("dinner_spoon", near(0.135, 0.0), ACROSS)),
            (0.2, Object("teaspoon", near(0.135, 0.0), ACROSS)),
            (0.6, NOTHING),
        ),
        OneOf((0.8, Object("mug", near(0.10, -0.20))), (0.2, NOTHING)),
    )
    on_plate = OneOf(
        (0.2, toast(another_toast)),
        (0.1, fruit("apple_gala")),
        (0.1, fruit("pear_bosc")),
        (0.2, Object("bowl")),
        (0.4, NOTHING),
    )
    spoons = Group(
        *(
            OneOf((1.0, Object("dinner_spoon", where, yaw)), (1.0, Object("teaspoon", where, yaw)), (4.0, NOTHING))
            for where, yaw in ((near(0.0, -0.115), ALONG), (near(0.115, 0.0), ACROSS))
        )
    )
    in_bowl = OneOf((0.1, Object("apple_gala")), (0.1, Object("pear_bosc")), (0.8, NOTHING))
    here, straight = Gaussian(along=0.02), Yaw(std=0.0)
    return OneOf(
        (plate, Object("plate", here, straight, on=middle(on_plate), beside=cutlery)),
        (bowl, Object("bowl", here, straight, on=middle(in_bowl), beside=spoons)),
        (nothing, NOTHING),
    )


def anywhere() -> Wish:
    return Uniform(0.30, 0.60)


def shared_plates(p: float, most: int, another_toast: float) -> Node:
    """Plates for all, each with toast or fruit."""
    food = OneOf((0.5, toast(another_toast)), (0.25, fruit("apple_gala")), (0.25, fruit("pear_bosc")))
    return Repeat(Object("shared_plate", anywhere(), on=middle(food)), Geometric(p, 0, most))


def shared_bowls(p: float, most: int) -> Node:
    """Bowls for all, each with toast or fruit, which comes to rest in it."""
    food = OneOf((0.2, Object("bread_slice")), (0.4, Object("apple_gala")), (0.4, Object("pear_bosc")))
    return Repeat(Object("bowl", anywhere(), inside=Heap(food, radius=0.01, upright=True)), Geometric(p, 0, most))


def cereal(p: float) -> Node:
    return Repeat(Object("cereal_box", anywhere()), Geometric(p, 0, 3))


def jugs(p: float) -> Node:
    return Repeat(Object("water_jug", anywhere()), Geometric(p, 0, 2))


def crock(present: float) -> Node:
    """A crock in which up to ten forks, knives and spoons stand."""
    utensil = OneOf(*((1.0, Object(name)) for name in ("fork", "knife", "dinner_spoon", "teaspoon")))
    cutlery = Standing(Repeat(utensil, Geometric(0.1, 0, 10)), CROCK_RADIUS)
    return OneOf((present, Object("utensil_crock", anywhere(), inside=cutlery)), (1.0 - present, NOTHING))


def at_least(objects: int) -> dict[str, Callable[[Sequence[Tower]], bool]]:
    """The condition that a scene has ``objects`` of them besides the table."""

    def enough(towers: Sequence[Tower]) -> bool:
        return sum(len(tower.assets) + len(tower.contents) for tower in towers) >= objects

    return {f"fewer than {objects} objects": enough}
