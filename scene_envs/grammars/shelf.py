"""Shelves of four tiers: one in a living room with games, toys and food, one in a pantry with goods."""

from __future__ import annotations

import math
from collections.abc import Sequence

from scene_envs.grammars.dsl import (
    NOTHING,
    Geometric,
    Group,
    Object,
    OneOf,
    Pile,
    Repeat,
    Stack,
    Tiers,
    at_least,
    maybe,
    middle,
    toast,
)
from scene_envs.grammars.grammar import Grammar, register_grammar
from scene_envs.grammars.layout import Heap, Node, Surface
from scene_envs.grammars.surface import Line, Region, Uniform, Yaw
from scene_envs.scene_types import get_scene_type

TIER_HEIGHTS = (-0.3915, -0.1232, 0.1392, 0.4075)
"""z of the upper side of each board (m), bottom first, in the frame of the shelf."""
HALF_DEPTH, HALF_WIDTH = 0.1475, 0.284
"""Half of the clear depth and width of a tier, m."""
MIDDLE = 0.0025
"""x of the middle of the clear depth (m): the back board takes 5 mm."""
TIER = Region(HALF_DEPTH, HALF_WIDTH, overhang=0.0, x=MIDDLE)
ANYWHERE = Uniform(HALF_DEPTH, HALF_WIDTH, x=MIDDLE)

LENGTHWISE = Yaw(std=0.015, choices=(math.pi / 2, -math.pi / 2))
"""Large games fit lengthwise only."""
FACING_FRONT = Yaw(std=0.1, choices=(math.pi / 2,))
"""A speaker's badge faces the room."""
SQUARE = Yaw(std=0.05, choices=(0.0, math.pi))
"""Small games lie straight."""
NEARLY_SQUARE = Yaw(std=0.15, choices=(0.0, math.pi))
"""Game cases are put down with less care."""

FRUIT = ("apple_gala", "apple_golden", "apple_green", "apple_red", "pear_anjou", "pear_bosc", "pear_red",
         "avocado_a", "avocado_b", "avocado_c")  # fmt: skip


def tiers(inner: Node, top: Node) -> Sequence[Surface]:
    """The four boards, the three inner ones alike."""
    return [
        *(Surface([inner], TIER, height=height) for height in TIER_HEIGHTS[:3]),
        Surface([top], TIER, height=TIER_HEIGHTS[3]),
    ]


def large_games() -> Node:
    """Up to three large games on each other."""
    kinds = ((1.0, "board_game_xl"), (1.0, "board_game_l"), (1.0, "board_game_l2"))
    return Pile(kinds, Geometric(0.7, 1, 3), Uniform(0.006, 0.06, x=MIDDLE), LENGTHWISE)


def small_games() -> Node:
    """Up to four small games on each other: a fifth would not fit under the next board."""
    return Stack("board_game_s", {"board_game_s": 0.3, None: 0.7}, where=ANYWHERE, at_most=4, yaw=SQUARE)


def bookend() -> Node:
    """A book that stands upright against the end of the tier, its spine to the front."""
    y = -HALF_WIDTH + 0.0255
    return Object("book", Line((-0.05, y), (0.06, y)), Yaw(std=0.0))


def plate_of_food() -> Node:
    food = OneOf((1.0, toast(0.2)), (1.0, Object("apple_gala")), (1.0, Object("pear_bosc")), (1.0, NOTHING))
    return Object("shared_plate", ANYWHERE, on=middle(food))


def game_cases(p: float) -> Node:
    """Up to three stacks of game cases."""
    stack = Stack("game_case", {"game_case": 0.3, None: 0.7}, where=ANYWHERE, yaw=NEARLY_SQUARE)
    return Repeat(stack, Geometric(p, 0, 3))


def drinks(asset: str, p: float) -> Node:
    return Repeat(Object(asset, ANYWHERE), Geometric(p, 0, 6))


def tier_objects(toy: float, game: float, p: float) -> Node:
    """Objects of one tier: ``toy`` is the chance of the book and of each toy, ``game`` that of small games and of a
    plate, ``p`` the parameter of the geometric distributions of the numbers of game cases, cans and bottles.
    """
    return Group(
        maybe(toy, bookend()),
        maybe(game, small_games()),
        maybe(0.1, Object("speaker", ANYWHERE, FACING_FRONT)),
        maybe(game, plate_of_food()),
        game_cases(p),
        drinks("soda_can", p),
        drinks("tea_bottle", p),
        maybe(toy, Object("stacking_ring", ANYWHERE)),
        maybe(toy, Object("toy_train", ANYWHERE)),
    )


def inner_tier() -> Node:
    return OneOf((0.48, tier_objects(toy=0.12, game=0.08, p=0.85)), (0.08, large_games()), (0.44, NOTHING))


def full_tier() -> Node:
    return OneOf((0.9, tier_objects(toy=0.3, game=0.4, p=0.55)), (0.1, large_games()))


def top_tier() -> Node:
    """The top of the shelf: lamps, a fruit bowl, small games, a speaker."""
    setting = Group(
        maybe(0.2, fruit_bowl(("apple_gala", "pear_bosc"))),
        maybe(0.3, small_games()),
        maybe(0.1, Object("speaker", ANYWHERE, FACING_FRONT)),
        Repeat(Object("lamp", ANYWHERE), Geometric(0.8, 0, 2)),
    )
    return OneOf((0.8, setting), (0.1, large_games()), (0.1, NOTHING))


@register_grammar("living_room_shelf")
def living_room_shelf() -> Grammar:
    """The whole shelf."""
    usual, full = (Tiers(tiers(inner, top_tier())) for inner in (inner_tier(), full_tier()))
    room = Surface([OneOf((0.98, usual), (0.02, full))], Region(1.0, 1.0))
    return Grammar("living_room_shelf", get_scene_type("living_room_shelf"), [room], at_least(3))


def goods(p: float) -> Node:
    """Some of each kind, anywhere on the tier."""
    kinds = ("tea_bottle", "soda_can", *FRUIT)
    return Group(*(Repeat(Object(kind, ANYWHERE), Geometric(p, 0, 10)) for kind in kinds))


def fruit_bowl(kinds: Sequence[str]) -> Node:
    """A bowl with up to three pieces of fruit of these kinds, equally likely."""
    piece = OneOf(*((1.0, Object(kind)) for kind in kinds))
    return Object("fruit_bowl", ANYWHERE, inside=Heap(Repeat(piece, Geometric(0.5, 0, 3)), 0.03))


def pantry(p: float) -> Node:
    """The whole shelf; ``p`` is the parameter of the geometric distribution of the number of each kind."""
    return Tiers(tiers(goods(p), Group(maybe(0.2, fruit_bowl(FRUIT)), goods(p))))


@register_grammar("pantry_shelf")
def pantry_shelf() -> Grammar:
    """Shelves from nearly empty to packed."""
    shelves = OneOf((0.02, pantry(0.93)), (0.90, pantry(0.649)), (0.08, pantry(0.5)))
    room = Surface([shelves], Region(1.0, 1.0))
    return Grammar("pantry_shelf", get_scene_type("pantry_shelf"), [room], at_least(2))
