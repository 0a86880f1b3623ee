"""Truth of prompts: by the checker, by an independent check, and on changed scenes, where they are false."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch

from scene_envs.datasets.prompts import ObjectCount, SideClaim, describe, describe_all, parse_prompt, scene_facts
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch
from tests.helpers.prompts_oracle import Oracle
from tests.helpers.prompts_scenes import jittered, moved, without

SCENES = {
    "breakfast_table_high_clutter": 6,
    "breakfast_table_low_clutter": 12,
    "dimsum_table": 18,
    "living_room_shelf": 15,
    "pantry_shelf": 8,
    "restaurant_high_clutter": 2,
    "restaurant_low_clutter": 3,
}
types = pytest.mark.parametrize("name", SCENES)


@cache
def scenes(name: str) -> SceneBatch:
    return get_grammar(name).sample(np.random.default_rng(17), SCENES[name])


def many(name: str) -> SceneBatch:
    """The scenes, and four more of each: in disorder (3 cm, 5 degrees), mirrored, and with objects missing."""
    base = scenes(name)
    result = [base]
    for seed in range(4):
        scene = jittered(base, 0.03, 5.0, seed)
        mirror = torch.tensor([1.0, -1.0 if seed % 2 else 1.0, 1.0])
        free = scene.is_free[..., None]
        scene = scene.with_poses(torch.where(free, scene.translations * mirror, scene.translations), scene.rotations)
        kept = torch.rand(free.shape[:2], generator=torch.Generator().manual_seed(seed)) < 0.9
        categories = torch.where(kept | ~scene.is_free, scene.categories, scene.scene_type.num_assets)
        result.append(SceneBatch.from_parts(scene.translations, scene.rotations, categories, scene.scene_type))
    return SceneBatch.concatenate(result)


@pytest.mark.slow
@types
def test_all_prompts_parse_back_and_hold(name: str) -> None:
    batch = many(name)
    for prompts, scene in zip(describe_all(batch, np.random.default_rng(0)), scene_facts(batch), strict=True):
        for prompt in prompts:
            facts = parse_prompt(prompt, name)
            assert facts.holds(scene), prompt
            assert facts.score(scene) == 1.0


@pytest.mark.slow
@types
def test_a_second_opinion_agrees(name: str) -> None:
    batch = scenes(name)
    for seed in range(2):
        prompts = describe(batch, np.random.default_rng(seed), kinds=["names", "relations"])
        for index, prompt in enumerate(prompts):
            oracle = Oracle(batch[index])
            for claim in parse_prompt(prompt, name).claims:
                assert oracle.is_true(claim), (index, prompt, claim)


@pytest.mark.slow
@types
def test_prompts_become_false_when_the_scene_changes(name: str) -> None:
    """An object less and every number is wrong; two things exchanged and their relation is."""
    batch = scenes(name)[:12]
    changed = 0
    prompts_of = describe_all(batch, np.random.default_rng(1))
    for index, (prompts, known) in enumerate(zip(prompts_of, scene_facts(batch), strict=True)):
        scene = batch[index]
        for claim in (claim for prompt in prompts for claim in parse_prompt(prompt, name).claims):
            check = claim.check(known)
            first, last = check.slots[0], check.slots[-1]
            if not isinstance(claim, SideClaim):
                other = without(scene, first)
            elif claim.subject.ordinal or claim.landmark.ordinal:
                continue  # exchanged, they may have exchanged their names too
            elif claim.side == "next":
                other = moved(scene, first, scene.translations[0, first] + torch.tensor([0.0, 7.0, 0.0]))
            else:
                halfway = moved(scene, first, scene.translations[0, last])
                other = moved(halfway, last, scene.translations[0, first])
            (facts,) = scene_facts(other)
            assert not claim.check(facts).holds, (index, claim)
            changed += 1
    assert changed > 2 * len(batch)


@types
def test_what_is_lifted_is_no_longer_on_or_in_anything(name: str) -> None:
    batch = scenes(name)[:12]
    prompts = describe(batch, np.random.default_rng(2), kinds=["relations"])
    for index, (prompt, known) in enumerate(zip(prompts, scene_facts(batch), strict=True)):
        for claim in parse_prompt(prompt, name).claims:
            check = claim.check(known)
            if not isinstance(claim, SideClaim | ObjectCount):
                slot = check.slots[0]
                up = moved(batch[index], slot, batch.translations[index, slot] + torch.tensor([0.0, 0.0, 1.5]))
                (facts,) = scene_facts(up)
                assert not claim.check(facts).holds, (index, claim)
