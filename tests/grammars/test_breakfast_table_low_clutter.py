"""Breakfast Table, low clutter: what every scene obeys, and how many objects there are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_envs.grammars import get_grammar
from scene_envs.scene_types import get_scene_type
from tests.helpers.drawn_scenes import (
    Thing,
    apart,
    check_physics,
    check_slots,
    check_support,
    contents_of,
    counts,
    things_of,
)

NAME = "breakfast_table_low_clutter"
SCENE_TYPE = get_scene_type(NAME)


@pytest.fixture(scope="module")
def arrays() -> NDArray[np.float32]:
    return get_grammar(NAME).sample_array(np.random.default_rng(1), 60)


@pytest.fixture(scope="module")
def scenes(arrays: NDArray[np.float32]) -> list[list[Thing]]:
    return things_of(arrays, SCENE_TYPE)


def test_slots_are_in_order(arrays: NDArray[np.float32]) -> None:
    check_slots(arrays, SCENE_TYPE)


def test_counts_follow_the_published_statistics() -> None:
    number = counts(get_grammar(NAME), 400)
    # 400 scenes of standard deviation 3.8: the standard error of the mean is 0.19.
    assert number.mean() == pytest.approx(8.87, abs=4 * 0.19)
    assert number.min() == 4
    assert number.max() <= 26


def test_everything_stands_on_the_table_on_a_plate_or_in_something(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        check_support(scene, SCENE_TYPE, levels=(0.0,))


def test_at_most_two_places_opposite_each_other_and_one_crock(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        plates = [thing for thing in scene if thing.name == "plate"]
        assert len(plates) <= 2
        if len(plates) == 2:
            assert sorted(np.sign(plate.at[0]) for plate in plates) == [-1, 1]
            assert abs(plates[0].at[1] - plates[1].at[1]) < 0.07
        assert sum(thing.name == "utensil_crock" for thing in scene) <= 1
        assert sum(thing.name == "shared_plate" for thing in scene) <= 2
        assert sum(thing.name == "cereal_box" for thing in scene) <= 3
        assert sum(thing.name == "water_jug" for thing in scene) <= 2


def test_cutlery_on_the_table_lies_beside_a_place_and_the_rest_is_in_the_crock(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        jars = [thing for thing in scene if thing.name == "utensil_crock"]
        standing = {id(tool) for jar in jars for tool in contents_of(jar, scene, SCENE_TYPE)}
        places = [thing for thing in scene if thing.name in ("plate", "bowl") and thing.at[2] == 0]
        for tool in scene:
            if tool.name in ("fork", "knife", "dinner_spoon", "teaspoon") and id(tool) not in standing:
                assert tool.at[2] == 0
                assert min(apart(tool, place) for place in places) < 0.17


def test_kept_by_physics(arrays: NDArray[np.float32]) -> None:
    check_physics(arrays[:24], SCENE_TYPE)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_scenes_and_another_gives_others() -> None:
    first, again, other = (get_grammar(NAME).sample_array(np.random.default_rng(seed), 3) for seed in (4, 4, 5))
    assert (first == again).all()
    assert not (first == other).all()
