"""Corrections of denoised scenes: closed forms with boxes, and what they leave alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_envs.grammars import get_grammar
from scene_envs.physics import furniture_overlap, penetration
from scene_envs.physics.correction import corrections
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE, TYPE
from tests.helpers.simple_scenes import scene as boxes

EVEN, FLAT = torch.tensor([0.01, 0.01, 0.01]), torch.tensor([0.01, 0.01, 1e-4])
"""Standard deviations, m: the same along all axes, and small along z."""
CLEARANCE = 1e-4


def after(scene: SceneBatch, spread: torch.Tensor = EVEN, movable: torch.Tensor | None = None) -> torch.Tensor:
    """(N, 3) moves of the first scene, m."""
    return corrections(scene, spread, movable)[0]


def fallen(scene: SceneBatch) -> torch.Tensor:
    """(N,) falls of the first scene, m."""
    moves = after(scene, FLAT)
    assert not moves[:, :2].any()
    return -moves[:, 2]


def noisy(scene_type: str, count: int, seed: int, size: float = 0.01) -> SceneBatch:
    """Real scenes whose free objects are displaced at random."""
    real = get_grammar(scene_type).sample(np.random.default_rng(seed), count)
    noise = size * torch.randn(real.translations.shape, generator=torch.Generator().manual_seed(seed))
    return real.with_poses(real.translations + noise * real.is_free.unsqueeze(-1), real.rotations)


# -- falls ------------------------------------------------------------------------------------------


def test_objects_fall_by_their_height_and_follow_what_they_stand_on() -> None:
    stack = boxes(("cube", 0.0, 0.0, 0.01), ("cube", 0.02, 0.0, SIDE + 0.01), ("cube", 0.5, 0.0, 0.0))
    torch.testing.assert_close(fallen(stack)[1:4], torch.tensor([0.01, 0.01, 0.0]), atol=1e-6, rtol=0.0)
    gap = boxes(("cube", 0.0, 0.0, 0.01), ("cube", 0.02, 0.0, SIDE + 0.015))
    torch.testing.assert_close(fallen(gap)[1:3], torch.tensor([0.01, 0.015]), atol=1e-6, rtol=0.0)


def test_objects_far_above_everything_stay() -> None:
    assert not fallen(boxes(("cube", 0.0, 0.0, 0.031))).any()
    assert float(fallen(boxes(("cube", 0.0, 0.0, 0.029)))[1]) == pytest.approx(0.029, abs=1e-6)
    assert not fallen(boxes(("cube", 3.0, 0.0, 0.01))).any()  # beside the floor


def test_an_object_falls_into_a_bowl_and_past_a_wall() -> None:
    in_bowl = boxes(("bowl", 0.0, 0.0, 0.0), ("post", 0.0, 0.0, 0.02))  # the bottom of the bowl is 1 cm thick
    torch.testing.assert_close(fallen(in_bowl)[2], torch.tensor(0.01), atol=1e-6, rtol=0.0)
    beside = boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 1e-4, 0.0, 0.02))  # 0.1 mm in the other's side
    torch.testing.assert_close(fallen(beside)[2], torch.tensor(0.02), atol=1e-6, rtol=0.0)


# -- overlaps ---------------------------------------------------------------------------------------


def test_two_objects_share_the_shortest_way_apart() -> None:
    moves = after(boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 0.01, 0.03, 0.0)))
    expected = torch.tensor([[-0.005, 0.0, 0.0], [0.005, 0.0, 0.0]])
    torch.testing.assert_close(moves[1:3], expected, atol=CLEARANCE, rtol=0.0)


def test_a_fixed_object_leaves_the_whole_way_to_the_other() -> None:
    scene = boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 0.01, 0.03, 0.0))
    movable = torch.arange(scene.tensor.shape[1])[None] != 1
    moves = after(scene, EVEN, movable)
    assert not moves[1].any()
    torch.testing.assert_close(moves[2], torch.tensor([0.01, 0.0, 0.0]), atol=CLEARANCE, rtol=0.0)
    sunk = after(boxes(("cube", 0.0, 0.0, -0.002)))
    torch.testing.assert_close(sunk[:2], torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.002]]), atol=CLEARANCE, rtol=0.0)


def test_objects_move_along_the_axis_on_which_they_are_uncertain() -> None:
    """3 mm deep and 20 mm wide: up where all axes are alike, aside where heights are certain, and down from there."""
    scene = boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 0.02, 0.0, SIDE - 0.003))
    up = after(scene, EVEN)
    assert float(up[2, 2] - up[1, 2]) == pytest.approx(0.003, abs=CLEARANCE)
    assert float(up[1:3, :2].abs().max()) < CLEARANCE
    aside = after(scene, FLAT)
    assert float(aside[2, 0] - aside[1, 0]) == pytest.approx(0.02, abs=CLEARANCE)
    assert float(aside[1:3, 2].abs().max()) < CLEARANCE  # the floor is further than 3 cm below


def test_an_object_that_comes_off_another_comes_down() -> None:
    scene = boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 0.02, 0.0, 0.015))
    moves = after(scene, FLAT)
    assert float(moves[2, 0] - moves[1, 0]) == pytest.approx(0.02, abs=CLEARANCE)
    assert float(moves[2, 2]) == pytest.approx(-0.015, abs=CLEARANCE)


def test_real_scenes_stay_as_they_are() -> None:
    for name in ("dimsum_table", "living_room_shelf", "restaurant_low_clutter"):
        real = get_grammar(name).sample(np.random.default_rng(0), 6)
        assert float(corrections(real, FLAT).abs().max()) < 1e-3


@pytest.mark.parametrize(
    "scene_type", ["dimsum_table", "restaurant_low_clutter", "living_room_shelf", "breakfast_table_low_clutter"]
)
def test_overlaps_of_noisy_scenes_shrink_and_fixed_objects_stay(scene_type: str) -> None:
    scenes = noisy(scene_type, 6, 1)
    moves = corrections(scenes, EVEN)
    assert not moves[~scenes.is_free].any()
    moved = scenes.with_poses(scenes.translations + moves, scenes.rotations)
    before, now = (penetration(batch).total_per_pair.sum() for batch in (scenes, moved))
    assert float(now) < 0.3 * float(before)


def test_objects_in_any_order_move_alike() -> None:
    scenes = noisy("dimsum_table", 4, 3)
    order = torch.randperm(scenes.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    shuffled = SceneBatch(scenes.tensor[:, order], scenes.scene_type)
    apart = (corrections(shuffled, EVEN) - corrections(scenes, EVEN)[:, order]).norm(dim=-1)
    assert float((apart < 1e-4).double().mean()) > 0.97  # ties, as of two sides of a cube, may be broken otherwise


def test_nothing_leaves_the_device_but_lengths_of_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = noisy("restaurant_low_clutter", 2, 4)
    corrections(scenes, EVEN)  # the geometry is built once

    def refused(self: torch.Tensor, *_: object) -> None:
        raise AssertionError(f"a tensor of shape {tuple(self.shape)} left its device")

    for name in ("cpu", "numpy", "item", "__float__"):
        monkeypatch.setattr(torch.Tensor, name, refused)
    assert corrections(scenes, EVEN).any()


def test_furniture_comes_apart_and_takes_along_what_is_on_it() -> None:
    """Two welded boxes that overlap by 3 cm, with a post on each of them and one on the floor beside them."""
    room = replace(TYPE, name="room_of_welded_boxes", welded=("floor", "cube"))
    room.__dict__["library"] = TYPE.library
    overlap = 0.03
    objects = [("cube", 0.0, 0.0, 0.0), ("cube", SIDE - overlap, 0.04, 0.0), ("post", -0.03, 0.0, SIDE)]
    objects += [("post", SIDE - overlap + 0.03, 0.04, SIDE), ("post", 0.0, 0.5, 0.0)]
    batch = SceneBatch(boxes(*objects).tensor, room)
    moves = after(batch, FLAT)
    half = torch.tensor([overlap / 2, 0.0, 0.0])
    expected = torch.stack([-half, half, -half, half, 0 * half])
    torch.testing.assert_close(moves[1:6], expected, atol=CLEARANCE, rtol=0.0)
    assert not furniture_overlap(batch.with_poses(batch.translations + moves, batch.rotations)).any()
    kept = after(batch, FLAT, torch.arange(batch.tensor.shape[1])[None] != 1)  # observed furniture stays, with its post
    assert not kept[1].any()
    assert not kept[3].any()
    torch.testing.assert_close(kept[2], 2 * half, atol=2 * CLEARANCE, rtol=0.0)


def test_the_moves_of_a_scene_do_not_depend_on_the_others() -> None:
    scenes = noisy("dimsum_table", 20, 2)
    together = corrections(scenes, FLAT)
    for row in (0, 7, 19):
        torch.testing.assert_close(corrections(scenes[row : row + 1], FLAT)[0], together[row], atol=1e-5, rtol=0.0)


def test_only_the_ratios_of_the_deviations_matter() -> None:
    scene = boxes(("cube", 0.0, 0.0, 0.0), ("cube", SIDE - 0.02, 0.0, SIDE - 0.003))
    torch.testing.assert_close(after(scene, 100 * FLAT), after(scene, FLAT))
    assert torch.isfinite(after(scene, torch.zeros(3))).all()


def test_a_heap_is_left_as_it_is_in_bounded_work() -> None:
    batch = SceneBatch.empty("dimsum_table", 1)
    categories = batch.categories.clone()
    categories[0, 1:] = batch.scene_type.assets.index(
        next(name for name in batch.scene_type.assets if "steamer" in name)
    )
    heap = SceneBatch.from_parts(batch.translations, torch.eye(3).expand(1, 34, 3, 3), categories, batch.scene_type)
    assert torch.isfinite(corrections(heap, EVEN)).all()
