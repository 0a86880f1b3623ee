"""Relations of pairs of slots: biases of attention, and the features that attention gathers."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from agents.networks.geometry import PAIR_FEATURES, Relations, joint_attention, pair_features
from scene_envs.errors import UnknownNameError

SCALES = torch.logspace(-2, 0, 8, dtype=torch.float64)


def _scene(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    metres = torch.rand(2, 6, 3, generator=generator, dtype=torch.float64)
    return metres, 0.1 * torch.rand(2, 6, 1, generator=generator, dtype=torch.float64).expand(-1, -1, 3)


def test_only_offsets_count_and_turning_the_scene_turns_the_directions() -> None:
    metres, noise = _scene()
    features = pair_features(metres, noise, SCALES)
    moved = pair_features(metres + torch.tensor([3.0, -1.0, 0.5]).double(), noise, SCALES)
    torch.testing.assert_close(moved, features)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    turned = pair_features(metres @ turn.T, noise, SCALES)
    torch.testing.assert_close(turned[..., :24], features[..., :24])
    directions = features[..., 24:].unflatten(-1, (2, 8))
    torch.testing.assert_close(
        turned[..., 24:].unflatten(-1, (2, 8)), torch.einsum("ij,...jk", turn[:2, :2], directions)
    )


def test_blurred_distances_are_expectations_under_the_noise_of_their_axes() -> None:
    """E exp(-d^2 / 2 l^2) of an offset under noise of variance s^2 is l / sqrt(l^2 + s^2) of the feature, per axis."""
    generator = torch.Generator().manual_seed(1)
    metres = torch.tensor([[[0.0, 0.0, 0.0], [0.2, -0.1, 0.3]]], dtype=torch.float64)
    noise = torch.tensor([[[0.3, 0.1, 0.1], [0.4, 0.1, 0.2]]], dtype=torch.float64)
    variance = noise.square().sum(dim=1)[0]
    features = pair_features(metres, noise, SCALES)[0, 0, 1]
    drawn = metres[0, 1] + torch.randn(400_000, 3, generator=generator, dtype=torch.float64) * variance.sqrt()
    factors = SCALES / (SCALES**2 + variance[:, None]).sqrt()  # (3, 8)
    height = torch.exp(-0.5 * drawn[:, 2:] ** 2 / SCALES**2).mean(dim=0)
    torch.testing.assert_close(features[8:16] * factors[2], height, atol=2e-3, rtol=0)
    across = torch.exp(-0.5 * drawn[:, :2].square().sum(dim=-1, keepdim=True) / SCALES**2).mean(dim=0)
    torch.testing.assert_close(features[:8] * factors[:2].prod(dim=0), across, atol=2e-3, rtol=0)


def test_a_low_axis_is_blurred_by_its_own_noise() -> None:
    """In a room of 5 m by 0.5 m noise of 0.02 is 1 cm in height, which leaves 2 cm visible; 10 cm would not."""
    position, noise = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.0, 0.04]]]), torch.full((1, 2), 0.02)
    for blur, metres in (("axis", 0.01), ("largest", 0.1)):
        height = Relations(1, 2, (5.0, 5.0, 0.5), blur=blur)(position, noise)[1][0, 0, 1, 8]
        assert float(height) == pytest.approx(math.exp(-0.5 * 0.02**2 / (2 * metres**2 + 0.01**2)), rel=1e-5)
    with pytest.raises(UnknownNameError, match="axis"):
        Relations(1, 2, (1.0, 1.0, 1.0), blur="axes")


def test_messages_are_weighted_means_of_the_features() -> None:
    """With flat logits every slot gathers the mean of its features; text tokens gather nothing."""
    heads, width, text, slots = 2, 4, 3, 5
    features = torch.rand(1, slots, slots, PAIR_FEATURES)
    zeros = torch.zeros(1, heads, text + slots, width)
    mask = torch.zeros(1, heads, text + slots, text + slots)
    mask[..., :text] = -torch.inf
    gathered = nn.Linear(heads * PAIR_FEATURES, heads * width, bias=False)
    found = joint_attention(zeros, zeros, zeros, mask, features, gathered)
    mean = features.mean(dim=2).repeat(1, 1, heads)
    torch.testing.assert_close(found[:, text:], gathered(mean))
    assert not found[:, :text].any()


def test_relations_know_the_unit_of_every_axis() -> None:
    """A scene half as large in units twice as large is the same scene; an axis that never varies does not count."""
    position, noise = torch.rand(1, 4, 3), torch.rand(1, 4)
    small = Relations(1, 2, (1.0, 1.0, 0.0))
    large = Relations(1, 2, (2.0, 2.0, 0.0))
    large.load_state_dict(small.state_dict())
    large.scales.copy_(small.scales)
    for a, b in zip(small(position, noise), large(position / 2, noise / 2), strict=True):
        torch.testing.assert_close(a, b)
    flat = position.clone()
    flat[..., 2] = 0.0
    torch.testing.assert_close(small(position, noise)[1], small(flat, noise)[1])
