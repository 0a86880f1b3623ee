"""Claims of prompts: reading, truth values, and the distance of a false claim from a true one."""

from __future__ import annotations

import pytest

from scene_envs.datasets.prompts import (
    NameCount,
    ObjectCount,
    PairCount,
    Place,
    PlaceCount,
    PromptFacts,
    Reference,
    SceneFacts,
    SideClaim,
    SupportCount,
    Tolerances,
    parse_prompt,
    scene_facts,
)
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from tests.helpers.prompts_scenes import TOP, build

SHELF = Reference("shelf")


def facts_of(scene: SceneBatch) -> SceneFacts:
    (facts,) = scene_facts(scene)
    return facts


@pytest.mark.parametrize(
    ("text", "claims"),
    [
        ("A scene with 12 objects.", [ObjectCount(12)]),
        ("A scene with 1 object.", [ObjectCount(1)]),
        ("a scene with twelve objects", [ObjectCount(12)]),
        ("A scene with a lamp.", [NameCount("lamp", 1)]),
        ("A scene with an apple, two plates and 21 cups.",
         [NameCount("apple", 1), NameCount("plate", 2), NameCount("cup", 21)]),
        ("A scene with three steamer lids, and no tables.", [NameCount("steamer lid", 3), NameCount("table", 0)]),
        ("A scene where two coke cans are on the top shelf.", [PlaceCount("coke can", 2, Place(SHELF, 0))]),
        ("A scene where a book is on the bottom shelf.", [PlaceCount("book", 1, Place(SHELF, -1))]),
        ("A scene where a book is on the second shelf from the bottom.", [PlaceCount("book", 1, Place(SHELF, -2))]),
        ("A scene where a cup is on the second table from the left.",
         [PlaceCount("cup", 1, Place(Reference("table", 2, "left")))]),
        ("A scene where a book is on the third tier from the top of the first shelf from the back.",
         [PlaceCount("book", 1, Place(Reference("shelf", 1, "back"), 2))]),
        ("A scene where a pear is in the bowl.", [SupportCount("pear", 1, True, Reference("bowl"))]),
        ("A scene where two pears are on top of the second plate from the front.",
         [SupportCount("pear", 2, False, Reference("plate", 2, "front"))]),
        ("A scene where a pear is in the bowl on the top shelf.",
         [SupportCount("pear", 1, True, Reference("bowl", place=Place(SHELF, 0)))]),
        ("A scene where two steamer lids are each on top of a steamer bottom and an apple is in a bowl.",
         [PairCount("steamer lid", 2, False, "steamer bottom"), PairCount("apple", 1, True, "bowl")]),
        ("A scene where the lamp is behind the first book from the left on the top shelf.",
         [SideClaim(Reference("lamp"), "back", Reference("book", 1, "left", Place(SHELF, 0)))]),
        ("A scene where the book on the top shelf is next to the lamp on the same shelf.",
         [SideClaim(Reference("book", place=Place(SHELF, 0)), "next", Reference("lamp", place=Place(SHELF, 0)))]),
    ],
)  # fmt: skip
def test_reading(text: str, claims: list[object]) -> None:
    assert parse_prompt(text, "restaurant_low_clutter").claims == tuple(claims)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("Tea for two", "A scene"),
        ("A scene with two unicorns.", "'unicorns'"),
        ("A scene with a plates.", "'plates'"),
        ("A scene with two plate.", "'plate'"),
        ("A scene with a plate a cup.", "'a cup'"),
        ("A scene with 3 objects and a cup.", "only one number"),
        ("A scene with a plate,", "end"),
        ("A scene where a cup are on the table.", "'are on the table'"),
        ("A scene where the cup is under the table.", "'under the table'"),
        ("A scene where the second cup is behind the teapot.", "from the left"),
        ("A scene where a cup is in front of the teapot.", "'front of the teapot'"),
        ("A scene where a cup is on the top tier.", "belongs"),
        ("", "A scene"),
    ],
)
def test_other_text_is_refused_where_it_goes_wrong(text: str, where: str) -> None:
    with pytest.raises(InvalidInputError, match="cannot read") as error:
        parse_prompt(text, "restaurant_low_clutter")
    assert where in str(error.value)


