"""The pool on Ray: results, order, timeouts and lost workers as with processes."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from rewards.feasible import forget_verdicts
from scene_envs.envs.scoring import RewardScorer
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.physics import PhysicsPool, feasibility, make_pool
from scene_envs.scene import SceneBatch

pytest.importorskip("ray")
pytestmark = pytest.mark.slow

from scene_envs.physics import RayPhysicsPool  # noqa: E402

FIELDS = ("feasible", "depth", "displacement", "rotation", "valid", "counts")


@pytest.fixture(scope="module")
def batch() -> SceneBatch:
    clean = get_grammar("dimsum_table").sample(np.random.default_rng(11), 12)
    noise = 0.004 * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(0))
    return clean.with_poses(clean.translations + noise * clean.is_free.unsqueeze(-1), clean.rotations)


@pytest.fixture(scope="module")
def pool() -> Iterator[PhysicsPool]:
    with make_pool("ray") as pool:
        yield pool


@pytest.fixture
def shared(pool: PhysicsPool, monkeypatch: pytest.MonkeyPatch) -> None:
    """What asks for workers on Ray gets the actors of ``pool`` and leaves them running: each takes seconds to start."""
    monkeypatch.setattr(
        "scene_envs.physics.make_pool",
        lambda workers, *timeout: pool if workers == "ray" else make_pool(workers, *timeout),
    )
    monkeypatch.setattr(pool, "close", lambda: None)


def test_results_are_those_of_this_process_bit_for_bit_and_in_order(batch: SceneBatch, pool: PhysicsPool) -> None:
    found, expected = feasibility(batch, pool=pool), feasibility(batch)
    assert all(torch.equal(getattr(found, name), getattr(expected, name)) for name in FIELDS)
    assert isinstance(pool, RayPhysicsPool)
    assert os.getpid() not in pool.process_ids
    assert 1 <= len(pool.process_ids) <= pool.workers


def test_a_worker_that_is_killed_costs_nothing(batch: SceneBatch, pool: PhysicsPool) -> None:
    feasibility(batch, pool=pool)
    victim = pool.process_ids[0]
    killer = threading.Timer(0.05, os.kill, (victim, signal.SIGKILL))
    killer.start()
    large = SceneBatch.concatenate([batch] * 4)
    result = feasibility(large, pool=pool)
    killer.join()
    again = feasibility(batch, pool=pool)
    assert bool(result.valid.all())
    assert torch.equal(result.displacement, again.displacement.repeat(4, 1))
    assert victim not in pool.process_ids


def test_scenes_that_take_too_long_twice_are_invalid(
    batch: SceneBatch, pool: PhysicsPool, monkeypatch: pytest.MonkeyPatch
) -> None:
    feasibility(batch[:1], pool=pool)  # a worker is up
    with monkeypatch.context() as patch:
        patch.setattr(pool, "timeout", 1e-4)
        assert feasibility(batch[:2], pool=pool).valid.tolist() == [False, False]
    assert feasibility(batch[:2], pool=pool).valid.tolist() == [True, True]  # the pool stays usable


@pytest.mark.usefixtures("shared")
def test_a_reward_is_scored_on_ray_and_kept_by_content(batch: SceneBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    forget_verdicts()
    scorer = RewardScorer("feasible_objects", workers="ray")
    batch = batch[:4]
    first = scorer(batch)
    with monkeypatch.context() as patch:
        patch.setattr(PhysicsPool, "run", None)  # nothing is simulated a second time
        assert torch.equal(scorer(batch).value, first.value)
    scorer.close()
    assert first.value.tolist() == feasibility_counts(batch)


def feasibility_counts(batch: SceneBatch) -> list[float]:
    forget_verdicts()
    return RewardScorer("feasible_objects")(batch).value.tolist()


@pytest.mark.usefixtures("shared")
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


def test_other_words_are_refused() -> None:
    for make in (make_pool, lambda workers: RewardScorer("object_count", workers)):
        with pytest.raises(InvalidInputError, match="or ray for a Ray cluster"):
            make("dask")
