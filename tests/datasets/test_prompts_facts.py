"""The facts of scenes built by hand: supports, containers, tiers, sides, and what noise does to them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from scene_envs.datasets.prompts import SceneFacts, Tolerances, parse_prompt, scene_facts, viewer_axes
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, SceneType, get_scene_type
from tests.helpers.prompts_scenes import BOTTOM, LOWER, TOP, UPPER, build, jittered, pitch, yaw


def claims(scene: SceneBatch, *texts: str) -> list[bool]:
    """Whether each clause holds."""
    (facts,) = scene_facts(scene)
    return [parse_prompt(f"A scene where {text}.", scene.scene_type).holds(facts) for text in texts]


def held_by(facts: SceneFacts) -> list[str]:
    """What holds each object, in words."""
    words = []
    for support, contained in zip(facts.held.support, facts.held.contained, strict=True):
        words.append(f"{'in' if contained else 'on'} {facts.names[support]}" if support >= 0 else "")
    return words


def test_a_stack_of_steamers() -> None:
    places = [(0.2, 0.0, 0.0), (0.2, 0.0, 0.091), (0.2, 0.0, 0.182)]
    stack = [("steamer_bottom", places[0]), ("steamer_bottom", places[1]), ("steamer_lid", places[2])]
    scene = build("dimsum_table", [*stack, ("teapot", (-0.2, 0.0, 0.0))])
    (facts,) = scene_facts(scene)
    assert facts.count == 5
    assert facts.objects == {"table": 1, "steamer bottom": 2, "steamer lid": 1, "teapot": 1}
    assert held_by(facts) == ["", "on table", "on steamer bottom", "on steamer bottom", "on table"]
    assert facts.held.place.tolist() == [-1, 0, 0, 0, 0]


def test_fruit_in_a_bowl_on_a_plate() -> None:
    """The bowl stands in the plate (6 mm thick), the pear on the bottom of the bowl (6 mm)."""
    scene = build(
        "breakfast_table_low_clutter",
        [("plate", (0, 0.3, 0)), ("bowl", (0, 0.3, 0.006)), ("pear_bosc", (0, 0.3, 0.012)), ("apple_gala", (0, 0, 0))],
    )
    assert held_by(scene_facts(scene)[0])[1:] == ["on table", "on plate", "in bowl", "on table"]
    assert claims(
        scene,
        "a pear is in the bowl",
        "a bowl is on top of the plate",
        "a pear is on top of the bowl",
        "a pear is on top of the plate",
        "an apple is in the bowl",
    ) == [True, True, False, False, False]


def test_bread_on_bread_in_a_bowl_is_in_the_bowl() -> None:
    """On top of what lies in a bowl is in the bowl, even above its rim."""
    apples = [("apple_gala", (0.0, 0.2, z)) for z in (0.006, 0.066)]
    scene = build("breakfast_table_low_clutter", [("bowl", (0.0, 0.2, 0.0)), *apples])
    assert claims(scene, "two apples are in the bowl", "an apple is on top of an apple") == [True, True]


def test_cutlery_stands_in_the_crock() -> None:
    """A fork is 0.19 m long; upright, it rises above the crock of 0.17 m, and one lies beside it."""
    upright = pitch(math.radians(-85.0))
    scene = build(
        "breakfast_table_low_clutter",
        [
            ("utensil_crock", (0.0, 0.3, 0.0)),
            ("fork", (0.0, 0.3, 0.108), upright),
            ("dinner_spoon", (0.02, 0.31, 0.108), yaw(1.0) @ upright),
            ("fork", (0.0, 0.39, 0.0)),
        ],
    )
    assert claims(
        scene, "a fork is in the utensil crock", "a spoon is in the utensil crock", "two forks are in the utensil crock"
    ) == [True, True, False]


@pytest.mark.parametrize(("tier", "words"), [(TOP, "the top shelf"), (BOTTOM, "the bottom shelf")])
def test_tiers_have_names(tier: float, words: str) -> None:
    scene = build("living_room_shelf", [("speaker", (0.0, 0.1, tier)), ("book", (0.0, -0.2, LOWER))])
    assert claims(scene, f"a speaker is on {words}", f"a book is on {words}") == [True, False]


def test_inner_tiers_count_from_both_ends() -> None:
    scene = build("living_room_shelf", [("speaker", (0.0, 0.1, UPPER)), ("book", (0.0, -0.2, LOWER))])
    assert claims(
        scene,
        "a speaker is on the second shelf from the top",
        "a speaker is on the third shelf from the bottom",
        "a book is on the third shelf from the top",
        "a book is on the second shelf from the bottom",
        "a book is on the second shelf from the top",
        "a speaker is on the fifth shelf from the top",
    ) == [True, True, True, True, False, False]


def test_what_lies_on_a_plate_is_on_the_plates_tier() -> None:
    scene = build("living_room_shelf", [("shared_plate", (0, 0, LOWER)), ("pear_bosc", (0, 0, LOWER + 0.006))])
    assert claims(scene, "a pear is on the second shelf from the bottom", "a pear is on top of the plate") == [True] * 2


def test_a_speaker_is_not_a_table() -> None:
    """Names are whole words: there is no table in "toy train", and none in a speaker."""
    scene = build("living_room_shelf", [("speaker", (0.0, 0.0, TOP))])
    (facts,) = scene_facts(scene)
    assert facts.objects == {"shelf": 1, "speaker": 1}
    room = build("restaurant_low_clutter", [("cafe_table", (0, 0, 0)), ("speaker", (0, 0, 0))])
    (facts,) = scene_facts(room)
    assert facts.objects["table"] == 1
    assert parse_prompt("A scene with a table and a speaker.", room.scene_type).holds(facts)
    with pytest.raises(InvalidInputError, match="'speak"):
        parse_prompt("A scene with a speak.", room.scene_type)


@pytest.mark.parametrize("name", ["dimsum_table", "living_room_shelf", "restaurant_high_clutter", "pantry_shelf"])
def test_the_viewer_of_the_built_in_types(name: str) -> None:
    """Looking down with -x up, or along -x: right is +y and front is +x."""
    np.testing.assert_allclose(viewer_axes(name), [[0, 1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_another_camera_has_another_left() -> None:
    """From above with +y up in the picture, as on a map: right is +x, front is -y."""
    map_like = SceneType(
        "a_map", ("teacup",), 2, ((0, 0, 0), (1, 1, 1)), (), (), Camera((0, 0, 2), (0, 0, 0), (0, 1, 0))
    )
    np.testing.assert_allclose(viewer_axes(map_like), [[1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(
    ("at", "side"),
    [
        ((0.0, -0.3), "to the left of"),
        ((0.0, 0.3), "to the right of"),
        ((0.3, 0.0), "in front of"),
        ((-0.3, 0.0), "behind"),
        ((0.1, -0.3), "to the left of"),
        ((-0.3, -0.1), "behind"),
    ],
)
def test_each_side_is_seen(at: tuple[float, float], side: str) -> None:
    """Also "behind", whose offset is negative; the other three sides are false, and so is the reverse."""
    shift = np.array([0.1, 0.15])
    scene = build("dimsum_table", [("teapot", (*(at + shift), 0.0)), ("dinner_plate", (*shift, 0.0))])
    sides = ["to the left of", "to the right of", "in front of", "behind"]
    assert claims(scene, *(f"the teapot is {s} the plate" for s in sides)) == [s == side for s in sides]
    opposite = sides[sides.index(side) ^ 1]
    assert claims(scene, f"the plate is {opposite} the teapot", f"the plate is {side} the teapot") == [True, False]


def test_a_relation_is_between_the_two_it_names() -> None:
    """Two cups: the first from the left is left of the teapot, the second is right of it."""
    scene = build("dimsum_table", [("teacup", (0, -0.3, 0)), ("teapot", (0, 0, 0)), ("teacup", (0, 0.3, 0))])
    assert claims(
        scene,
        "the first cup from the left is to the left of the teapot",
        "the second cup from the left is to the right of the teapot",
        "the first cup from the right is to the right of the teapot",
        "the second cup from the left is to the left of the teapot",
        "the teapot is to the left of the first cup from the left",
        "the cup is to the left of the teapot",
        "the third cup from the left is to the right of the teapot",
    ) == [True, True, True, False, False, False, False]


def test_next_to_is_within_five_centimeters_at_the_same_height() -> None:
    """Cups' handles point to +x; along y a cup is 8.0 cm wide and a dinner plate 27 cm."""

    def beside(gap: float, z: float = 0.0) -> bool:
        scene = build("dimsum_table", [("dinner_plate", (0, 0, 0)), ("teacup", (0, 0.135 + 0.0404 + gap, z))])
        return claims(scene, "the cup is next to the plate")[0]

    assert [beside(0.01), beside(0.045), beside(0.06), beside(0.01, 0.1)] == [True, True, False, False]


