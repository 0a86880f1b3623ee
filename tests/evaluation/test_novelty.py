"""Distances between scenes against an independent optimal transport, and what copies score."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from agents.evaluation import grammar_scenes, nearest_scenes, novelty
from agents.evaluation.layouts import Neighbors, duplicates
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch, cutoff, scene_distances


@pytest.fixture(scope="module")
def scenes() -> SceneBatch:
    return grammar_scenes("dimsum_table", 240, seed=3)


def permuted(batch: SceneBatch, seed: int = 0) -> SceneBatch:
    """The same scenes with their slots in another order."""
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(seed))
    return SceneBatch(batch.tensor[:, order], batch.scene_type)


def shifted(batch: SceneBatch, by: float) -> SceneBatch:
    """All free objects ``by`` metres further along x."""
    translations = batch.translations.clone()
    translations[..., 0] += by * batch.is_free
    return batch.with_poses(translations, batch.rotations)


def transport_cost(first: SceneBatch, second: SceneBatch) -> float:
    """The distance of two single scenes by POT's linear programme, with dummy objects as counterparts."""
    import ot

    limit = cutoff(first.scene_type)
    free = [batch.is_free[0] for batch in (first, second)]
    where = [batch.translations[0, kept].double().numpy() for batch, kept in zip((first, second), free, strict=True)]
    what = [batch.categories[0, kept].numpy() for batch, kept in zip((first, second), free, strict=True)]
    size = max(map(len, what))
    cost = np.full((size, size), limit)
    apart = np.minimum(ot.dist(where[0], where[1], metric="euclidean"), limit)
    cost[: len(what[0]), : len(what[1])] = np.where(what[0][:, None] == what[1], apart, limit)
    return float(ot.emd2(np.full(size, 1 / size), np.full(size, 1 / size), cost))


def test_distances_are_those_of_optimal_transport(scenes: SceneBatch) -> None:
    found = scene_distances(scenes[:8], scenes[8:16])
    expected = [transport_cost(scenes[i], scenes[8 + i]) for i in range(8)]
    assert found.tolist() == pytest.approx(expected, abs=1e-7)


def test_distances_are_a_metric(scenes: SceneBatch) -> None:
    a, b, c = scenes[:10], scenes[10:20], scenes[20:30]
    assert torch.allclose(scene_distances(a, b), scene_distances(b, a))
    assert scene_distances(a, permuted(a)).max() == 0
    assert (scene_distances(a, c) <= scene_distances(a, b) + scene_distances(b, c) + 1e-12).all()


def test_a_shift_of_all_objects_is_the_distance(scenes: SceneBatch) -> None:
    assert scene_distances(shifted(scenes[:5], 0.002), scenes[:5]).tolist() == pytest.approx([0.002] * 5, abs=1e-6)


def test_a_missing_object_costs_the_cutoff(scenes: SceneBatch) -> None:
    whole = scenes[:1]
    free = torch.nonzero(whole.is_free[0]).flatten()
    categories = whole.categories.clone()
    categories[0, free[0]] = whole.scene_type.num_assets
    less = SceneBatch.from_parts(whole.translations, whole.rotations, categories, whole.scene_type)
    assert float(scene_distances(less, whole)) == pytest.approx(cutoff(whole.scene_type) / len(free))


def test_the_nearest_scene_is_found_among_many(scenes: SceneBatch) -> None:
    found = nearest_scenes(shifted(permuted(scenes[100:110]), 0.003), scenes)
    assert found.index.tolist() == list(range(100, 110))
    assert found.distance.tolist() == pytest.approx([0.003] * 10, abs=1e-6)
    assert found.copied.all()


def test_few_candidates_find_nearly_what_all_do(scenes: SceneBatch) -> None:
    some, rest = scenes[:20], scenes[20:]
    few, all_of_them = nearest_scenes(some, rest, candidates=32), nearest_scenes(some, rest, candidates=len(rest))
    assert (few.distance >= all_of_them.distance - 1e-12).all()
    assert float(few.distance.median()) <= 1.1 * float(all_of_them.distance.median())


def test_copies_of_training_scenes_have_no_novelty_and_fresh_scenes_have_it_all(scenes: SceneBatch) -> None:
    training, real, fresh = scenes[:160], scenes[160:200], scenes[200:]
    held_out = nearest_scenes(real, training)
    copies = nearest_scenes(permuted(training[:40]), training)
    assert novelty(copies, held_out) == 0.0
    assert copies.copied.all()
    assert novelty(nearest_scenes(shifted(training[:40], 1e-3), training), held_out) < 0.05
    new = nearest_scenes(fresh, training)
    assert novelty(new, held_out) == pytest.approx(1.0, abs=0.15)
    assert not new.copied.any()


def test_held_out_copies_make_the_ratio_infinite_or_one() -> None:
    def at(distance: float) -> Neighbors:
        return Neighbors(torch.full((3,), distance), torch.zeros(3).long(), torch.zeros(3, dtype=torch.bool))

    assert novelty(at(0.1), at(0.0)) == float("inf")
    assert novelty(at(0.0), at(0.0)) == 1.0


def test_duplicates_are_counted_whatever_the_order_of_slots(scenes: SceneBatch) -> None:
    some = scenes[:6]
    assert duplicates(some) == 0.0
    twice = SceneBatch.concatenate([some, shifted(permuted(some[:3]), 0.009)])
    assert duplicates(twice) == pytest.approx(6 / 9)
    assert duplicates(SceneBatch.concatenate([some, shifted(some[:3], 0.011)])) == 0.0


def test_scenes_of_other_assets_are_refused(scenes: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="'dimsum_table' cannot be compared with scenes of 'pantry_shelf'"):
        nearest_scenes(scenes[:2], SceneBatch.empty("pantry_shelf", 2))
    with pytest.raises(InvalidInputError, match="2 scenes have no nearest among 0"):
        nearest_scenes(scenes[:2], scenes[:0])
    with pytest.raises(InvalidInputError, match="3 scenes have no counterparts in 2"):
        scene_distances(scenes[:3], scenes[:2])
