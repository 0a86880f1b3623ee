"""Shared simulation of rewards that judge the same scenes, with unchanged values."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import scene_envs.physics as physics
from rewards import FeasibleObjects, FeasibleShare, RewardContext, Stability, WeightedSum
from rewards.feasible import forget_verdicts, verdicts
from scene_envs import SceneBatch, get_grammar

LIMITS = {"max_penetration": 1e-3, "max_displacement": 1e-3, "max_rotation": 1e-2, "duration": 0.1}


@pytest.fixture
def scenes() -> SceneBatch:
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(0), 4)
    noise = 0.003 * torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(0))
    return batch.with_poses(batch.translations + noise * batch.is_free[..., None], batch.rotations)


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of scenes that physics was asked to judge, call by call."""
    forget_verdicts()
    calls: list[int] = []

    def counted(batch: SceneBatch, **limits: float) -> physics.FeasibilityResult:
        calls.append(len(batch))
        return original(batch, **limits)

    original = physics.feasibility
    monkeypatch.setattr(physics, "feasibility", counted, raising=False)
    return calls


def test_parts_of_a_composite_simulate_a_scene_once(scenes: SceneBatch, judged: list[int]) -> None:
    output = WeightedSum([FeasibleObjects(), FeasibleShare(), Stability()])(scenes, RewardContext())
    assert judged == [4]
    parts = []
    for part in (FeasibleObjects(), FeasibleShare(), Stability()):
        forget_verdicts()
        parts.append(part(scenes, RewardContext()).value)
    assert torch.equal(output.value, torch.stack(parts).sum(dim=0))
    assert judged == [4] * 4


def test_new_scenes_alone_are_judged_and_results_are_bit_identical(scenes: SceneBatch, judged: list[int]) -> None:
    verdicts(scenes[:2], LIMITS, None)
    mixed = scenes[[3, 0, 1, 3, 2]]
    found, plain = verdicts(mixed, LIMITS, None), physics.feasibility(mixed, **LIMITS)
    assert judged == [2, 2, 5]
    for name in ("feasible", "depth", "displacement", "rotation", "valid", "counts"):
        assert torch.equal(getattr(found, name), getattr(plain, name))


def test_other_limits_are_another_verdict(scenes: SceneBatch, judged: list[int]) -> None:
    FeasibleObjects()(scenes, RewardContext())
    FeasibleObjects(duration=0.05)(scenes, RewardContext())
    assert judged == [4, 4]


def test_invalid_verdicts_are_not_kept(scenes: SceneBatch, judged: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    original = physics.feasibility

    def slow(batch: SceneBatch, **limits: float) -> physics.FeasibilityResult:
        result = original(batch, **limits)
        result.valid[0] = False
        return result

    with monkeypatch.context() as patch:
        patch.setattr(physics, "feasibility", slow, raising=False)
        assert FeasibleShare()(scenes, RewardContext()).valid.tolist() == [False, True, True, True]
    assert bool(FeasibleShare()(scenes, RewardContext()).valid.all())
    assert judged == [4, 1]
