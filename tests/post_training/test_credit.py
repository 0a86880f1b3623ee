"""Credit per object of empty and of welded slots."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from agents.post_training import PostTrainer
from agents.post_training.rollouts import finished_scenes
from agents.priors.testing import tiny_prior
from rewards import WeightedSum
from rewards.base import RewardContext, RewardOutput
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import small_config


class LeftHalf:
    """Objects on the left: their number, or their share of all."""

    name: ClassVar[str] = "left_half"

    def __init__(self, averages_objects: bool) -> None:
        self.averages_objects = averages_objects

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        left = (batch.is_free & (batch.translations[..., 0] < 0)).float()
        number = left.sum(dim=-1)
        value = number / batch.is_free.sum(dim=-1).clamp(min=1) if self.averages_objects else number
        return RewardOutput(value, per_object=left)


@pytest.mark.parametrize("averages", [False, True])
def test_an_empty_slot_has_credit_under_a_sum_alone(tmp_path: Path, averages: bool) -> None:
    config = small_config(tmp_path, reward=LeftHalf(averages), batch_size=12)
    learner = PostTrainer(config, prior=tiny_prior()).learner
    try:
        batch = learner.write_advantage(learner.rollout(0))
    finally:
        learner.close()
    scenes = finished_scenes(batch)
    welded = len(scenes.scene_type.fixed)
    credit, empty = batch["per_object"][:, -1, welded:], scenes.is_empty[:, welded:]
    advantage = batch["advantage"][:, -1, welded:]
    assert empty.any()
    assert (~empty).any()
    if averages:
        assert not advantage[empty].any()
        assert float(advantage[~empty].sum()) == pytest.approx(0.0, abs=1e-4)
    else:
        assert bool((advantage[empty] == advantage[empty][0]).all())
        assert float(advantage[empty][0]) < 0
        assert float(advantage.sum()) == pytest.approx(0.0, abs=1e-4)
    good = ~empty & (credit > 0)
    assert bool((advantage[good] > 0).all())


def _credit_in_rooms(folder: Path, reward: Any, algorithm: str) -> tuple[SceneBatch, torch.Tensor, torch.Tensor]:
    """Samples of an untrained prior of rooms, and the credit and the advantage of their poses (B, N)."""
    prior = tiny_prior("restaurant_low_clutter", process="mixed", seed=3)
    config = small_config(folder, reward=reward, batch_size=12, algorithm={"name": algorithm})
    learner = PostTrainer(config, prior=prior).learner
    try:
        batch = learner.write_advantage(learner.rollout(0))
    finally:
        learner.close()
    return finished_scenes(batch), batch["per_object"][:, -1], batch["advantage"][:, -1]


@pytest.mark.parametrize(("algorithm", "averages"), [("ddpo_sf", True), ("nft", True), ("nft", False)])
def test_generated_furniture_is_not_treated_as_infeasible(tmp_path: Path, algorithm: str, averages: bool) -> None:
    scenes, credit, poses = _credit_in_rooms(tmp_path, LeftHalf(averages), algorithm)
    furniture, free = scenes.is_furniture, scenes.is_free
    assert furniture.any()
    assert not poses[furniture].any()
    assert bool((poses[free & (credit > 0)] > 0).all())
    assert bool((poses[free & (credit == 0)] < 0).all())


@pytest.mark.parametrize("algorithm", ["ddpo_sf", "nft"])
def test_furniture_that_overlaps_furniture_is_blamed(tmp_path: Path, algorithm: str) -> None:
    scenes, credit, poses = _credit_in_rooms(tmp_path, "feasible_share", algorithm)
    furniture = scenes.is_furniture
    apart, blamed = furniture & (credit > 0), furniture & (credit == 0)
    assert apart.any()
    assert blamed.any()
    assert bool((poses[apart] > 0).all())
    assert bool((poses[blamed] < 0).all())


@pytest.mark.parametrize(
    ("reward", "counts"),
    [
        ("object_count", True),
        ({"name": "clip", "reward": "object_count", "high": 30}, True),
        ({"name": "weighted_sum", "rewards": ["feasible_share", "object_count"]}, True),
        ("penetration", False),
    ],
)
def test_categories_have_credit_if_the_reward_counts_objects(tmp_path: Path, reward: Any, counts: bool) -> None:
    config = small_config(tmp_path, reward=reward, algorithm={"name": "nft"}, slots=12)
    learner = PostTrainer(config, prior=tiny_prior(process="mixed")).learner
    try:
        batch = learner.write_advantage(learner.rollout(0))
    finally:
        learner.close()
    assert float(batch["next", "reward"][:, -1].std()) > 0
    assert bool(batch["category_advantage"].any()) == counts


def test_parts_of_a_sum_have_the_same_weights_in_credit_and_value() -> None:
    """A share of the objects beside their number: credits of both are parts of the value."""
    batch = tiny_prior().sample(6, num_steps=5, seed=1)
    reward = WeightedSum([LeftHalf(True), "object_count"], weights=[1.0, 0.05])
    output = reward(batch, RewardContext())
    torch.testing.assert_close(output.per_object.sum(dim=1), output.value)
    both = WeightedSum([LeftHalf(True), LeftHalf(True)])(batch, RewardContext())
    shares = both.per_object.sum(dim=1) / batch.is_free.sum(dim=1).clamp(min=1)
    torch.testing.assert_close(shares, both.value)  # a mean of means: credits of objects are means over them