def test_names_of_another_scene_type_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="steamer lid"):
        parse_prompt("A scene with a book.", "dimsum_table")


@pytest.fixture
def shelf() -> SceneFacts:
    cans = [("soda_can", (0.0, 0.1 * i - 0.1, TOP)) for i in range(3)]
    return facts_of(build("living_room_shelf", [*cans, ("book", (0.0, 0.25, TOP))]))


@pytest.mark.parametrize(
    ("text", "expected", "found", "score"),
    [
        ("with 5 objects", 5, 5, 1.0),
        ("with 10 objects", 10, 5, 0.5),
        ("with three coke cans", 3, 3, 1.0),
        ("with four coke cans", 4, 3, 0.75),
        ("with a coke can", 1, 3, 1 / 3),
        ("with a lamp", 1, 0, 0.0),
        ("with no lamps", 0, 0, 1.0),
        ("where two coke cans are on the top shelf", 2, 3, 2 / 3),
        ("where three coke cans are on the bottom shelf", 3, 0, 0.0),
        ("where the book is to the right of the first coke can from the left", 1, 1, 1.0),
        ("where the book is to the left of the first coke can from the left", 1, 0, 0.5),
        ("where the book is to the left of the lamp", 1, 0, 0.25),
        ("where the book is to the left of the coke can", 1, 0, 0.25),
    ],
)
def test_claims_are_graded(shelf: SceneFacts, text: str, expected: int, found: int, score: float) -> None:
    prompt = parse_prompt(f"A scene {text}.", "living_room_shelf")
    (check,) = prompt.check(shelf)
    assert (check.expected, check.found, check.mismatch) == (expected, found, abs(expected - found))
    assert check.score == pytest.approx(score)
    assert check.holds == prompt.holds(shelf) == (score == 1.0)


def test_a_prompt_says_which_claim_fails_and_about_which_slots(shelf: SceneFacts) -> None:
    prompt = parse_prompt("A scene with three coke cans, two books and a lamp.", "living_room_shelf")
    cans, books, lamp = prompt.check(shelf)
    assert [cans.holds, books.holds, lamp.holds] == [True, False, False]
    assert [cans.mismatch, books.mismatch, lamp.mismatch] == [0, 1, 1]
    assert [cans.slots, books.slots, lamp.slots] == [(1, 2, 3), (4,), ()]
    assert prompt.score(shelf) == pytest.approx((1.0 + 0.5 + 0.0) / 3)
    assert not prompt.holds(shelf)
    assert prompt.objects == {"coke can": 3, "book": 2, "lamp": 1}
    assert prompt.count is None


def test_relations_name_the_slots_of_both_things(shelf: SceneFacts) -> None:
    prompt = parse_prompt("A scene where the book is next to the third coke can from the left.", "living_room_shelf")
    (check,) = prompt.check(shelf)
    assert check.slots == (4, 3)


def test_a_prompt_with_nothing_to_say_is_true() -> None:
    assert PromptFacts(()).holds(facts_of(SceneBatch.empty("dimsum_table", 1)))


def test_neighbors_in_an_order_may_be_asked_to_stand_apart(shelf: SceneFacts) -> None:
    """The cans stand 10 cm apart."""
    first = Reference("coke can", 1, "left")
    assert first.resolve(shelf) == 1
    for order, expected in ((0.09, 1), (0.11, -1)):
        (facts,) = scene_facts(
            build("living_room_shelf", [("soda_can", (0.0, 0.1 * i, TOP)) for i in range(3)]), Tolerances(order=order)
        )
        assert first.resolve(facts) == expected
