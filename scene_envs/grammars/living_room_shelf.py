"""Living Room Shelf: board games, drinks, a book, toys and lamps on four tiers.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025), whose stacks of small games
were thrown away by its own constraints; here they stand.
"""

from __future__ import annotations

import math

from scene_envs.grammars.breakfast import at_least, middle, toast
from scene_envs.grammars.containers import Heap
from scene_envs.grammars.dsl import NOTHING, Geometric, Group, Object, OneOf, Pile, Repeat, Stack, Tiers
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.shelf import HALF_DEPTH, HALF_WIDTH, MIDDLE, tiers
from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface
from scene_envs.grammars.wishes import Line, Uniform, Wish, Yaw
from scene_envs.scene_types import get_scene_type

ALONG_SHELF = Yaw(std=0.015, choices=(math.pi / 2, -math.pi / 2))
"""Large games fit lengthwise only."""
FACING_FRONT = Yaw(std=0.1, choices=(math.pi / 2, -math.pi / 2))
"""A speaker plays to the room."""
SQUARE = Yaw(std=0.05, choices=(0.0, math.pi))
"""Small games lie straight."""


def anywhere() -> Wish:
    return Uniform(HALF_DEPTH, HALF_WIDTH, x=MIDDLE)


def maybe(chance: float, node: Node) -> Node:
    return OneOf((chance, node), (1.0 - chance, NOTHING))


def large_games() -> Node:
    """Up to three large games on each other."""
    kinds = ((1.0, "board_game_xl"), (1.0, "board_game_l"), (1.0, "board_game_l2"))
    return Pile(kinds, Geometric(0.7, 1, 3), Uniform(0.006, 0.06, x=MIDDLE), ALONG_SHELF)


def small_games() -> Node:
    """Up to four small games on each other."""
    return Stack("board_game_s", {"board_game_s": 0.3, None: 0.7}, where=anywhere(), at_most=4, yaw=SQUARE)


def bookend() -> Node:
    """A book that stands upright against the end of the tier, its spine to the front."""
    y = -HALF_WIDTH + 0.0255
    return Object("book", Line((-0.05, y), (0.06, y)), Yaw(std=0.0))


def plate_of_food() -> Node:
    food = OneOf((1.0, toast(0.2)), (1.0, Object("apple_gala")), (1.0, Object("pear_bosc")), (1.0, NOTHING))
    return Object("shared_plate", anywhere(), on=middle(food))


def drinks(asset: str) -> Node:
    return Repeat(Object(asset, anywhere()), Geometric(0.7, 0, 6))


def inner_tier(mixed: float = 0.20, games: float = 0.07, nothing: float = 0.73) -> Node:
    """A tier with a mixed setting, large games, or nothing, by weight."""
    setting = Group(
        maybe(0.2, bookend()),
        maybe(0.3, small_games()),
        maybe(0.1, Object("speaker", anywhere(), FACING_FRONT)),
        maybe(0.2, plate_of_food()),
        Repeat(Stack("game_case", {"game_case": 0.3, None: 0.7}, where=anywhere(), yaw=Yaw()), Geometric(0.7, 0, 3)),
        drinks("soda_can"),
        drinks("tea_bottle"),
        maybe(0.2, Object("stacking_ring", anywhere())),
        maybe(0.2, Object("toy_train", anywhere())),
    )
    return OneOf((mixed, setting), (games, large_games()), (nothing, NOTHING))


def top_tier() -> Node:
    """The top of the shelf: lamps, a fruit bowl, small games, a speaker."""
    fruit = OneOf((1.0, Object("apple_gala")), (1.0, Object("pear_bosc")))
    bowl = Object("fruit_bowl", anywhere(), inside=Heap(Repeat(fruit, Geometric(0.6, 0, 3)), 0.03))
    setting = Group(
        maybe(0.2, bowl),
        maybe(0.3, small_games()),
        maybe(0.1, Object("speaker", anywhere(), FACING_FRONT)),
        Repeat(Object("lamp", anywhere()), Geometric(0.8, 0, 2)),
    )
    return OneOf((0.8, setting), (0.1, large_games()), (0.1, NOTHING))


USUAL = Tiers(tiers(inner_tier(), top_tier()))
FULL = Tiers(tiers(inner_tier(0.9, 0.1, 0.0), top_tier()))


@register_grammar("living_room_shelf")
def living_room_shelf() -> Grammar:
    """The whole shelf."""
    room = Surface([OneOf((0.97, USUAL), (0.03, FULL))], Region(1.0, 1.0))
    return Grammar("living_room_shelf", get_scene_type("living_room_shelf"), [room], at_least(3))
