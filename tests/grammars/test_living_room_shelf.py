"""Living Room Shelf: what every scene obeys, and how many objects there are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_envs.grammars import get_grammar
from scene_envs.grammars.shelf import TIER_HEIGHTS
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

NAME = "living_room_shelf"
SCENE_TYPE = get_scene_type(NAME)
LARGE = ("board_game_l", "board_game_l2", "board_game_xl")
FOOD = ("apple_gala", "pear_bosc", "bread_slice")


@pytest.fixture(scope="module")
def arrays() -> NDArray[np.float32]:
    return get_grammar(NAME).sample_array(np.random.default_rng(1), 120)


@pytest.fixture(scope="module")
def scenes(arrays: NDArray[np.float32]) -> list[list[Thing]]:
    return things_of(arrays, SCENE_TYPE)


def tier_of(thing: Thing) -> int:
    return int(np.searchsorted(TIER_HEIGHTS, thing.at[2] + 1e-6)) - 1


def test_slots_are_in_order(arrays: NDArray[np.float32]) -> None:
    check_slots(arrays, SCENE_TYPE)


@pytest.mark.slow
def test_counts_follow_the_published_statistics() -> None:
    number = counts(get_grammar(NAME), 400)
    # 400 scenes of standard deviation 2.3: the standard error of the mean is 0.12.
    assert number.mean() == pytest.approx(5.93, abs=4 * 0.12)
    assert number.min() == 4
    assert number.max() <= 23


def test_everything_stands_on_a_tier_or_on_something_that_does(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        for tower in ("board_game_s", *LARGE):  # heights within a stack are checked below
            assert all(thing.rotation[2, 2] == 1.0 for thing in scene if thing.name == tower)
        check_support(scene, SCENE_TYPE, TIER_HEIGHTS)


def test_nothing_sticks_out_of_the_shelf(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        for thing in scene[1:]:
            corners = np.concatenate([part.vertices for part in SCENE_TYPE.library[thing.name].fine])
            world = corners @ thing.rotation.T + thing.at
            assert world[:, 0].min() > -0.145
            assert world[:, 0].max() < 0.15 + (0.052 if thing.name in LARGE or thing.name in FOOD else 0.0)
            assert np.abs(world[:, 1]).max() < 0.284
            if tier_of(thing) < 3:
                assert world[:, 2].max() < TIER_HEIGHTS[tier_of(thing) + 1] - 0.016


def test_books_stand_upright_against_the_end_with_their_spine_to_the_room(scenes: list[list[Thing]]) -> None:
    books = [book for book, _ in every(scenes, "book")]
    assert books
    for book in books:
        assert (book.rotation == np.eye(3)).all()  # the spine of the asset is toward +x, where the shelf is open
        assert 0.0 < book.at[1] - 0.025 + 0.284 < 1.01e-3  # from the book to the wall
        assert min(abs(book.at[2] - height) for height in TIER_HEIGHTS[:3]) < 1e-6


def test_speakers_face_the_room(scenes: list[list[Thing]]) -> None:
    speakers = [speaker for speaker, _ in every(scenes, "speaker")]
    assert speakers
    for speaker in speakers:
        badge = speaker.rotation @ np.array([0.0, -1.0, 0.0])
        assert badge[0] > 0.9


def test_lamps_and_fruit_bowls_are_on_top_and_drinks_books_and_toys_below(scenes: list[list[Thing]]) -> None:
    below = ("book", "game_case", "shared_plate", "soda_can", "stacking_ring", "tea_bottle", "toy_train")
    assert {tier_of(thing) for thing, _ in every(scenes, "lamp", "fruit_bowl")} == {3}
    assert {tier_of(thing) for thing, _ in every(scenes, *below)} == {0, 1, 2}


def test_large_games_have_a_tier_of_their_own_and_lie_along_it(scenes: list[list[Thing]]) -> None:
    for game, scene in every(scenes, *LARGE):
        tier = [thing for thing in scene[1:] if tier_of(thing) == tier_of(game)]
        assert {thing.name for thing in tier} <= set(LARGE)
        assert len(tier) <= 3
        assert abs(game.rotation[1, 0]) > 0.99  # their long side, x, is along the shelf


def test_games_are_stacked_on_one_axis_without_gaps(scenes: list[list[Thing]]) -> None:
    tallest = 0
    for names in (LARGE, ("board_game_s",), ("game_case",)):
        for bottom, scene in every(scenes, *names):
            if bottom.at[2] not in np.float32(TIER_HEIGHTS):
                continue
            stack = [thing for thing in scene if thing.name in names and tier_of(thing) == tier_of(bottom)]
            stack = sorted((thing for thing in stack if apart(thing, bottom) == 0), key=lambda thing: thing.at[2])
            tops = np.cumsum([SCENE_TYPE.library[thing.name].bounds[1, 2] for thing in stack])
            np.testing.assert_allclose([thing.at[2] - bottom.at[2] for thing in stack], [0, *tops[:-1]], atol=1e-6)
            if names == ("board_game_s",):
                assert len(stack) <= 4
                tallest = max(tallest, len(stack))
    assert tallest >= 2  # the published constraints threw every stack of small games away


def test_food_is_on_a_plate_or_in_the_fruit_bowl(scenes: list[list[Thing]]) -> None:
    for food, scene in every(scenes, *FOOD):
        bowls = [thing for thing in scene if thing.name == "fruit_bowl"]
        inside = [thing for bowl in bowls for thing in contents_of(bowl, scene, SCENE_TYPE)]
        plates = [thing for thing in scene if thing.name == "shared_plate"]
        on_plate = any(apart(food, plate) < 0.02 and tier_of(food) == tier_of(plate) for plate in plates)
        assert on_plate or any(thing is food for thing in inside)


def test_kept_by_physics(arrays: NDArray[np.float32]) -> None:
    check_physics(arrays[:60], SCENE_TYPE)


def test_the_same_seed_gives_the_same_scenes_and_another_gives_others() -> None:
    first, again, other = (get_grammar(NAME).sample_array(np.random.default_rng(seed), 3) for seed in (4, 4, 5))
    assert (first == again).all()
    assert not (first == other).all()
