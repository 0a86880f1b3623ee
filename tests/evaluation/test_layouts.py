"""Figures of layouts: nearest scenes and novelty, spacing of neighbours, heights of stacks."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import wasserstein_distance

from agents.evaluation import (
    grammar_scenes,
    measure_samples,
    nearest_scenes,
    novelty,
    spacing_wasserstein,
    stack_wasserstein,
    tallest_stacks,
)
from agents.evaluation.layouts import Neighbors, duplicates
from scene_envs.errors import InvalidInputError
from scene_envs.grammars.dimsum_table import STEP
from scene_envs.scene import SceneBatch, SceneObjects, cutoff, matching_distance
from tests.helpers.built_scenes import build


def scene_distances(batch: SceneBatch, other: SceneBatch) -> torch.Tensor:
    """(B,) m: distance of each scene from its counterpart in ``other``."""
    limit, pairs = cutoff(batch.scene_type), zip(SceneObjects(batch), SceneObjects(other), strict=True)
    return torch.tensor([matching_distance(first, second, limit) for first, second in pairs], dtype=torch.float64)


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


Objects = list[tuple[str, float, float, float]]


def pair(distance: float, first: str = "teacup", second: str = "teacup") -> Objects:
    return [(first, 0.0, 0.0, 0.0), (second, distance, 0.0, 0.0)]


def test_objects_that_are_pushed_apart_show_by_how_much() -> None:
    real = build(*[pair(0.2)] * 30)
    assert spacing_wasserstein(real, real) == 0.0
    assert spacing_wasserstein(build(*[pair(0.25)] * 40), real) == pytest.approx(0.05, abs=1e-6)
    assert spacing_wasserstein(build(*[pair(0.15)] * 40), real) == pytest.approx(0.05, abs=1e-6)


def test_pairs_are_weighted_by_their_frequency_in_real_scenes() -> None:
    real = build(*[pair(0.2)] * 60, *[pair(0.2, "teacup", "teapot")] * 60)  # 120 distances of cups, 60 and 60
    moved = build(*[pair(0.2)] * 60, *[pair(0.24, "teacup", "teapot")] * 60)
    assert spacing_wasserstein(moved, real) == pytest.approx(0.5 * 0.04, abs=1e-6)


def test_each_distribution_is_compared_as_scipy_does() -> None:
    rng = np.random.default_rng(0)
    samples, real = rng.uniform(0.1, 0.4, 50), rng.uniform(0.1, 0.3, 70)
    found = spacing_wasserstein(build(*map(pair, samples)), build(*map(pair, real)))
    assert found == pytest.approx(wasserstein_distance(samples, real), abs=1e-6)


def test_stacked_objects_are_no_neighbours_and_far_ones_are_equally_far() -> None:
    real = build(*[pair(0.2)] * 30)
    stacked = build(*[[*pair(0.2), ("teacup", 0.0, 0.0, 0.1)]] * 30)
    assert spacing_wasserstein(stacked, real) == 0.0
    assert spacing_wasserstein(build(*[pair(0.9)] * 30), build(*[pair(0.6)] * 30)) == 0.0
    assert spacing_wasserstein(build(*[pair(0.9)] * 30), real) == pytest.approx(0.3, abs=1e-6)


def test_slots_do_not_matter_to_spacing() -> None:
    rng = np.random.default_rng(1)
    batch = build(*[[("teacup", *rng.uniform(-0.4, 0.4, 2), 0.0) for _ in range(4)] for _ in range(20)])
    real = build(*[pair(0.2)] * 30)
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    shuffled = SceneBatch(batch.tensor[:, order], batch.scene_type).with_slots(60)
    assert spacing_wasserstein(shuffled, real) == pytest.approx(spacing_wasserstein(batch, real), abs=1e-9)


def test_rare_pairs_give_no_figure() -> None:
    few, many = build(*[pair(0.2)] * 14), build(*[pair(0.2)] * 30)
    assert spacing_wasserstein(few, many) is spacing_wasserstein(many, few) is None
    assert "spacing_wasserstein_mm" not in measure_samples(few, many, ready=False)
    assert measure_samples(many, many, ready=False)["spacing_wasserstein_mm"] == 0.0


def test_spacing_of_other_assets_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="pantry_shelf"):
        spacing_wasserstein(SceneBatch.empty("pantry_shelf", 2), SceneBatch.empty("dimsum_table", 2))


def stack(height: int, x: float = 0.0) -> Objects:
    return [("steamer_bottom", x, 0.0, level * STEP) for level in range(height)]


def test_the_tallest_stack_counts_its_free_objects() -> None:
    batch = build([], stack(1), stack(3), [*stack(2), *stack(4, x=0.25)])
    assert tallest_stacks(batch).tolist() == [0, 1, 3, 4]  # the table that carries them is welded


def test_objects_side_by_side_or_in_the_air_are_no_stack() -> None:
    beside = [*stack(1), *stack(1, x=0.25)]
    above = [("steamer_bottom", 0.0, 0.0, 0.0), ("steamer_bottom", 0.0, 0.0, STEP + 0.05)]
    assert tallest_stacks(build(beside, above)).tolist() == [1, 1]


def test_slots_do_not_matter_to_stacks() -> None:
    batch = build(stack(4), [*stack(2), *stack(3, x=0.25)])
    order = torch.arange(batch.tensor.shape[1]).flip(0)
    assert tallest_stacks(SceneBatch(batch.tensor[:, order], batch.scene_type).with_slots(60)).tolist() == [4, 3]


def test_the_distance_is_that_of_scipy() -> None:
    samples, real = build(*map(stack, (1, 2, 2, 5))), build(*map(stack, (3, 4, 4)))
    assert stack_wasserstein(samples, real) == pytest.approx(wasserstein_distance([1, 2, 2, 5], [3, 4, 4]))
    assert stack_wasserstein(real, real) == 0.0


def test_evaluation_shows_lower_stacks_of_the_same_objects() -> None:
    real = build(*[[*stack(3), *stack(1, x=0.25)]] * 4)
    lower = build(*[[*stack(2), *stack(2, x=0.25)]] * 4)
    figures = measure_samples(lower, real, ready=False)
    assert (figures["tallest_stack_mean"], figures["stack_wasserstein"]) == (2.0, 1.0)
    assert figures["count_wasserstein"] == figures["category_kl"] == 0.0


def test_stacks_of_other_assets_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="assets"):
        stack_wasserstein(SceneBatch.empty("pantry_shelf", 2), SceneBatch.empty("dimsum_table", 2))
