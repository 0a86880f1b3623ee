"""Pantry Shelf: what every scene obeys, and how many objects there are."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_envs.grammars import get_grammar
from scene_envs.grammars.shelf import FRUIT, TIER_HEIGHTS
from scene_envs.scene_types import get_scene_type
from tests.helpers.drawn_scenes import Thing, apart, check_physics, check_slots, contents_of, counts, every, things_of

pytestmark = pytest.mark.slow

NAME = "pantry_shelf"
SCENE_TYPE = get_scene_type(NAME)
RADIUS = {asset.name: float(np.abs(asset.bounds[:, :2]).max()) for asset in SCENE_TYPE.library}
"""Outer radius (m); all that stands in a pantry is round."""


@pytest.fixture(scope="module")
def arrays() -> NDArray[np.float32]:
    return get_grammar(NAME).sample_array(np.random.default_rng(3), 18)


@pytest.fixture(scope="module")
def scenes(arrays: NDArray[np.float32]) -> list[list[Thing]]:
    return things_of(arrays, SCENE_TYPE)


def in_bowls(scene: list[Thing]) -> set[int]:
    """Ids of what lies in a fruit bowl."""
    bowls = [thing for thing in scene if thing.name == "fruit_bowl"]
    return {id(thing) for bowl in bowls for thing in contents_of(bowl, scene, SCENE_TYPE)}


def test_slots_are_in_order(arrays: NDArray[np.float32]) -> None:
    check_slots(arrays, SCENE_TYPE)


def test_counts_follow_the_published_statistics() -> None:
    number = counts(get_grammar(NAME), 100)
    # 100 scenes of standard deviation 8.5: the standard error of the mean is 0.85.
    assert number.mean() == pytest.approx(27.98, abs=4 * 0.85)
    assert number.min() >= 3
    assert number.max() <= 61


def test_everything_stands_on_a_tier_or_lies_in_the_fruit_bowl(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        lying = in_bowls(scene)
        for thing in scene[1:]:
            if id(thing) not in lying:
                assert thing.rotation[2, 2] == 1.0
                assert min(abs(thing.at[2] - height) for height in TIER_HEIGHTS) < 1e-6


def test_neighbors_do_not_touch_and_nothing_leaves_the_shelf(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
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


def test_kinds_and_numbers(scenes: list[list[Thing]]) -> None:
    for scene in scenes:
        lying = in_bowls(scene)
        standing = [thing for thing in scene[1:] if id(thing) not in lying]
        per_tier = Counter((thing.name, float(thing.at[2])) for thing in standing)
        assert max(per_tier.values()) <= 10
        assert {name for name, _ in per_tier} <= {"fruit_bowl", "soda_can", "tea_bottle", *FRUIT}
        assert sum(name == "fruit_bowl" for name, _ in per_tier) <= 1
        assert len(lying) <= 3
    for bowl, _ in every(scenes, "fruit_bowl"):
        assert bowl.at[2] == pytest.approx(TIER_HEIGHTS[3], abs=1e-6)


def test_every_kind_is_as_frequent_as_the_others(scenes: list[list[Thing]]) -> None:
    number = Counter(thing.name for scene in scenes for thing in scene)
    kinds = [number[name] for name in ("soda_can", "tea_bottle", *FRUIT)]
    assert min(kinds) > 0.5 * max(kinds)


def test_kept_by_physics(arrays: NDArray[np.float32]) -> None:
    check_physics(arrays[:8], SCENE_TYPE)


def test_the_same_seed_gives_the_same_scenes_and_another_gives_others() -> None:
    first, again, other = (get_grammar(NAME).sample_array(np.random.default_rng(seed), 2) for seed in (4, 4, 5))
    assert (first == again).all()
    assert not (first == other).all()
