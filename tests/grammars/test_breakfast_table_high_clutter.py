"""Breakfast Table, high clutter: what every scene obeys, and how many objects there are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_envs.grammars import get_grammar
from scene_envs.scene_types import get_scene_type
from tests.helpers.drawn_scenes import Thing, check_physics, check_slots, check_support, counts, things_of

NAME = "breakfast_table_high_clutter"
SCENE_TYPE = get_scene_type(NAME)


@pytest.fixture(scope="module")
def arrays() -> NDArray[np.float32]:
    return get_grammar(NAME).sample_array(np.random.default_rng(1), 40)


@pytest.fixture(scope="module")
def scenes(arrays: NDArray[np.float32]) -> list[list[Thing]]:
    return things_of(arrays, SCENE_TYPE)


def test_slots_are_in_order(arrays: NDArray[np.float32]) -> None:
    check_slots(arrays, SCENE_TYPE)


@pytest.mark.slow
def test_counts_follow_the_published_statistics() -> None:
    number = counts(get_grammar(NAME), 150)
    # 150 scenes of standard deviation 6.5: the standard error of the mean is 0.53.
    assert number.mean() == pytest.approx(20.96, abs=4 * 0.53)
    assert number.min() >= 4
    assert number.max() <= 46


def test_everything_stands_on_the_table_on_a_plate_or_in_a_bowl(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        check_support(scene, SCENE_TYPE, levels=(0.0,))


def test_up_to_three_places_along_each_side(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
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


def test_each_fork_is_left_and_each_knife_right_of_a_plate(scenes: list[list[Thing]]) -> None:
    # Who sits at x < 0 looks along +x and has the left hand toward +y; the other side is the mirror of it.
    for scene in scenes:
        plates = [thing for thing in scene if thing.name == "plate"]
        for tool in (thing for thing in scene if thing.name in ("fork", "knife")):
            toward_left = -np.sign(tool.at[0]) * (1.0 if tool.name == "fork" else -1.0)
            assert any(
                0.11 < toward_left * (tool.at[1] - plate.at[1]) < 0.16 and abs(tool.at[0] - plate.at[0]) < 0.03
                for plate in plates
            )


def test_kept_by_physics(arrays: NDArray[np.float32]) -> None:
    check_physics(arrays[:16], SCENE_TYPE)


def test_the_same_seed_gives_the_same_scenes_and_another_gives_others() -> None:
    first, again, other = (get_grammar(NAME).sample_array(np.random.default_rng(seed), 2) for seed in (4, 4, 5))
    assert (first == again).all()
    assert not (first == other).all()
