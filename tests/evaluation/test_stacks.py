"""Stacks of scenes whose heights are known."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import wasserstein_distance

from agents.evaluation import measure_samples, stack_wasserstein, tallest_stacks
from scene_envs.errors import InvalidInputError
from scene_envs.grammars.dimsum_table import STEP
from scene_envs.scene import SceneBatch
from tests.helpers.built_scenes import build

Objects = list[tuple[str, float, float, float]]


def stack(height: int, x: float = 0.0) -> Objects:
    return [("steamer_bottom", x, 0.0, level * STEP) for level in range(height)]


def test_the_tallest_stack_counts_its_free_objects() -> None:
    batch = build([], stack(1), stack(3), [*stack(2), *stack(4, x=0.25)])
    assert tallest_stacks(batch).tolist() == [0, 1, 3, 4]  # the table that carries them is welded


def test_objects_side_by_side_or_in_the_air_are_no_stack() -> None:
    beside = [*stack(1), *stack(1, x=0.25)]
    above = [("steamer_bottom", 0.0, 0.0, 0.0), ("steamer_bottom", 0.0, 0.0, STEP + 0.05)]
    assert tallest_stacks(build(beside, above)).tolist() == [1, 1]


def test_slots_do_not_matter() -> None:
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


def test_scenes_of_other_assets_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="assets"):
        stack_wasserstein(SceneBatch.empty("pantry_shelf", 2), SceneBatch.empty("dimsum_table", 2))
