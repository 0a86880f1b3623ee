"""Which objects a search regenerates, on scenes whose overlaps are known."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from agents.planning.mask_generators import cover, culprits_mask, search_mask
from scene_envs.env_reward import RewardScorer, Score
from scene_envs.errors import UnknownNameError
from scene_envs.scene import SceneBatch
from scene_envs.search_masks import infeasible_mask


def table_with(*objects: tuple[str, float, float, float]) -> SceneBatch:
    """One dimsum scene: the table, then (asset, x, y, z) in the given order."""
    batch = SceneBatch.empty("dimsum_table", 1)
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories
    for slot, (name, *position) in enumerate(objects, start=1):
        translations[0, slot] = torch.tensor(position)
        rotations[0, slot] = torch.eye(3)
        categories[0, slot] = batch.scene_type.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, batch.scene_type)


def feasible_score(scene: SceneBatch) -> Score:
    return RewardScorer("feasible_objects")(scene)


def masked_objects(scene: SceneBatch, mask: torch.Tensor) -> list[int]:
    assert bool(mask[scene.is_empty[0]].all())  # empty slots are always regenerated
    return torch.nonzero(mask & ~scene.is_empty[0]).flatten().tolist()


def test_one_object_in_the_way_of_two_is_the_only_one_replaced() -> None:
    scene = table_with(("teapot", 0, 0, 0), ("dinner_plate", 0.15, 0, 0), ("dinner_plate", -0.15, 0, 0))
    score = feasible_score(scene)
    rng = np.random.default_rng(0)
    assert masked_objects(scene, infeasible_mask(scene, score, rng)) == [1, 2, 3]
    assert masked_objects(scene, culprits_mask(scene, score, rng)) == [1]


def test_of_two_that_overlap_one_is_replaced_and_chance_says_which() -> None:
    scene = table_with(("dinner_plate", 0, 0, 0), ("dinner_plate", 0.2, 0, 0), ("teacup", -0.3, 0, 0))
    score = feasible_score(scene)
    chosen = [masked_objects(scene, culprits_mask(scene, score, np.random.default_rng(s))) for s in range(20)]
    assert set(map(tuple, chosen)) == {(1,), (2,)}
    assert chosen[0] == masked_objects(scene, culprits_mask(scene, score, np.random.default_rng(0)))


def test_objects_that_fall_or_sink_into_the_table_are_replaced() -> None:
    scene = table_with(("teacup", 0.2, 0, 0.05), ("teapot", -0.2, 0, -0.01), ("teacup", 0, 0.2, 0))
    score = feasible_score(scene)
    assert masked_objects(scene, culprits_mask(scene, score, np.random.default_rng(0))) == [1, 2]


def test_without_anyone_to_blame_it_is_the_mask_of_the_environment() -> None:
    scene = table_with(("teacup", 0.2, 0, 0), ("teapot", -0.2, 0, 0))
    score = feasible_score(scene)
    mask = culprits_mask(scene, score, np.random.default_rng(0))
    assert torch.equal(mask, infeasible_mask(scene, score, np.random.default_rng(0)))
    assert masked_objects(scene, mask) == []


def test_covers_touch_every_pair_and_spare_the_fixed() -> None:
    for seed in range(50):
        rng = np.random.default_rng(seed)
        pairs = [pair for pair in itertools.combinations(range(9), 2) if rng.random() < 0.3 and pair != (0, 1)]
        chosen = cover(pairs, {0, 1}, rng)
        assert all(set(pair) & set(chosen) for pair in pairs)
        assert not {0, 1} & set(chosen)
        assert len(chosen) < 7 or not pairs or all(any(s in p for p in pairs) for s in chosen)


def test_names_are_resolved_and_unknown_ones_get_an_offer() -> None:
    assert search_mask("culprits") is culprits_mask
    assert search_mask("infeasible") is infeasible_mask
    with pytest.raises(UnknownNameError, match="did you mean 'culprits'"):
        search_mask("culprit")
