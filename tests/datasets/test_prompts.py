"""Prompts of each kind: variety, seeds, grammar of the sentences, and names of assets."""

from __future__ import annotations

import re
from collections import Counter

import numpy as np
import pytest

from scene_envs.datasets.prompts import (
    NameCount,
    ObjectCount,
    PairCount,
    PlaceCount,
    SideClaim,
    SupportCount,
    describe,
    describe_all,
    parse_prompt,
    scene_facts,
)
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type
from tests.helpers.prompts_scenes import BOTTOM, TOP, UPPER, build

BUILT_IN = (
    "breakfast_table_high_clutter",
    "breakfast_table_low_clutter",
    "dimsum_table",
    "living_room_shelf",
    "pantry_shelf",
    "restaurant_high_clutter",
    "restaurant_low_clutter",
)
RELATIONS = (PairCount, PlaceCount, SideClaim, SupportCount)
CLAIMS_OF = {"count": (ObjectCount,), "names": (NameCount,), "relations": RELATIONS}


@pytest.fixture(scope="module")
def batch() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(2), 150)


@pytest.mark.parametrize("kind", ["count", "names", "relations"])
def test_prompts_say_what_their_kind_says(batch: SceneBatch, kind: str) -> None:
    prompts = describe(batch, np.random.default_rng(0), kinds=[kind])
    claims = [claim for prompt in prompts for claim in parse_prompt(prompt, batch.scene_type).claims]
    assert all(isinstance(claim, CLAIMS_OF[kind]) for claim in claims)


def test_prompts_of_other_scenes_are_mostly_false(batch: SceneBatch) -> None:
    scenes = scene_facts(batch)
    facts = [parse_prompt(prompt, batch.scene_type) for prompt in describe(batch, np.random.default_rng(0))]
    shifted = [claim.holds(scene) for claim, scene in zip(facts, scenes[7:] + scenes[:7], strict=True)]
    assert np.mean(shifted) < 0.4


def test_kinds_are_mixed_and_seeded(batch: SceneBatch) -> None:
    prompts = describe(batch, np.random.default_rng(0))
    assert prompts == describe(batch, np.random.default_rng(0))
    kinds = Counter("count" if "objects" in p else "relations" if "where" in p else "names" for p in prompts)
    assert min(kinds[kind] for kind in CLAIMS_OF) >= 30


@pytest.mark.slow
def test_three_prompts_of_different_kinds_per_scene(batch: SceneBatch) -> None:
    prompts = describe_all(batch, np.random.default_rng(0))
    assert prompts == describe_all(batch, np.random.default_rng(0))
    for three in prompts:
        claims = [parse_prompt(prompt, batch.scene_type).claims for prompt in three]
        assert all(isinstance(c[0], kinds) for c, kinds in zip(claims, CLAIMS_OF.values(), strict=True))


def test_more_prompts_than_kinds_are_all_different(batch: SceneBatch) -> None:
    for seven in describe_all(batch[:20], np.random.default_rng(0), count=7):
        assert len(set(seven)) == 7


def test_an_empty_table_has_only_so_much_to_say() -> None:
    (prompts,) = describe_all(SceneBatch.empty("dimsum_table", 1), np.random.default_rng(0))
    assert set(prompts) == {"A scene with 1 object.", "A scene with a table."}


@pytest.mark.slow
def test_half_of_the_name_lists_are_whole_and_none_is_longer_than_ten() -> None:
    batch = get_grammar("restaurant_high_clutter").sample(np.random.default_rng(0), 2)
    facts = scene_facts(batch)
    for number in range(2):
        seeds = range(60)
        lists = [describe(batch[number], np.random.default_rng(seed), kinds=["names"])[0] for seed in seeds]
        sizes = [len(parse_prompt(text, batch.scene_type).claims) for text in lists]
        most = min(10, len(facts[number].objects))
        assert max(sizes) == most
        assert 0.35 < np.mean([size == most for size in sizes]) < 0.9
        assert min(sizes) <= 3