def test_things_on_different_tiers_or_on_each_other_are_not_beside_each_other() -> None:
    scene = build(
        "living_room_shelf",
        [("speaker", (0, -0.2, TOP)), ("book", (0, 0.2, BOTTOM)), ("shared_plate", (0, 0, LOWER)),
         ("pear_bosc", (0.05, 0, LOWER + 0.008))],
    )  # fmt: skip
    sides = (
        "the speaker is to the left of the book",
        "the pear is in front of the plate",
        "the pear is next to the plate",
    )
    assert claims(scene, *sides) == [False] * 3


def test_tables_of_a_room_are_places() -> None:
    """Two tables; what stands on one is on that one, and chairs stand by tables."""
    scene = build(
        "restaurant_low_clutter",
        [
            ("cafe_table", (0, -2, 0)),
            ("cafe_table", (0, 2, 0)),
            ("teapot", (0.1, -2, 0)),
            ("teacup", (0.1, 1.8, 0)),
            ("teacup", (0.1, 2.2, 0)),
            ("chair", (0, 3.1, -0.785), yaw(-math.pi / 2)),
            ("shelf", (-4.75, 0, -0.3775)),
            ("speaker", (-4.75, 0, -0.3775 + UPPER), yaw(math.pi / 2)),
        ],
    )
    assert claims(
        scene,
        "a teapot is on the first table from the left",
        "two cups are on the first table from the right",
        "the teapot is to the left of the first cup from the left",
        "the chair is to the right of the second table from the left",
        "the chair is next to the second table from the left",
        "the chair is next to the first table from the left",
        "a speaker is on the second tier from the top of the shelf",
        "a speaker is on the second shelf from the top",
        "the first cup from the left on the second table from the left is to the left of the second cup from the left "
        "on the same table",
        "the shelf is behind the first table from the left",
    ) == [True, True, False, True, True, False, True, True, True, True]


