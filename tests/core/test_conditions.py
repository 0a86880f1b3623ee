"""Conditions in the annotations of settings: what each accepts, and what it says of the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from agents.planning.settings import SearchConfig
from agents.post_training.settings import GuardLimits
from scene_envs.envs.settings import DenoisingSettings
from scene_envs.errors import Checked, Count, InvalidInputError, Natural, Positive
from scene_envs.render import Pinhole

if TYPE_CHECKING:
    from torch import Tensor


@dataclass
class Sizes(Checked):
    count: Count = 1
    spare: Natural | None = None
    width: Positive = 1.0


@dataclass
class Foreign(Checked):
    goal: Tensor | None = None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": 0}, "count=0 must be at least 1$"),
        ({"count": True}, "count=True must be at least 1"),
        ({"count": 2.0}, "count=2.0 must be at least 1"),
        ({"count": None}, "count=None must be at least 1"),
        ({"count": np.array([1, 2])}, "must be at least 1"),
        ({"spare": -1}, "spare=-1 must be at least 0, or null"),
        ({"width": math.inf}, "width=inf must be a positive number and finite"),
        ({"width": math.nan}, "width=nan must be a positive number"),
    ],
)
def test_values_beyond_a_condition_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        Sizes(**values)


def test_whole_numbers_of_numpy_and_null_where_it_is_a_choice_are_accepted() -> None:
    sizes = Sizes(count=np.int64(3), spare=None, width=np.float32(0.5))
    assert (sizes.count, sizes.spare, sizes.width) == (3, None, 0.5)


def test_infinity_switches_a_limit_off() -> None:
    assert GuardLimits(count=math.inf).count == math.inf
    assert SearchConfig(max_seconds=math.inf).max_seconds == math.inf


def test_other_types_are_refused_in_words() -> None:
    with pytest.raises(InvalidInputError, match="max_action=True must be a positive number"):
        DenoisingSettings(max_action=True)
    with pytest.raises(InvalidInputError, match="num_steps=2147483648 must be a whole number from 1 to 2,147,483,647"):
        DenoisingSettings(num_steps=2**31)
    with pytest.raises(InvalidInputError, match=r"width=4.0 must be at least 1"):
        Pinhole(np.eye(4), 4.0, 4.0, 2.0, 2.0, 4.0, 4)
    with pytest.raises(InvalidInputError, match="names 'Tensor', which its module lacks when it runs"):
        Foreign()
