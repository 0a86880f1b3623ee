"""Rewards of places and overlaps, on scenes whose values have closed forms."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from rewards import (
    CategoryCount,
    Clearance,
    Clutter,
    Penetration,
    RewardContext,
    RewardOutput,
    Stability,
    WeightedSum,
    check_reward,
    evaluate_reward,
    list_rewards,
)
from scene_envs import SceneBatch, get_grammar, get_scene_type
from scene_envs.errors import InvalidInputError, UnknownNameError
from tests.helpers.batch_reward import AboveTheMean

COMPOSITES = {"clip", "product", "weighted_sum"}
SHELF = [
    "clearance",
    "clutter",
    "penetration",
    "stability",
    "category_count",
    "feasible_share",
]


def place(*objects: tuple[str, float, float, float], kind: str = "dimsum_table", slots: int = 8) -> SceneBatch:
    """One scene of upright objects at (x, y, z)."""
    batch = SceneBatch.empty(kind, 1, slots=slots)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    for slot, (name, *position) in enumerate(objects, start=1):
        categories[0, slot] = batch.scene_type.assets.index(name)
        translations[0, slot] = torch.tensor(position)
    return SceneBatch.from_parts(translations, torch.eye(3).expand(1, slots, 3, 3), categories, batch.scene_type)


def score(reward: object, batch: SceneBatch) -> RewardOutput:
    return evaluate_reward(reward, batch, RewardContext(), strict=True)


def outline_area(kind: str, asset: str) -> float:
    """Area of an asset's outline from above, by trimesh: of its hull, flattened."""
    vertices = np.concatenate([part.vertices for part in get_scene_type(kind).library[asset].fine])
    flat = np.concatenate([vertices * (1, 1, 0), vertices * (1, 1, 0) + (0, 0, 1)])
    return float(trimesh.convex.convex_hull(flat).volume)


@pytest.mark.parametrize("name", SHELF)
@pytest.mark.parametrize("scene_type", ["living_room_shelf"])
def test_they_keep_the_contract_on_a_shelf(name: str, scene_type: str) -> None:
    assert "scores a scene the same alone and in a batch" in check_reward(name, scene_type)


# -- clutter ---------------------------------------------------------------------------------------


def test_clutter_is_the_covered_share_of_the_table() -> None:
    table, plate = outline_area("dimsum_table", "cafe_table"), outline_area("dimsum_table", "dinner_plate")
    apart = score(Clutter(lines=1000), place(("dinner_plate", 0.3, 0.0, 0.0), ("dinner_plate", -0.3, 0.0, 0.0)))
    assert apart.value.item() == pytest.approx(2 * plate / table, rel=1e-3)
    assert apart.terms["surface_area"].item() == pytest.approx(table, rel=1e-3)
    assert apart.per_object[0, 1:3].tolist() == pytest.approx([plate / table] * 2, rel=1e-3)


def test_what_stands_on_others_covers_their_place_once() -> None:
    """A tower of steamers covers as much as one of them, which they share."""
    kind = get_scene_type("dimsum_table")
    height = kind.library["steamer_bottom"].bounds[1, 2]
    one = score(Clutter(), place(("steamer_bottom", 0.0, 0.0, 0.0)))
    tower = score(Clutter(), place(*[("steamer_bottom", 0.0, 0.0, level * height) for level in range(3)]))
    assert tower.value.item() == pytest.approx(one.value.item(), rel=1e-6)
    assert tower.per_object[0, 1:4].tolist() == pytest.approx([one.value.item() / 3] * 3, rel=1e-5)
    assert tower.terms["volume_share"].item() == pytest.approx(3 * one.terms["volume_share"].item(), rel=1e-5)


def test_what_floats_or_hangs_over_the_edge_covers_less() -> None:
    """The table is round with radius 0.625 m; a plate in its middle of the edge of the workspace hangs over."""
    inside = score(Clutter(), place(("dinner_plate", 0.0, 0.0, 0.0))).value.item()
    corner = score(Clutter(), place(("dinner_plate", 0.42, 0.42, 0.0))).value.item()
    assert 0.3 * inside < corner < 0.9 * inside
    assert score(Clutter(), place(("dinner_plate", 0.0, 0.0, 0.3))).value.item() == 0.0
    assert score(Clutter(), place(("dinner_plate", 0.55, 0.0, 0.0))).value.item() == 0.0  # outside the workspace


def test_each_tier_of_a_shelf_is_a_surface() -> None:
    output = score(Clutter(), SceneBatch.empty("living_room_shelf", 1))
    assert output.terms["surface_area"].item() == pytest.approx(4 * 0.3 * 0.6, rel=1e-6)
    scenes = get_grammar("living_room_shelf").sample(np.random.default_rng(0), 2)
    filled = score(Clutter(), scenes)
    assert bool((filled.value > 0.02).all())
    torch.testing.assert_close(filled.per_object.sum(dim=-1), filled.value)
    low, high = scenes.scene_type.workspace
    free = (scenes.volumes * scenes.is_free).sum(dim=-1)
    torch.testing.assert_close(filled.terms["volume_share"], free / float(np.prod(np.subtract(high, low))))


