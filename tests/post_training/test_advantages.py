"""Advantages against numbers worked out by hand."""

from __future__ import annotations

import pytest
import torch

from agents.post_training import compute_advantages
from scene_envs.errors import InvalidInputError


def test_mean_baseline_by_hand() -> None:
    # mean 3, population variance (9 + 1 + 1 + 9) / 4 = 5
    reward = torch.tensor([0.0, 2.0, 4.0, 6.0])
    expected = torch.tensor([-3.0, -1.0, 1.0, 3.0]) / 5**0.5
    torch.testing.assert_close(compute_advantages(reward, baseline="mean"), expected)


def test_leave_one_out_by_hand() -> None:
    # the others' means are 4, 10/3, 8/3 and 2
    reward = torch.tensor([0.0, 2.0, 4.0, 6.0])
    expected = (reward - torch.tensor([4.0, 10 / 3, 8 / 3, 2.0])) / 5**0.5
    torch.testing.assert_close(compute_advantages(reward), expected)


@pytest.mark.parametrize("bad", [1e9, float("nan"), float("inf")])
def test_invalid_rows_leave_all_statistics(bad: float) -> None:
    valid = torch.tensor([True, False, True, True])
    ours = compute_advantages(torch.tensor([0.0, bad, 2.0, 7.0]), valid)
    torch.testing.assert_close(ours[valid], compute_advantages(torch.tensor([0.0, 2.0, 7.0])))
    assert ours[1] == 0


def test_clip() -> None:
    reward = torch.zeros(100)
    reward[0] = 1.0  # nearly ten standard deviations out
    assert float(compute_advantages(reward).max()) == 5.0
    assert float(compute_advantages(reward, clip=2.0).max()) == 2.0


@pytest.mark.parametrize("reward", [[3.0], [2.0, 2.0, 2.0]])
def test_no_spread_gives_zeros(reward: list[float]) -> None:
    assert compute_advantages(torch.tensor(reward)).tolist() == [0.0] * len(reward)


def test_no_valid_row_gives_zeros() -> None:
    assert compute_advantages(torch.tensor([1.0, 2.0]), torch.tensor([False, False])).tolist() == [0.0, 0.0]


def test_groups_have_their_own_statistics() -> None:
    reward = torch.tensor([0.0, 1.0, 100.0, 300.0])
    ours = compute_advantages(reward, groups=torch.tensor([7, 7, 9, 9]), baseline="mean")
    torch.testing.assert_close(ours, torch.tensor([-1.0, 1.0, -1.0, 1.0]))


def test_slots_share_one_baseline_and_scale() -> None:
    reward, valid = torch.tensor([[0.0, 2.0], [4.0, 6.0]]), torch.tensor([[False, True], [True, True]])
    ours = compute_advantages(reward, valid, baseline="mean")
    expected = torch.tensor([[0.0, -2.0], [0.0, 2.0]]) / (8 / 3) ** 0.5
    torch.testing.assert_close(ours, expected)


def test_unknown_baseline_is_named() -> None:
    with pytest.raises(InvalidInputError, match="median"):
        compute_advantages(torch.zeros(2), baseline="median")
