"""Breakfast tables: single settings, the scenes of both grammars, and how many objects they have."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_envs.grammars import Cluster, Gaussian, Grammar, Node, Surface, Yaw, get_grammar
from scene_envs.grammars.breakfast import TABLE, crock, facing_pair, place_setting, shared_bowls, shared_plates
from scene_envs.scene_types import get_scene_type
from tests.helpers.drawn_scenes import (
    Thing,
    apart,
    check_physics,
    check_reproducible,
    check_slots,
    check_support,
    contents_of,
    counts,
    every,
    things_of,
)

LOW, HIGH = "breakfast_table_low_clutter", "breakfast_table_high_clutter"
SCENE_TYPE = get_scene_type(LOW)
FLAT = {"plate": 0.071, "shared_plate": 0.079, "bowl": 0.034}
"""Radius (m) of what is flat and free at the bottom of each, from the page on assets."""


def drawn(node: Node, count: int, seed: int = 0) -> list[list[Thing]]:
    """Scenes of a table with nothing but ``node``."""
    grammar = Grammar("part of a table", SCENE_TYPE, [Surface([node], TABLE)])
    return things_of(grammar.sample_array(np.random.default_rng(seed), count), SCENE_TYPE)


@pytest.fixture(scope="module")
def plates() -> list[list[Thing]]:
    return drawn(place_setting(1.0, 0.0, 0.0, another_toast=0.25), 300)


def angle_from_x(thing: Thing) -> float:
    return math.atan2(thing.rotation[1, 0], thing.rotation[0, 0])


def test_fork_is_left_and_knife_right_of_the_plate_and_both_point_away_from_the_sitter(
    plates: list[list[Thing]],
) -> None:
    # Who sits there looks along +x, so that left is +y.
    for tool, scene in every(plates, "fork", "knife"):
        plate = next(thing for thing in scene if thing.name == "plate")
        dx, dy, dz = tool.at - plate.at
        assert abs(dx) < 0.02
        assert 0.11 < (dy if tool.name == "fork" else -dy) < 0.16
        assert dz == 0
        assert abs(angle_from_x(tool)) < 0.4


def test_spoon_lies_across_above_the_plate_and_mug_stands_top_right(plates: list[list[Thing]]) -> None:
    for spoon, scene in every(plates, "dinner_spoon", "teaspoon"):
        plate = next(thing for thing in scene if thing.name == "plate")
        assert 0.11 < spoon.at[0] - plate.at[0] < 0.16
        assert abs(spoon.at[1] - plate.at[1]) < 0.02
        assert abs(math.cos(angle_from_x(spoon))) < 0.4
    for mug, scene in every(plates, "mug"):
        plate = next(thing for thing in scene if thing.name == "plate")
        assert mug.at[0] > plate.at[0] + 0.1
        assert mug.at[1] < plate.at[1] - 0.15


def test_shares_of_what_belongs_to_a_plate(plates: list[list[Thing]]) -> None:
    # 300 settings: the standard deviation of a share is at most 2.9 %.
    share = {name: len(list(every(plates, name))) / len(plates) for name in SCENE_TYPE.assets}
    assert share["plate"] == 1
    assert share["fork"] == pytest.approx(0.7, abs=0.1)
    assert share["knife"] == pytest.approx(0.8, abs=0.1)
    assert share["mug"] == pytest.approx(0.8, abs=0.1)
    assert share["dinner_spoon"] + share["teaspoon"] == pytest.approx(0.4, abs=0.1)
    assert share["bowl"] == pytest.approx(0.2, abs=0.1)
    assert share["bread_slice"] == pytest.approx(0.2 / 0.75, abs=0.13)


def test_what_is_on_a_plate_stands_on_its_flat_middle(plates: list[list[Thing]]) -> None:
    shared = drawn(shared_plates(0.01, 2, another_toast=0.25), 40)
    for plate, scene in every([*plates, *shared], "plate", "shared_plate"):
        on_it = [thing for thing in scene if thing.at[2] > 0 and apart(thing, plate) < 0.1]
        assert plate.name == "plate" or on_it  # a shared plate is never empty
        for thing in on_it:
            reach = 0.074 if thing.name == "bread_slice" else 0.0355
            assert apart(thing, plate) + min(reach, 0.052) < FLAT[plate.name]
        levels = sorted(thing.at[2] for thing in on_it)
        np.testing.assert_allclose(levels, 0.006 + 0.016 * np.arange(len(levels)), atol=1e-6)


def test_slices_of_toast_are_stacked_on_one_axis() -> None:
    scenes = drawn(shared_plates(0.01, 2, another_toast=0.25), 120)
    stacks = 0
    for plate, scene in every(scenes, "shared_plate"):
        toast = [thing for thing in scene if thing.name == "bread_slice" and apart(thing, plate) < 0.05]
        assert all(apart(toast[0], slice_) == 0 for slice_ in toast)
        stacks += len(toast) > 1
    assert stacks >= 5  # about an eighth of 200 plates


@pytest.mark.slow
def test_fruit_stands_in_the_middle_of_a_bowl_and_bread_leans_in_it() -> None:
    scenes = drawn(shared_bowls(0.01, 2), 40)
    for bowl, scene in every(scenes, "bowl"):
        (food,) = contents_of(bowl, scene, SCENE_TYPE)
        assert apart(food, bowl) < 0.0725 - 0.02
        if food.name != "bread_slice":
            assert food.at[2] == pytest.approx(0.006, abs=1e-6)


@pytest.mark.slow
def test_utensils_stand_in_the_crock_with_their_heads_up() -> None:
    scenes = drawn(crock(1.0), 7)
    numbers = []
    for jar, scene in every(scenes, "utensil_crock"):
        inside = contents_of(jar, scene, SCENE_TYPE)
        assert len(inside) == len(scene) - 2  # all but the crock and the table
        numbers.append(len(inside))
        for tool in inside:
            assert tool.rotation[2, 0] > 0.8  # its long axis, handle to head, is within 37 degrees of the vertical
            low = SCENE_TYPE.library[tool.name].bounds[0, 0]
            handle = tool.at + tool.rotation @ np.array([low, 0.0, 0.0])
            assert np.hypot(*(handle - jar.at)[:2]) < 0.055
            assert 0.0 < handle[2] < 0.03
    assert max(numbers) >= 5


def test_settings_of_a_pair_face_each_other() -> None:
    for scene in drawn(facing_pair(place_setting(1.0, 0.0, 0.0, another_toast=0.2)), 40):
        near, far = sorted((thing for thing in scene if thing.name == "plate"), key=lambda plate: plate.at[0])
        assert near.at[0] < -0.15
        assert far.at[0] > 0.15
        for fork in (thing for thing in scene if thing.name == "fork"):
            assert (fork.at[1] > 0) == (fork.at[0] < 0)  # each on the left of who sits there


def test_nothing_hangs_over_the_edge() -> None:
    shifted = Cluster(facing_pair(place_setting(1.0, 0.0, 0.0, 0.2)), Gaussian(0.0, 0.45, along=0.02), Yaw(0.0))
    for scene in drawn(shifted, 60):
        for thing in scene[1:]:
            corners = np.concatenate([part.vertices for part in SCENE_TYPE.library[thing.name].fine])
            world = corners @ thing.rotation.T + thing.at
            assert np.abs(world[:, 0]).max() < 0.375
            assert np.abs(world[:, 1]).max() < 0.75


# -- whole scenes -----------------------------------------------------------------------------------


@cache
def arrays_of(name: str) -> NDArray[np.float32]:
    return get_grammar(name).sample_array(np.random.default_rng(1), 28)


@pytest.fixture(scope="module")
def low() -> list[list[Thing]]:
    return things_of(arrays_of(LOW), get_scene_type(LOW))


@pytest.fixture(scope="module")
def high() -> list[list[Thing]]:
    return things_of(arrays_of(HIGH), get_scene_type(HIGH))


@pytest.mark.parametrize("name", [LOW, HIGH])
def test_slots_are_in_order_and_everything_stands_on_something(name: str) -> None:
    check_slots(arrays_of(name), get_scene_type(name))
    for scene in things_of(arrays_of(name), get_scene_type(name)):
        check_support(scene, get_scene_type(name), levels=(0.0,))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count", "mean", "deviation", "fewest", "most"),
    [(LOW, 200, 8.87, 3.8, 4, 26), (HIGH, 60, 20.96, 6.5, 4, 46)],
)
def test_counts_follow_the_published_statistics(
    name: str, count: int, mean: float, deviation: float, fewest: int, most: int
) -> None:
    number = counts(get_grammar(name), count)
    assert number.mean() == pytest.approx(mean, abs=4 * deviation / count**0.5)  # standard errors of the mean
    assert number.min() >= fewest
    assert number.max() <= most


@pytest.mark.parametrize(("name", "count"), [(LOW, 24), (HIGH, 16)])
def test_kept_by_physics(name: str, count: int) -> None:
    check_physics(arrays_of(name)[:count], get_scene_type(name))


def test_the_same_seed_gives_the_same_scenes_and_another_gives_others() -> None:
    check_reproducible(LOW)


def test_at_most_two_places_opposite_each_other_and_one_crock(low: list[list[Thing]]) -> None:
    for scene in low:
        plates = [thing for thing in scene if thing.name == "plate"]
        assert len(plates) <= 2
        if len(plates) == 2:
            assert sorted(np.sign(plate.at[0]) for plate in plates) == [-1, 1]
            assert abs(plates[0].at[1] - plates[1].at[1]) < 0.07
        assert sum(thing.name == "utensil_crock" for thing in scene) <= 1
        assert sum(thing.name == "shared_plate" for thing in scene) <= 2
        assert sum(thing.name == "cereal_box" for thing in scene) <= 3
        assert sum(thing.name == "water_jug" for thing in scene) <= 2


def test_cutlery_on_the_table_lies_beside_a_place_and_the_rest_is_in_the_crock(low: list[list[Thing]]) -> None:
    for scene in low:
        jars = [thing for thing in scene if thing.name == "utensil_crock"]
        standing = {id(tool) for jar in jars for tool in contents_of(jar, scene, SCENE_TYPE)}
        places = [thing for thing in scene if thing.name in ("plate", "bowl") and thing.at[2] == 0]
        for tool in scene:
            if tool.name in ("fork", "knife", "dinner_spoon", "teaspoon") and id(tool) not in standing:
                assert tool.at[2] == 0
                assert min(apart(tool, place) for place in places) < 0.17


def test_up_to_three_places_along_each_side(high: list[list[Thing]]) -> None:
    for scene in high:
        for side in (-1.0, 1.0):
            along = sorted(thing.at[1] for thing in scene if thing.name == "plate" and thing.at[0] * side > 0)
            assert len(along) <= 3
            assert (np.diff(along) > 0.23).all()
        assert all(0.16 < abs(thing.at[0]) < 0.24 for thing in scene if thing.name == "plate")
        assert sum(thing.name == "shared_plate" for thing in scene) <= 4
        assert sum(thing.name == "bowl" for thing in scene) <= 12
        assert sum(thing.name == "cereal_box" for thing in scene) <= 3
        assert sum(thing.name == "water_jug" for thing in scene) <= 2
        assert sum(thing.name == "mug" for thing in scene) <= sum(thing.name == "plate" for thing in scene)


def test_each_fork_is_left_and_each_knife_right_of_a_plate(high: list[list[Thing]]) -> None:
    # Who sits at x < 0 looks along +x and has the left hand toward +y; the other side is the mirror of it.
    for scene in high:
        plates = [thing for thing in scene if thing.name == "plate"]
        for tool in (thing for thing in scene if thing.name in ("fork", "knife")):
            toward_left = -np.sign(tool.at[0]) * (1.0 if tool.name == "fork" else -1.0)
            assert any(
                0.11 < toward_left * (tool.at[1] - plate.at[1]) < 0.16 and abs(tool.at[0] - plate.at[0]) < 0.03
                for plate in plates
            )
