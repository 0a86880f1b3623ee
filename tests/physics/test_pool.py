"""The pool, with processes and on Ray: same results for any number of workers, and nothing lost with a worker."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rewards.feasible import forget_verdicts
from scene_envs.envs.scoring import RewardScorer
from scene_envs.errors import InvalidInputError, PhysicsError
from scene_envs.grammars import get_grammar
from scene_envs.physics import (
    FeasibilityResult,
    PhysicsPool,
    feasibility,
    make_pool,
    penetration,
    project,
    settle,
)
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import scene

FIELDS = ("feasible", "depth", "displacement", "rotation", "valid", "counts")


def same(first: FeasibilityResult, second: FeasibilityResult) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in FIELDS)


@pytest.fixture(scope="module")
def batch() -> SceneBatch:
    clean = get_grammar("dimsum_table").sample(np.random.default_rng(11), 8)
    noise = 0.004 * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(0))
    return clean.with_poses(clean.translations + noise * clean.is_free.unsqueeze(-1), clean.rotations)


@pytest.fixture(scope="module")
def expected(batch: SceneBatch) -> FeasibilityResult:
    return feasibility(batch)


@pytest.fixture(scope="module")
def pool() -> Iterator[PhysicsPool]:
    with PhysicsPool(workers=2) as pool:
        yield pool


@pytest.mark.slow
def test_none_one_and_two_workers_agree_bit_for_bit(
    batch: SceneBatch, expected: FeasibilityResult, pool: PhysicsPool
) -> None:
    with PhysicsPool(workers=1) as one:
        assert same(feasibility(batch, pool=one), expected)
        assert same(feasibility(batch, pool=pool), expected)
    assert len(pool.process_ids) == 2


@pytest.mark.slow
def test_every_function_runs_in_workers(batch: SceneBatch, pool: PhysicsPool) -> None:
    few = batch[:3]
    assert torch.equal(settle(few, duration=0.25, pool=pool).batch.tensor, settle(few, duration=0.25).batch.tensor)
    assert torch.equal(project(few, pool=pool).batch.tensor, project(few).batch.tensor)
    assert penetration(few, pool=pool).pairs == penetration(few).pairs


@pytest.mark.slow
def test_a_scene_type_that_only_this_process_knows_works_in_workers(pool: PhysicsPool) -> None:
    """Its assets come from no recipe: geometry travels with it."""
    batch = SceneBatch.concatenate([scene(("cube", 0.1 * i, 0.0, 0.0)) for i in range(3)])
    assert feasibility(batch, pool=pool).counts.tolist() == [1, 1, 1]


@pytest.mark.slow
def test_a_worker_killed_mid_run_costs_nothing(
    batch: SceneBatch, expected: FeasibilityResult, pool: PhysicsPool
) -> None:
    feasibility(batch[:2], pool=pool)  # both workers are up
    victim = pool.process_ids[0]
    large = SceneBatch.concatenate([batch] * 6)
    killer = threading.Timer(0.15, os.kill, (victim, signal.SIGKILL))
    killer.start()
    result = feasibility(large, pool=pool)
    killer.join()
    assert bool(result.valid.all())
    assert torch.equal(result.displacement, expected.displacement.repeat(6, 1))
    assert same(feasibility(batch, pool=pool), expected)
    assert victim not in pool.process_ids


@pytest.mark.slow
def test_workers_killed_between_two_calls_cost_nothing(
    batch: SceneBatch, expected: FeasibilityResult, pool: PhysicsPool
) -> None:
    feasibility(batch, pool=pool)
    for victim in pool.process_ids:
        os.kill(victim, signal.SIGKILL)
    for worker in pool._live:
        worker.process.wait()
    one = feasibility(batch[:1], pool=pool)
    assert bool(one.valid.all())
    assert same(feasibility(batch, pool=pool), expected)


@pytest.mark.slow
def test_a_scene_that_fails_twice_is_invalid_and_the_others_are_not(
    batch: SceneBatch, expected: FeasibilityResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too short a time limit for anything, then a sufficient one: the pool recovers."""
    from scene_envs.physics import kernels

    real = kernels.KERNELS["feasibility"]

    def slow(chunk: kernels.Chunk, **options: float) -> dict[str, object]:
        time.sleep(0.2)
        return real(chunk, **options)

    monkeypatch.setitem(kernels.KERNELS, "feasibility", slow)
    with PhysicsPool(workers=1, timeout=60.0) as pool:
        feasibility(batch[:1], pool=pool)
        pool.timeout = 1e-3
        hopeless = feasibility(batch[:2], pool=pool)
        assert hopeless.valid.tolist() == [False, False]
        assert hopeless.counts.tolist() == [0, 0]
        pool.timeout = 60.0
        assert same(feasibility(batch, pool=pool), expected)