# -- penetration and stability -----------------------------------------------------------------------


def test_penetration_adds_up_the_depths_of_pairs() -> None:
    """Boxes of a shelf board game (0.4 x 0.265 x 0.055 m): two overlap by 5 mm, the lower is 2 mm in the shelf."""
    kind, game = "living_room_shelf", "board_game_l"
    free_height = get_scene_type(kind).library[game].bounds[1, 2]
    height = 1.0  # far from the shelf
    stack = [(game, 0.0, 0.0, height), (game, 0.0, 0.0, height + free_height - 0.005)]
    stack.append((game, 0.0, 0.0, height + 2 * free_height - 0.008))
    batch = place(*stack, kind=kind)
    total, deepest = score(Penetration(), batch), score(Penetration("deepest"), batch)
    assert total.value.item() == pytest.approx(-8.0, abs=1e-3)
    assert deepest.value.item() == pytest.approx(-5.0, abs=1e-3)
    assert total.per_object[0, 1:4].tolist() == pytest.approx([-2.5, -4.0, -1.5], abs=1e-3)
    assert deepest.per_object[0, 1:4].tolist() == pytest.approx([-5.0, -5.0, -3.0], abs=1e-3)
    assert total.terms["overlapping_pairs"].item() == 2
    assert total.object_flags["overlapping"][0].nonzero()[:, 0].tolist() == [1, 2, 3]


def test_overlap_with_a_welded_object_falls_to_the_free_one() -> None:
    output = score(Penetration(), place(("steamer_bottom", 0.0, 0.0, -0.004)))
    assert output.value.item() == pytest.approx(-4.0, abs=1e-3)
    assert output.per_object[0, :2].tolist() == pytest.approx([0.0, -4.0], abs=1e-3)


def test_stability_falls_with_the_movement() -> None:
    """Objects a gap above the table fall by that gap: closed form. One in another is removed and scores 0."""
    gap = 0.003
    batch = place(("dinner_plate", 0.3, 0.0, 0.0), ("dinner_plate", -0.3, 0.0, gap), ("teapot", 0.0, 0.3, -0.005))
    output = score(Stability(scale=0.01), batch)
    assert output.per_object[0, 1:4].tolist() == pytest.approx([1.0, math.exp(-gap / 0.01), 0.0], abs=2e-3)
    assert output.value.item() == pytest.approx((1.0 + math.exp(-gap / 0.01)) / 3, abs=1e-3)
    assert output.terms["simulated_objects"].item() == 2
    assert output.terms["moved_mm"].item() == pytest.approx(1.5, abs=0.01)
    assert score(Stability(), SceneBatch.empty("dimsum_table", 1)).value.item() == 0.0


# -- clearance ---------------------------------------------------------------------------------------


