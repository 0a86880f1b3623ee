"""Objects on and in other objects: frames of carriers, piles, containers, and a user's own scene type."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from scene_envs.grammars import (
    NOTHING,
    Gaussian,
    Geometric,
    Grammar,
    Group,
    Heap,
    Line,
    Object,
    OneOf,
    Pile,
    Region,
    Repeat,
    Surface,
    Uniform,
    Yaw,
)
from scene_envs.physics import feasibility
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

DIMSUM = get_scene_type("dimsum_table")
WIDE = Region(0.4, 0.4)


def _sample(*children: object, count: int = 20, region: Region = WIDE) -> SceneBatch:
    return Grammar("supports", DIMSUM, [Surface(children, region)]).sample(np.random.default_rng(0), count)  # type: ignore[arg-type]


def _rows(batch: SceneBatch, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Translations (n, 3) and rotations (n, 3, 3) of all objects called ``name``, scene by scene."""
    chosen = (batch.categories == DIMSUM.assets.index(name)).numpy()
    return batch.translations.numpy()[chosen], batch.rotations.numpy()[chosen]


def test_what_an_object_carries_moves_and_turns_with_it() -> None:
    beside = Surface([Object("teacup", Gaussian(0.05, 0.02, along=0.0), Yaw(std=0.0))], Region(0.1, 0.1), height=None)
    dish = Object("serving_dish", Uniform(0.2, 0.2), Yaw(), on=[beside])
    batch = _sample(dish)
    (dishes, turns), (cups, cup_turns) = _rows(batch, "serving_dish"), _rows(batch, "teacup")
    assert len(dishes) == len(cups) == 20
    local = np.einsum("nji,nj->ni", turns, cups - dishes)
    np.testing.assert_allclose(local, np.tile([0.05, 0.02, 0.006], (20, 1)), atol=1e-6)  # the dish is 6 mm thick
    np.testing.assert_allclose(cup_turns, turns, atol=1e-6)


def test_a_pile_rises_by_the_height_of_what_is_below() -> None:
    pile = Pile(((1.0, "serving_dish"), (1.0, "steamer_lid")), Geometric(0.0, 3, 3), Uniform(0.2, 0.2))
    batch = _sample(pile)
    height = {DIMSUM.assets.index(name): DIMSUM.library[name].bounds[1, 2] for name in ("serving_dish", "steamer_lid")}
    for categories, points in zip(batch.categories.tolist(), batch.translations.numpy(), strict=True):
        assert (points[1:4, :2] == points[1, :2]).all()
        rises = np.cumsum([0.0, height[categories[1]], height[categories[2]]])
        np.testing.assert_allclose(points[1:4, 2], rises, atol=1e-6)


def test_boxes_packed_by_their_rectangles_never_overlap() -> None:
    crowd = Repeat(Object("serving_dish", Uniform(0.4, 0.4)), Geometric(0.0, 5, 5))
    batch = _sample(crowd, count=10)
    assert feasibility(batch).feasible.sum() == 50


@pytest.mark.slow
def test_overhang_zero_keeps_whole_things_inside() -> None:
    crowd = Repeat(Object("serving_dish", Uniform(0.4, 0.4)), Geometric(0.0, 3, 3))
    batch = _sample(crowd, count=20, region=Region(0.3, 0.35, overhang=0.0, x=0.1))
    points, turns = _rows(batch, "serving_dish")
    corners = 0.135 * np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
    world = points[:, None] + np.einsum("nij,kj->nki", turns, corners)
    assert world[..., 0].min() >= -0.2
    assert world[..., 0].max() <= 0.4
    assert np.abs(world[..., 1]).max() <= 0.35


def test_a_line_is_along_a_wall_and_a_full_one_is_said() -> None:
    batch = _sample(Object("teapot", Line((-0.2, 0.3), (0.2, 0.3)), Yaw(std=0.0, choices=(0.0, math.pi))), count=200)
    points, turns = _rows(batch, "teapot")
    assert (points[:, 1] == np.float32(0.3)).all()
    assert np.abs(points[:, 0]).max() <= 0.2
    assert np.std(points[:, 0]) == pytest.approx(0.4 / math.sqrt(12), rel=0.1)
    assert set(np.round(turns[:, 0, 0], 6)) == {1.0, -1.0}


def test_yaw_deviates_normally_from_its_choices() -> None:
    rng = np.random.default_rng(0)
    angles = np.array([Yaw(0.1, (0.0, math.pi / 2)).draw(rng) for _ in range(4000)])
    nearest = np.where(angles > math.pi / 4, angles - math.pi / 2, angles)
    assert np.std(nearest) == pytest.approx(0.1, rel=0.06)
    assert (angles > math.pi / 4).mean() == pytest.approx(0.5, abs=0.03)


def test_what_is_poured_into_a_container_rests_in_it_wherever_it_stands() -> None:
    heap = Heap(Group(Object("teacup"), Object("teacup")), upright=True)
    basket = Object("steamer_bottom", Uniform(0.3, 0.3), Yaw(), inside=heap)
    batch = _sample(basket, count=3)
    assert batch.counts.tolist() == [4, 4, 4]  # table, basket, two cups
    judged = feasibility(batch, max_displacement=1e-2, max_rotation=math.inf, duration=0.5)
    assert judged.counts.tolist() == [3, 3, 3]
    (baskets, _), (cups, _) = _rows(batch, "steamer_bottom"), _rows(batch, "teacup")
    offset = cups.reshape(3, 2, 3) - baskets[:, None]
    assert np.hypot(offset[..., 0], offset[..., 1]).max() < 0.12
    assert offset[..., 2].min() > 0.0


def test_conditions_see_what_stands_on_other_things_and_slots_count_contents() -> None:
    two = Surface([Repeat(Object("teacup"), Geometric(0.0, 1, 1))], Region(0.1, 0.1), height=None)
    carrier = OneOf((1.0, Object("dinner_plate", on=[two])), (1.0, Object("dinner_plate")))
    some_cup = {"no cup": lambda towers: any("teacup" in tower.assets for tower in towers)}
    grammar = Grammar("cups", DIMSUM, [Surface([carrier], WIDE)], some_cup)
    assert grammar.sample(np.random.default_rng(0), 30).counts.tolist() == [3] * 30
    assert grammar.reasons["no cup"] > 0
    tower = Object("steamer_bottom", inside=Heap(Group(Object("teacup"), NOTHING))).draw(
        np.random.default_rng(0), Counter()
    )
    assert sum(len(part.assets) + len(part.contents) for part in tower[0].walk()) == 2
