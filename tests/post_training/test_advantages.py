"""Advantages against numbers worked out by hand."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agents.post_training import Advantage, compute_advantages
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


def episodes(reward: Tensor, **entries: Tensor) -> TensorDict:
    """Episodes [B, 3] with rewards (B,) at their ends; ``entries`` (B, ...) are repeated at every step."""
    done = torch.zeros(len(reward), 3, 1, dtype=torch.bool)
    done[:, -1] = True
    batch = TensorDict({"next": {"reward": reward[:, None, None] * done, "done": done}}, [len(reward), 3])
    for name, values in entries.items():
        batch[name] = values[:, None].expand(-1, 3, *values.shape[1:])
    return batch


def test_the_module_writes_one_advantage_per_episode_without_copies() -> None:
    reward = torch.tensor([1.0, 2.0, 4.0, 9.0])
    batch = episodes(reward)
    batch["next", "valid"] = torch.ones(4, 3, 1, dtype=torch.bool)
    batch["next", "valid"][3, -1] = False
    advantage = Advantage()(batch)["advantage"]
    valid = torch.tensor([True, True, True, False])
    assert torch.equal(advantage[:, 0, 0], compute_advantages(reward, valid))
    assert torch.equal(batch["valid"][..., 0], valid[:, None].expand(4, 3))
    assert advantage.shape == (4, 3, 1)
    assert advantage.stride(1) == 0


def test_the_module_compares_scenes_of_equal_prompts() -> None:
    prompts = torch.tensor([[5, 1], [5, 1], [5, 2], [5, 2]])
    advantage = Advantage()(episodes(torch.tensor([0.0, 1.0, 10.0, 12.0]), prompt=prompts))["advantage"]
    assert advantage[:, -1, 0].tolist() == [-2.0, 2.0, -2.0, 2.0]


def test_the_module_gives_credit_per_object_to_credited_slots() -> None:
    credit, credited = torch.tensor([[1.0, 0.0, 7.0], [1.0, 2.0, 7.0]]), torch.tensor([[True, True, False]] * 2)
    batch = episodes(torch.tensor([1.0, 3.0]), per_object=credit, credited=credited)
    advantage = Advantage()(batch)["advantage"][:, 0]
    assert torch.equal(advantage, compute_advantages(credit, credited))
    assert Advantage(credit="scene")(batch)["advantage"].shape == (2, 3, 1)
    with pytest.raises(InvalidInputError, match="per_object"):
        Advantage(credit="object")(episodes(torch.tensor([1.0, 3.0])))


def test_the_module_refuses_parts_of_episodes() -> None:
    with pytest.raises(InvalidInputError, match="one whole episode in each row"):
        Advantage()(episodes(torch.tensor([1.0, 3.0]))[:, :2])
    with pytest.raises(InvalidInputError, match="one whole episode in each row"):
        Advantage()(torch.cat([episodes(torch.tensor([1.0, 3.0]))] * 2, dim=1))
