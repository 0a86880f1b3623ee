"""Shelves: agreement of the tiers with the shelf asset, the scenes of both grammars, and how many objects they have."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_envs.assets import get_library
from scene_envs.grammars import NOTHING, Object, get_grammar
from scene_envs.grammars.shelf import FRUIT, HALF_DEPTH, HALF_WIDTH, MIDDLE, TIER, TIER_HEIGHTS, tiers
from scene_envs.scene_types import get_scene_type
from tests.helpers.drawn_scenes import (
    Thing,
    apart,
    check_physics,
    check_slots,
    check_support,
    contents_of,
    counts,
    every,
    things_of,
)

SHELF = get_library(("shelf",))["shelf"]
BOXES = np.array([(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in SHELF.fine])
"""(parts, 2, 3) lowest and highest corner of each part, m; all of them are boxes."""
LIVING_ROOM, PANTRY = get_scene_type("living_room_shelf"), get_scene_type("pantry_shelf")
LARGE = ("board_game_l", "board_game_l2", "board_game_xl")
FOOD = ("apple_gala", "pear_bosc", "bread_slice")
RADIUS = {asset.name: float(np.abs(asset.bounds[:, :2]).max()) for asset in PANTRY.library}
"""Outer radius (m); all that stands in a pantry is round."""


@pytest.mark.parametrize("height", TIER_HEIGHTS)
def test_a_board_ends_at_the_height_of_each_tier(height: float) -> None:
    assert any(abs(high[2] - height) < 1e-9 and np.ptp([low[1], high[1]]) > 0.5 for low, high in BOXES)


@pytest.mark.parametrize("height", TIER_HEIGHTS)
def test_no_part_of_the_shelf_is_in_the_way_on_a_tier(height: float) -> None:
    low = np.array([MIDDLE - HALF_DEPTH, -HALF_WIDTH, height])
    high = np.array([MIDDLE + HALF_DEPTH, HALF_WIDTH, height + 0.24])
    overlap = np.minimum(BOXES[:, 1], high) - np.maximum(BOXES[:, 0], low)
    assert not (overlap > 1e-9).all(axis=1).any()


def test_a_tier_keeps_footprints_whole() -> None:
    assert TIER.overhang == 0


def test_three_inner_tiers_and_the_top() -> None:
    inner, top = Object("soda_can"), NOTHING
    surfaces = tiers(inner, top)
    assert [surface.height for surface in surfaces] == list(TIER_HEIGHTS)
    assert [list(surface.children) for surface in surfaces] == [[inner], [inner], [inner], [top]]


# -- whole scenes -----------------------------------------------------------------------------------


@cache
def arrays_of(name: str) -> NDArray[np.float32]:
    """Scenes of the living room, where each has few objects, or of the pantry, where each has many."""
    seed, count = {"living_room_shelf": (1, 80), "pantry_shelf": (3, 18)}[name]
    return get_grammar(name).sample_array(np.random.default_rng(seed), count)


@pytest.fixture(scope="module")
def living_room() -> list[list[Thing]]:
    return things_of(arrays_of("living_room_shelf"), LIVING_ROOM)


@pytest.fixture(scope="module")
def pantry() -> list[list[Thing]]:
    return things_of(arrays_of("pantry_shelf"), PANTRY)


def tier_of(thing: Thing) -> int:
    return int(np.searchsorted(TIER_HEIGHTS, thing.at[2] + 1e-6)) - 1


def in_bowls(scene: list[Thing]) -> set[int]:
    """Ids of what lies in a fruit bowl of a pantry."""
    bowls = [thing for thing in scene if thing.name == "fruit_bowl"]
    return {id(thing) for bowl in bowls for thing in contents_of(bowl, scene, PANTRY)}


@pytest.mark.parametrize("name", ["living_room_shelf", "pantry_shelf"])
def test_slots_are_in_order(name: str) -> None:
    check_slots(arrays_of(name), get_scene_type(name))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count", "mean", "deviation", "fewest", "most"),
    [("living_room_shelf", 200, 5.93, 2.3, 4, 23), ("pantry_shelf", 50, 27.98, 8.5, 3, 61)],
)
def test_counts_follow_the_published_statistics(
    name: str, count: int, mean: float, deviation: float, fewest: int, most: int
) -> None:
    number = counts(get_grammar(name), count)
    assert number.mean() == pytest.approx(mean, abs=4 * deviation / count**0.5)  # standard errors of the mean
    assert number.min() >= fewest
    assert number.max() <= most


@pytest.mark.parametrize(("name", "count"), [("living_room_shelf", 40), ("pantry_shelf", 6)])
def test_kept_by_physics(name: str, count: int) -> None:
    check_physics(arrays_of(name)[:count], get_scene_type(name))


def test_everything_stands_on_a_tier_or_on_something_that_does(living_room: list[list[Thing]]) -> None:
    for scene in living_room:
        for tower in ("board_game_s", *LARGE):  # heights within a stack are checked below
            assert all(thing.rotation[2, 2] == 1.0 for thing in scene if thing.name == tower)
        check_support(scene, LIVING_ROOM, TIER_HEIGHTS)


def test_nothing_sticks_out_of_the_shelf(living_room: list[list[Thing]]) -> None:
    for scene in living_room:
        for thing in scene[1:]:
            corners = np.concatenate([part.vertices for part in LIVING_ROOM.library[thing.name].fine])
            world = corners @ thing.rotation.T + thing.at
            assert world[:, 0].min() > -0.145
            assert world[:, 0].max() < 0.15 + (0.052 if thing.name in LARGE or thing.name in FOOD else 0.0)
            assert np.abs(world[:, 1]).max() < 0.284
            if tier_of(thing) < 3:
                assert world[:, 2].max() < TIER_HEIGHTS[tier_of(thing) + 1] - 0.016


def test_books_stand_upright_against_the_end_with_their_spine_to_the_room(living_room: list[list[Thing]]) -> None:
    books = [book for book, _ in every(living_room, "book")]
    assert books
    for book in books:
        assert (book.rotation == np.eye(3)).all()  # the spine of the asset is toward +x, where the shelf is open
        assert 0.0 < book.at[1] - 0.025 + 0.284 < 1.01e-3  # from the book to the wall
        assert min(abs(book.at[2] - height) for height in TIER_HEIGHTS[:3]) < 1e-6


def test_speakers_face_the_room(living_room: list[list[Thing]]) -> None:
    speakers = [speaker for speaker, _ in every(living_room, "speaker")]
    assert speakers
    for speaker in speakers:
        badge = speaker.rotation @ np.array([0.0, -1.0, 0.0])
        assert badge[0] > 0.9


def test_lamps_and_fruit_bowls_are_on_top_and_drinks_books_and_toys_below(living_room: list[list[Thing]]) -> None:
    below = ("book", "game_case", "shared_plate", "soda_can", "stacking_ring", "tea_bottle", "toy_train")
    assert {tier_of(thing) for thing, _ in every(living_room, "lamp", "fruit_bowl")} == {3}
    assert {tier_of(thing) for thing, _ in every(living_room, *below)} == {0, 1, 2}


def test_large_games_have_a_tier_of_their_own_and_lie_along_it(living_room: list[list[Thing]]) -> None:
    for game, scene in every(living_room, *LARGE):
        tier = [thing for thing in scene[1:] if tier_of(thing) == tier_of(game)]
        assert {thing.name for thing in tier} <= set(LARGE)
        assert len(tier) <= 3
        assert abs(game.rotation[1, 0]) > 0.99  # their long side, x, is along the shelf


def test_games_are_stacked_on_one_axis_without_gaps(living_room: list[list[Thing]]) -> None:
    tallest = 0
    for names in (LARGE, ("board_game_s",), ("game_case",)):
        for bottom, scene in every(living_room, *names):
            if bottom.at[2] not in np.float32(TIER_HEIGHTS):
                continue
            stack = [thing for thing in scene if thing.name in names and tier_of(thing) == tier_of(bottom)]
            stack = sorted((thing for thing in stack if apart(thing, bottom) == 0), key=lambda thing: thing.at[2])
            tops = np.cumsum([LIVING_ROOM.library[thing.name].bounds[1, 2] for thing in stack])
            np.testing.assert_allclose([thing.at[2] - bottom.at[2] for thing in stack], [0, *tops[:-1]], atol=1e-6)
            if names == ("board_game_s",):
                assert len(stack) <= 4
                tallest = max(tallest, len(stack))
    assert tallest >= 2  # the published constraints threw every stack of small games away


def test_food_is_on_a_plate_or_in_the_fruit_bowl(living_room: list[list[Thing]]) -> None:
    for food, scene in every(living_room, *FOOD):
        bowls = [thing for thing in scene if thing.name == "fruit_bowl"]
        inside = [thing for bowl in bowls for thing in contents_of(bowl, scene, LIVING_ROOM)]
        plates = [thing for thing in scene if thing.name == "shared_plate"]
        on_plate = any(apart(food, plate) < 0.02 and tier_of(food) == tier_of(plate) for plate in plates)
        assert on_plate or any(thing is food for thing in inside)


@pytest.mark.slow
def test_everything_stands_on_a_tier_or_lies_in_the_fruit_bowl(pantry: list[list[Thing]]) -> None:
    for scene in pantry:
        lying = in_bowls(scene)
        for thing in scene[1:]:
            if id(thing) not in lying:
                assert thing.rotation[2, 2] == 1.0
                assert min(abs(thing.at[2] - height) for height in TIER_HEIGHTS) < 1e-6


@pytest.mark.slow
def test_neighbors_do_not_touch_and_nothing_leaves_the_shelf(pantry: list[list[Thing]]) -> None:
    for scene in pantry:
        lying = in_bowls(scene)
        for height in TIER_HEIGHTS:
            tier = [thing for thing in scene[1:] if id(thing) not in lying and abs(thing.at[2] - height) < 1e-6]
            for index, thing in enumerate(tier):
                radius = RADIUS[thing.name]
                assert thing.at[0] - radius > -0.145
                assert thing.at[0] + radius < 0.15
                assert abs(thing.at[1]) + radius < 0.284
                for other in tier[:index]:
                    assert apart(thing, other) > radius + RADIUS[other.name]


@pytest.mark.slow
def test_kinds_and_numbers(pantry: list[list[Thing]]) -> None:
    for scene in pantry:
        lying = in_bowls(scene)
        standing = [thing for thing in scene[1:] if id(thing) not in lying]
        per_tier = Counter((thing.name, float(thing.at[2])) for thing in standing)
        assert max(per_tier.values()) <= 10
        assert {name for name, _ in per_tier} <= {"fruit_bowl", "soda_can", "tea_bottle", *FRUIT}
        assert sum(name == "fruit_bowl" for name, _ in per_tier) <= 1
        assert len(lying) <= 3
    for bowl, _ in every(pantry, "fruit_bowl"):
        assert bowl.at[2] == pytest.approx(TIER_HEIGHTS[3], abs=1e-6)


@pytest.mark.slow
def test_every_kind_is_as_frequent_as_the_others(pantry: list[list[Thing]]) -> None:
    number = Counter(thing.name for scene in pantry for thing in scene)
    kinds = [number[name] for name in ("soda_can", "tea_bottle", *FRUIT)]
    assert min(kinds) > 0.5 * max(kinds)