@pytest.mark.slow
def test_facts_survive_the_noise_of_a_prior() -> None:
    """3 mm and 1 degree: at least 97 % of objects keep what holds them, and tables and tiers within 99 %."""
    for name, count in (("dimsum_table", 12), ("breakfast_table_low_clutter", 30), ("pantry_shelf", 6)):
        scenes = get_grammar(name).sample(np.random.default_rng(3), count)
        exact, noisy = scene_facts(scenes), scene_facts(jittered(scenes, 0.003, 1.0, seed=0))
        support = np.concatenate([a.held.support == b.held.support for a, b in zip(exact, noisy, strict=True)])
        tier = np.concatenate([a.held.tier == b.held.tier for a, b in zip(exact, noisy, strict=True)])
        assert support.mean() >= 0.97, name
        assert tier.mean() >= 0.99, name


@pytest.mark.parametrize(
    ("height", "touches", "on_table"),
    [(-0.008, True, True), (0.008, True, True), (0.02, False, True), (-0.02, False, True), (0.05, False, False)],
)
def test_contact_tolerates_a_centimeter_and_places_three(height: float, touches: bool, on_table: bool) -> None:
    (facts,) = scene_facts(build("dimsum_table", [("teapot", (0, 0, height))]))
    assert (facts.held.support[1] == 0) == touches
    assert (facts.held.place[1] == 0) == on_table


def test_fallen_and_floating_things_are_told_apart() -> None:
    """A bottle on its side (6.5 cm across) is on the shelf; one in mid-air, or outside, is nowhere."""
    side = pitch(math.pi / 2)
    scene = build(
        "pantry_shelf",
        [
            ("tea_bottle", (-0.1, 0.0, BOTTOM + 0.0325), side),
            ("tea_bottle", (0.0, 0.15, BOTTOM + 0.05)),
            ("tea_bottle", (0.0, 0.6, BOTTOM)),
        ],
    )
    (facts,) = scene_facts(scene)
    assert facts.held.tier.tolist() == [-1, 3, -1, -1]
    assert claims(scene, "a tea bottle is on the bottom shelf") == [True]


def test_slots_mean_nothing() -> None:
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)
    order = torch.randperm(scenes.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    shuffled = SceneBatch(scenes.tensor[:, order], scenes.scene_type)
    for one, other in zip(scene_facts(scenes), scene_facts(shuffled), strict=True):
        assert sorted(held_by(one)) == sorted(held_by(other))
        where = {int(slot): i for i, slot in enumerate(order)}
        assert {where[int(slot)] for slot in one.slots} == set(other.slots.tolist())


def test_tolerances_are_checked() -> None:
    with pytest.raises(InvalidInputError, match=r"0\.5"):
        Tolerances(contact=0.5)


def test_the_shelf_has_four_tiers_and_tables_none() -> None:
    (facts,) = scene_facts(SceneBatch.empty("pantry_shelf", 1))
    assert facts.tiers.tolist() == [4]
    (facts,) = scene_facts(SceneBatch.empty(get_scene_type("breakfast_table_low_clutter"), 1))
    assert facts.tiers.tolist() == [0]
