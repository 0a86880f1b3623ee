"""A network-free prior and rewards whose values are known in advance."""

from __future__ import annotations

import pytest
import torch

from rewards.base import RewardContext, RewardOutput
from scene_envs.scene import SceneBatch
from tests.helpers.toy_prior import ToyPrior


class MeanHeight:
    """Mean z (m) over all slots, with one term; rows of scenes whose second slot is empty are invalid when asked."""

    def __init__(self, invalid_when_second_slot_empty: bool = False) -> None:
        self.picky = invalid_when_second_slot_empty
        self.scored = 0

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        self.scored += len(batch)
        height = batch.translations[..., 2].mean(dim=1)
        valid = ~batch.is_empty[:, 1] if self.picky else None
        return RewardOutput(height, terms={"height": height}, valid=valid)


class FreeObjects:
    """Number of free objects, with credit: every second slot is blamed."""

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        good = batch.is_free & (torch.arange(batch.tensor.shape[1]) % 2 == 0)
        return RewardOutput(good.sum(dim=1).float(), object_flags={"feasible": good})


@pytest.fixture
def prior() -> ToyPrior:
    return ToyPrior()


@pytest.fixture
def height() -> MeanHeight:
    return MeanHeight()


@pytest.fixture
def picky_height() -> MeanHeight:
    return MeanHeight(invalid_when_second_slot_empty=True)


@pytest.fixture
def free_objects() -> FreeObjects:
    return FreeObjects()
