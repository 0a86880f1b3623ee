"""Living Room Shelf: board games, drinks, a book, toys and lamps on four tiers.

Probabilities follow the scene grammar of the paper's dataset (Pfaff et al., CoRL 2025). The paper's constraints
reject stacks of small games; here such stacks are kept.
"""

from __future__ import annotations

import math

from scene_envs.grammars.containers import Heap
from scene_envs.grammars.distributions import Line, PositionDistribution, Uniform, Yaw
from scene_envs.grammars.dsl import NOTHING, Geometric, Group, Object, OneOf, Pile, Repeat, Stack, Tiers
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.parts import at_least, maybe, middle, toast
from scene_envs.grammars.shelf import HALF_DEPTH, HALF_WIDTH, MIDDLE, tiers
from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface
from scene_envs.scene_types import get_scene_type

ALONG_SHELF = Yaw(std=0.015, choices=(math.pi / 2, -math.pi / 2))
"""Large games fit lengthwise only."""
FACING_FRONT = Yaw(std=0.1, choices=(math.pi / 2,))
"""A speaker's badge faces the room."""
SQUARE = Yaw(std=0.05, choices=(0.0, math.pi))
"""Small games lie straight."""
NEARLY_SQUARE = Yaw(std=0.15, choices=(0.0, math.pi))
"""Game cases are put down with less care."""


def anywhere() -> PositionDistribution:
    return Uniform(HALF_DEPTH, HALF_WIDTH, x=MIDDLE)


def large_games() -> Node:
    """Up to three large games on each other."""
    kinds = ((1.0, "board_game_xl"), (1.0, "board_game_l"), (1.0, "board_game_l2"))
    return Pile(kinds, Geometric(0.7, 1, 3), Uniform(0.006, 0.06, x=MIDDLE), ALONG_SHELF)


def small_games() -> Node:
    """Up to four small games on each other: a fifth would not fit under the next board."""
    return Stack("board_game_s", {"board_game_s": 0.3, None: 0.7}, where=anywhere(), at_most=4, yaw=SQUARE)


def bookend() -> Node:
    """A book that stands upright against the end of the tier, its spine to the front."""
    y = -HALF_WIDTH + 0.0255
    return Object("book", Line((-0.05, y), (0.06, y)), Yaw(std=0.0))


def plate_of_food() -> Node:
    food = OneOf((1.0, toast(0.2)), (1.0, Object("apple_gala")), (1.0, Object("pear_bosc")), (1.0, NOTHING))
    return Object("shared_plate", anywhere(), on=middle(food))


def game_cases(p: float) -> Node:
    """Up to three stacks of game cases."""
    stack = Stack("game_case", {"game_case": 0.3, None: 0.7}, where=anywhere(), yaw=NEARLY_SQUARE)
    return Repeat(stack, Geometric(p, 0, 3))


def drinks(asset: str, p: float) -> Node:
    return Repeat(Object(asset, anywhere()), Geometric(p, 0, 6))


def tier_objects(toy: float, game: float, p: float) -> Node:
    """Objects of one tier.

    Args:
        toy: Chance of the book and of each toy.
        game: Chance of small games and of a plate.
        p: Parameter of the geometric distributions of the numbers of game cases, cans and bottles.
    """
    return Group(
        maybe(toy, bookend()),
        maybe(game, small_games()),
        maybe(0.1, Object("speaker", anywhere(), FACING_FRONT)),
        maybe(game, plate_of_food()),
        game_cases(p),
        drinks("soda_can", p),
        drinks("tea_bottle", p),
        maybe(toy, Object("stacking_ring", anywhere())),
        maybe(toy, Object("toy_train", anywhere())),
    )


def inner_tier() -> Node:
    return OneOf((0.48, tier_objects(toy=0.12, game=0.08, p=0.85)), (0.08, large_games()), (0.44, NOTHING))


def full_tier() -> Node:
    return OneOf((0.9, tier_objects(toy=0.3, game=0.4, p=0.55)), (0.1, large_games()))


def top_tier() -> Node:
    """The top of the shelf: lamps, a fruit bowl, small games, a speaker."""
    fruit = OneOf((1.0, Object("apple_gala")), (1.0, Object("pear_bosc")))
    bowl = Object("fruit_bowl", anywhere(), inside=Heap(Repeat(fruit, Geometric(0.5, 0, 3)), 0.03))
    setting = Group(
        maybe(0.2, bowl),
        maybe(0.3, small_games()),
        maybe(0.1, Object("speaker", anywhere(), FACING_FRONT)),
        Repeat(Object("lamp", anywhere()), Geometric(0.8, 0, 2)),
    )
    return OneOf((0.8, setting), (0.1, large_games()), (0.1, NOTHING))


USUAL = Tiers(tiers(inner_tier(), top_tier()))
FULL = Tiers(tiers(full_tier(), top_tier()))


@register_grammar("living_room_shelf")
def living_room_shelf() -> Grammar:
    """The whole shelf."""
    room = Surface([OneOf((0.98, USUAL), (0.02, FULL))], Region(1.0, 1.0))
    return Grammar("living_room_shelf", get_scene_type("living_room_shelf"), [room], at_least(3))