def test_the_display_names_of_the_built_in_types() -> None:
    names = {asset.display_name for name in BUILT_IN for asset in get_scene_type(name).library}
    assert len(names) == 30
    assert {"table", "speaker", "coke can", "utensil crock", "nintendo game", "board game"} <= names


def test_display_names_shared_by_assets_are_counted_together() -> None:
    apples = ("apple_gala", "apple_golden", "apple_green", "apple_red")
    scene = build("pantry_shelf", [(apple, (0.0, 0.1 * i - 0.15, TOP)) for i, apple in enumerate(apples)])
    assert describe(scene, np.random.default_rng(0), kinds=["names"])[0] in {
        "A scene with four apples and a shelf.",
        "A scene with a shelf and four apples.",
        "A scene with four apples.",
    }


def test_plurals_and_verbs_agree() -> None:
    scene = build(
        "living_room_shelf",
        [
            *(("soda_can", (0.0, 0.1 * i, UPPER)) for i in range(3)),
            ("book", (0.0, -0.2, BOTTOM)),
            ("speaker", (0.0, 0.1, BOTTOM)),
        ],
    )
    texts = {describe(scene, np.random.default_rng(seed), kinds=["relations"])[0] for seed in range(80)}
    spoken = " ".join(texts)
    assert "three coke cans are on the second shelf from the top" in spoken
    assert "a book is on the bottom shelf" in spoken
    assert "the book is to the left of the speaker" in spoken
    assert "the speaker is to the right of the book" in spoken
    for text in texts:
        assert not re.search(r"\b(three coke cans is|a \w+ are|a [aeio]\w+ is|an [^aeiou]\w*)", text), text
        assert re.fullmatch(r"A scene where [^.]+\.", text)


def test_irregular_plurals() -> None:
    table = [(name, (0.1 * i, 0.2 * j, 0.0)) for i, name in enumerate(("knife", "utensil_crock")) for j in range(2)]
    prompts = {
        describe(build("breakfast_table_low_clutter", table), np.random.default_rng(seed), kinds=["names"])[0]
        for seed in range(60)
    }
    assert "A scene with two knives." in prompts
    knife = build("breakfast_table_low_clutter", table[1:])
    assert "A scene with a knife." in {
        describe(knife, np.random.default_rng(seed), kinds=["names"])[0] for seed in range(60)
    }


@pytest.mark.slow
def test_two_alike_are_told_apart_by_their_order() -> None:
    """A bowl holds a pear; the other one does not."""
    scene = build(
        "breakfast_table_low_clutter",
        [("bowl", (0.0, -0.3, 0.0)), ("bowl", (0.0, 0.3, 0.0)), ("pear_bosc", (0.0, 0.3, 0.006))],
    )
    clauses: set[str] = set()
    for seed in range(100):
        text = describe(scene, np.random.default_rng(seed), kinds=["relations"])[0]
        clauses |= set(re.split(r", | and ", text.removeprefix("A scene where ").removesuffix(".")))
    assert {"a pear is in a bowl", "a pear is in the second bowl from the left"} <= clauses
    assert "a pear is in the first bowl from the right" in clauses
    assert not {clause for clause in clauses if "in the bowl" in clause or "in the first bowl from the left" in clause}


def test_orders_are_not_repeated_as_relations() -> None:
    """Of two cups side by side there is nothing to say but that they are next to each other."""
    cups = build("dimsum_table", [("teacup", (0.0, -0.05, 0.0)), ("teacup", (0.0, 0.05, 0.0))])
    texts = [describe(cups, np.random.default_rng(seed), kinds=["relations"])[0] for seed in range(40)]
    assert any("next to" in text for text in texts)
    assert not any("left of" in text or "right of" in text for text in texts)


def test_no_prompts_for_no_scenes() -> None:
    empty = SceneBatch.empty("dimsum_table", 0)
    assert scene_facts(empty) == describe(empty, np.random.default_rng(0)) == []


def test_unknown_kinds_and_counts_are_refused(batch: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="mood"):
        describe(batch, np.random.default_rng(0), kinds=["mood"])
    with pytest.raises(InvalidInputError, match="got 0"):
        describe_all(batch, np.random.default_rng(0), count=0)