def games(*places: tuple[float, float, float], yaw: float = 0.0) -> SceneBatch:
    """Board games (0.4 m along x, 0.265 m along y, 0.055 m high) in the air before a shelf; the last is turned."""
    batch = place(*(("board_game_l", *position) for position in places), kind="living_room_shelf")
    rotations = batch.rotations.clone()
    rotations[0, len(places), :2, :2] = torch.tensor([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    return batch.with_poses(batch.translations, rotations)


@pytest.mark.parametrize("gap", [0.2, 0.05, 0.03, 0.01, 0.0, -0.01, -0.265])
def test_clearance_of_two_boxes(gap: float) -> None:
    """The second is beside the first, in it, or at the same place."""
    kind = get_scene_type("living_room_shelf")
    low, high = np.array(kind.workspace)
    x, z = high[0] + 0.5, 0.5 * (low[2] + high[2])
    batch = games((x, -0.2, z), (x, -0.2 + 0.265 + gap, z))
    wide = SceneBatch(batch.tensor, replace(kind, name="wide", workspace=((-2.0,) * 3, (2.0,) * 3)))
    output = score(Clearance(wanted=0.06), wide)
    share = min(max(gap, 0.0) / 0.06, 1.0)
    assert output.per_object[0, :3].tolist() == pytest.approx([0.0, share, share], abs=1e-5)
    assert output.value.item() == pytest.approx(share, abs=1e-5)
    assert output.terms["smallest_gap"].item() == pytest.approx(0.06 * share, abs=1e-6)
    assert output.terms["crowded_objects"].item() == 2 * (share < 1)
    assert score(Clearance(wanted=0.06), batch).value.item() == 0.0  # outside the workspace


def test_clearance_of_a_turned_box() -> None:
    """Its corner reaches half its width and half its depth, at 45 degrees, toward the other box."""
    batch = games((0.0, -0.3, 3.0), (0.0, 0.0, 3.0), yaw=math.pi / 4)
    wide = SceneBatch(batch.tensor, replace(batch.scene_type, name="wide", workspace=((-5.0,) * 3, (5.0,) * 3)))
    reach = 0.5 * (0.4 + 0.265) * math.sin(math.pi / 4)
    expected = 0.3 - 0.5 * 0.265 - reach
    assert expected < 0  # they overlap
    assert score(Clearance(), wide).terms["smallest_gap"].item() == 0.0
    apart = wide.with_poses(
        wide.translations + torch.tensor([0.0, 0.1, 0.0]) * (torch.arange(8) == 2)[:, None], wide.rotations
    )
    assert score(Clearance(wanted=1.0), apart).per_object[0, 2].item() == pytest.approx(expected + 0.1, abs=1e-5)


def test_what_carries_an_object_is_no_neighbour() -> None:
    """A tower of steamers on the table has all the space, and a plate beside it the gap that there is."""
    kind = get_scene_type("dimsum_table")
    height = kind.library["steamer_bottom"].bounds[1, 2]
    tower = [("steamer_bottom", 0.0, 0.0, level * height) for level in range(3)]
    assert score(Clearance(), place(*tower)).per_object[0, 1:4].tolist() == [1.0, 1.0, 1.0]
    floating = score(Clearance(wanted=0.1), place(("steamer_bottom", 0.0, 0.0, 0.05)))  # carried by nothing
    assert floating.per_object[0, 1].item() == pytest.approx(0.5, abs=1e-5)
    beside = score(Clearance(), place(*tower, ("steamer_bottom", 0.3, 0.0, 0.0)))
    assert 0 < kind.library["steamer_bottom"].bounds[1, 0] < 0.135
    assert beside.value.item() == 1.0
    heap = [("steamer_bottom", 0.0, 0.001 * index, 0.2) for index in range(6)]
    assert score(Clearance(), place(*heap)).value.item() == 0.0


@pytest.mark.parametrize("wanted", [0.0, -1.0, math.inf, math.nan])
def test_a_wanted_gap_is_positive(wanted: float) -> None:
    with pytest.raises(InvalidInputError, match="wanted"):
        Clearance(wanted=wanted)


# -- kinds, composites -------------------------------------------------------------------------------


def test_kinds_are_counted_in_the_workspace() -> None:
    apples = [("apple_gala", 0.0, 0.1, 0.0), ("apple_gala", 0.1, 0.1, 0.0), ("apple_gala", 2.0, 0.0, 0.0)]
    batch = place(*apples, ("bread_slice", 0.0, -0.1, 0.0), ("mug", 0.0, 0.3, 0.0), kind="breakfast_table_low_clutter")
    assert score(CategoryCount("edible"), batch).value.tolist() == [3.0]
    assert score(CategoryCount("apple"), batch).value.tolist() == [2.0]
    assert score(CategoryCount(["cups", "bread_slice"]), batch).value.tolist() == [2.0]
    assert score(CategoryCount("fruit"), batch).per_object[0].tolist() == [0, 1, 1, 0, 0, 0, 0, 0]
    with pytest.raises(UnknownNameError, match="did you mean 'fruit'"):
        CategoryCount("fruits")(batch, RewardContext())


def test_composites_depend_on_the_batch_when_a_part_does() -> None:
    assert WeightedSum(["object_count", AboveTheMean()]).depends_on_batch
    assert not WeightedSum(["object_count", "clutter"]).depends_on_batch
    assert len(check_reward(WeightedSum(["object_count", AboveTheMean()]))) == 5


def test_an_offset_is_added_to_the_value_of_a_sum(cups: SceneBatch) -> None:
    plain, lifted = (score(WeightedSum(["object_count"], [2.0], offset), cups) for offset in (0.0, -3.0))
    assert (lifted.value - plain.value).tolist() == [-3.0, -3.0]
    assert torch.equal(lifted.per_object, plain.per_object)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Clutter(lines=0),
        lambda: Stability(scale=0.0),
        lambda: CategoryCount([]),
        lambda: Penetration("shallow"),
    ],
)
def test_wrong_settings_are_refused(make) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises((InvalidInputError, UnknownNameError)):
        make()


def test_every_reward_has_its_page_and_its_row() -> None:
    root = Path(__file__).parents[2]
    index = (root / "docs" / "rewards" / "README.md").read_text()
    sources = [path.read_text() for path in (root / "rewards").glob("*.py")]
    names = [name for text in sources for name in re.findall(r'^@register_reward\("(\w+)"\)', text, re.MULTILINE)]
    assert set(names) <= set(list_rewards())
    for name in names:
        assert f"`{name}`" in index
        assert name in COMPOSITES or (root / "docs" / "rewards" / f"{name}.md").is_file(), name
