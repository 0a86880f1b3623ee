"""Prompts are true of their scenes, varied, grammatical, and can be read back."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch

from scene_envs.datasets.prompts import (
    NameCount,
    ObjectCount,
    PairCount,
    Reference,
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


@pytest.fixture(scope="module")
def batch() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(2), 200)


@pytest.mark.parametrize("kind", ["count", "names", "relations"])
def test_prompts_are_true_and_say_what_their_kind_says(batch: SceneBatch, kind: str) -> None:
    prompts = describe(batch, np.random.default_rng(0), kinds=[kind])
    facts = [parse_prompt(prompt, batch.scene_type) for prompt in prompts]
    assert all(claim.holds(scene) for claim, scene in zip(facts, scene_facts(batch), strict=True))
    what = {"count": ObjectCount, "names": NameCount, "relations": PairCount | SupportCount | SideClaim}[kind]
    assert all(isinstance(claim, what) for prompt in facts for claim in prompt.claims)


def test_the_parser_can_tell_true_from_false(batch: SceneBatch) -> None:
    """Prompts of other scenes are mostly false: the check above is not vacuous."""
    prompts = describe(batch, np.random.default_rng(0))
    scenes = scene_facts(batch)
    facts = [parse_prompt(prompt, batch.scene_type) for prompt in prompts]
    shifted = [claim.holds(scene) for claim, scene in zip(facts, scenes[7:] + scenes[:7], strict=True)]
    assert np.mean(shifted) < 0.6


def test_kinds_are_mixed_and_seeded(batch: SceneBatch) -> None:
    prompts = describe(batch, np.random.default_rng(0))
    assert prompts == describe(batch, np.random.default_rng(0))
    kinds = Counter("count" if "objects" in p else "relations" if "where" in p else "names" for p in prompts)
    assert min(kinds[kind] for kind in ("count", "names", "relations")) >= 40


def test_facts_of_a_scene_built_by_hand() -> None:
    scene = SceneBatch.empty("dimsum_table", 1)
    assets = scene.scene_type.assets
    names = ["steamer_bottom", "steamer_bottom", "steamer_lid", "teapot", "dinner_plate", "serving_dish"]
    places = [(0.2, 0, 0), (0.2, 0, 0.091), (0.2, 0, 0.182), (-0.2, 0, 0), (0, 0.4, 0), (0, -0.3, 0)]
    categories = scene.categories.clone()
    categories[0, 1:7] = torch.tensor([assets.index(name) for name in names])
    translations = scene.translations.clone()
    translations[0, 1:7] = torch.tensor(places)
    rotations = torch.eye(3).expand(1, 34, 3, 3)
    built = SceneBatch.from_parts(translations, rotations, categories, "dimsum_table")
    (facts,) = scene_facts(built)
    assert facts.count == 7
    assert facts.objects == {"table": 1, "steamer bottom": 2, "steamer lid": 1, "teapot": 1, "plate": 2}
    held = {(facts.names[i], facts.names[j]) for i, j in enumerate(facts.held.support) if j > 0}
    assert held == {("steamer bottom", "steamer bottom"), ("steamer lid", "steamer bottom")}
    prompts = {describe(built, np.random.default_rng(seed), kinds=["names"])[0] for seed in range(400)}
    assert "A scene with two plates." in prompts
    assert "A scene with a teapot." in prompts


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("A scene with a table, two plates and 21 cups.", {"table": 1, "plate": 2, "cup": 21}),
        ("A scene with three steamer lids.", {"steamer lid": 3}),
    ],
)
def test_names_are_read_in_english(text: str, expected: dict[str, int]) -> None:
    assert parse_prompt(text, "dimsum_table").objects == expected


def test_relations_are_read_in_english() -> None:
    text = "A scene where two steamer lids are each on top of a steamer bottom and a cup is in the second cup from the left."
    lids, cup = parse_prompt(text, "dimsum_table").claims
    assert lids == PairCount("steamer lid", 2, False, "steamer bottom")
    assert cup == SupportCount("cup", 1, True, Reference("cup", 2, "left"))


@pytest.mark.parametrize("text", ["Tea for two", "A scene with two unicorns.", "A scene with a plates."])
def test_other_text_is_refused(text: str) -> None:
    with pytest.raises(InvalidInputError):
        parse_prompt(text, "dimsum_table")


def test_unknown_kinds_are_refused(batch: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="mood"):
        describe(batch, np.random.default_rng(0), kinds=["mood"])


def test_three_prompts_of_different_kinds_per_scene(batch: SceneBatch) -> None:
    prompts = describe_all(batch, np.random.default_rng(0))
    assert prompts == describe_all(batch, np.random.default_rng(0))
    for three, scene in zip(prompts, scene_facts(batch), strict=True):
        assert len(set(three)) == 3
        assert all(parse_prompt(prompt, batch.scene_type).holds(scene) for prompt in three)