def test_a_kernel_that_raises_on_one_scene_loses_that_scene(
    batch: SceneBatch, expected: FeasibilityResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    from scene_envs.physics import kernels

    real = kernels.KERNELS["feasibility"]
    culprit = batch.translations[3, 1].double().numpy()

    def fails_once(chunk: kernels.Chunk, **options: float) -> dict[str, object]:
        if (np.abs(chunk.translations[:, 1] - culprit).max(axis=1) < 1e-9).any():
            raise ZeroDivisionError("on purpose")
        return real(chunk, **options)

    monkeypatch.setitem(kernels.KERNELS, "feasibility", fails_once)
    result = feasibility(batch)
    assert torch.nonzero(~result.valid).flatten().tolist() == [3]
    others = torch.arange(len(batch)) != 3
    assert torch.equal(result.displacement[others], expected.displacement[others])


def test_wrong_arguments_and_a_closed_pool_are_refused(batch: SceneBatch) -> None:
    with pytest.raises(InvalidInputError, match="workers"):
        PhysicsPool(workers=-1)
    with pytest.raises(InvalidInputError, match="timeout"):
        PhysicsPool(timeout=0.0)
    pool = PhysicsPool(workers=1)
    pool.close()
    with pytest.raises(PhysicsError, match="closed"):
        feasibility(batch[:1], pool=pool)


def test_a_worker_computes_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[dict[str, Any]] = []
    monkeypatch.setattr("scene_envs.workers.Process", lambda *_, **options: given.append(options))
    PhysicsPool(workers=1)._make()
    assert given[0]["environment"]["OMP_NUM_THREADS"] == "1"


@pytest.fixture(scope="module")
def few() -> SceneBatch:
    clean = get_grammar("dimsum_table").sample(np.random.default_rng(11), 6)
    noise = 0.004 * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(0))
    return clean.with_poses(clean.translations + noise * clean.is_free.unsqueeze(-1), clean.rotations)


@pytest.fixture(scope="module")
def ray_pool() -> Iterator[PhysicsPool]:
    """On a cluster of one CPU, that is of one worker: each takes seconds to start."""
    ray = pytest.importorskip("ray")
    options = {"include_dashboard": False, "log_to_driver": False, "logging_level": "ERROR", "configure_logging": False}
    ray.init(num_cpus=1, **options)
    with make_pool("ray") as ray_pool:
        yield ray_pool
    assert ray.is_initialized()  # whoever connected disconnects
    ray.shutdown()


@pytest.fixture
def shared_ray_pool(ray_pool: PhysicsPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What asks for workers on Ray gets those of ``ray_pool`` and leaves them running."""
    monkeypatch.setattr(
        "scene_envs.physics.make_pool",
        lambda workers, **options: ray_pool if workers == "ray" else make_pool(workers, **options),
    )
    monkeypatch.setattr(ray_pool, "close", lambda: None)


@pytest.mark.slow
def test_results_are_those_of_this_process_bit_for_bit_and_in_order(few: SceneBatch, ray_pool: PhysicsPool) -> None:
    found, expected = feasibility(few, pool=ray_pool), feasibility(few)
    assert all(torch.equal(getattr(found, name), getattr(expected, name)) for name in FIELDS)
    assert os.getpid() not in ray_pool.process_ids
    assert 1 <= len(ray_pool.process_ids) <= ray_pool.workers


@pytest.mark.slow
def test_a_worker_that_is_killed_costs_nothing(few: SceneBatch, ray_pool: PhysicsPool) -> None:
    feasibility(few, pool=ray_pool)
    victim = ray_pool.process_ids[0]
    killer = threading.Timer(0.05, os.kill, (victim, signal.SIGKILL))
    killer.start()
    large = SceneBatch.concatenate([few] * 4)
    result = feasibility(large, pool=ray_pool)
    killer.join()
    again = feasibility(few, pool=ray_pool)
    assert bool(result.valid.all())
    assert torch.equal(result.displacement, again.displacement.repeat(4, 1))
    assert victim not in ray_pool.process_ids


@pytest.mark.slow
def test_scenes_that_take_too_long_twice_are_invalid(
    few: SceneBatch, ray_pool: PhysicsPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    feasibility(few[:1], pool=ray_pool)  # a worker is up
    lift = torch.tensor([0.0, 0.0, 0.1]) * few[:2].is_free[..., None]
    above = few[:2].with_poses(few[:2].translations + lift, few[:2].rotations)
    with monkeypatch.context() as patch:
        patch.setattr(ray_pool, "timeout", 1e-4)
        assert settle(above, pool=ray_pool).valid.tolist() == [False, False]
    assert feasibility(few[:2], pool=ray_pool).valid.tolist() == [True, True]  # the pool stays usable


@pytest.mark.slow
@pytest.mark.usefixtures("shared_ray_pool")
def test_a_reward_is_scored_on_ray_and_kept_by_content(few: SceneBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_verdicts()
    scorer = RewardScorer("feasible_objects", workers="ray")
    few = few[:4]
    first = scorer(few)
    with monkeypatch.context() as patch:
        patch.setattr(PhysicsPool, "run", None)  # nothing is simulated a second time
        assert torch.equal(scorer(few).value, first.value)
    scorer.close()
    assert first.value.tolist() == feasibility_counts(few)


def feasibility_counts(few: SceneBatch) -> list[float]:
    forget_verdicts()
    return RewardScorer("feasible_objects")(few).value.tolist()


@pytest.mark.slow
@pytest.mark.usefixtures("shared_ray_pool")
@pytest.mark.usefixtures("blank_curves")
def test_a_run_on_ray_is_the_run_in_this_process(tmp_path: Path) -> None:
    from agents.post_training import PostTrainConfig, post_train
    from agents.priors.testing import tiny_prior

    logs = []
    for workers in ("ray", 0):
        forget_verdicts()
        config = PostTrainConfig(
            output=str(tmp_path / str(workers)), iterations=1, batch_size=4, num_steps=4, workers=workers,
            reward="feasible_objects", algorithm={"gradient_steps": 2}, guard={"scenes": 8, "samples": 0},
            regularisation={"bank_size": 20, "batch_size": 4}, progress="none",
        )  # fmt: skip
        logs.append([{**row, "seconds": 0.0} for row in post_train(config, prior=tiny_prior()).history])
    assert logs[0] == logs[1]


@pytest.mark.slow
def test_other_words_are_refused() -> None:
    for make in (make_pool, lambda workers: RewardScorer("object_count", workers)):
        with pytest.raises(InvalidInputError, match="or ray for a Ray cluster"):
            make("dask")
