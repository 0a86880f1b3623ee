"""Distances between neighbours, on scenes with known ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import wasserstein_distance

from agents.evaluation import measure_samples, spacing_wasserstein
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from tests.helpers.built_scenes import build

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


def test_slots_do_not_matter() -> None:
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


def test_scenes_of_other_assets_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="pantry_shelf"):
        spacing_wasserstein(SceneBatch.empty("pantry_shelf", 2), SceneBatch.empty("dimsum_table", 2))
