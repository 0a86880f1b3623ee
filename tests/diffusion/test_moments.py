"""Moments by category: laws of total expectation and variance, against drawn samples."""

from __future__ import annotations

import pytest
import torch

from agents.diffusion import CategoricalProcess, Preconditioning
from agents.diffusion.categorical import make_categorical_schedule, sample_categorical
from agents.diffusion.gaussian import CategoryMoments


def _data(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Poses (M, 2) of three categories and *empty*, whose means and spreads differ."""
    generator = torch.Generator().manual_seed(0)
    categories = torch.multinomial(torch.tensor([0.5, 0.2, 0.1, 0.2]), count, replacement=True, generator=generator)
    centre = torch.tensor([[0.0, 1.0], [2.0, -1.0], [-1.0, 0.5], [0.0, 0.0]])
    spread = torch.tensor([[0.1, 0.5], [0.01, 0.2], [1.0, 0.3], [0.0, 0.0]])
    return centre[categories] + spread[categories] * torch.randn(count, 2, generator=generator), categories


def test_each_category_has_its_own_moments_and_empty_stands_still() -> None:
    poses, categories = _data(20_000)
    moments = CategoryMoments.fit(poses, categories, 4)
    for category in range(3):
        own = poses[categories == category]
        torch.testing.assert_close(moments.mean[category], own.mean(dim=0), atol=1e-5, rtol=0)
        torch.testing.assert_close(moments.std[category], own.std(dim=0), atol=1e-5, rtol=0)
    torch.testing.assert_close(moments.mean[3], poses[categories != 3].mean(dim=0), atol=1e-5, rtol=0)
    assert float(moments.std[3].max()) == pytest.approx(1e-3)


@pytest.mark.parametrize("kernel", ["absorbing", "uniform", "mask_and_replace"])
def test_moments_given_a_state_are_those_of_the_poses_that_lead_to_it(kernel: str) -> None:
    poses, categories = _data(200_000)
    moments = CategoryMoments.fit(poses, categories, 4)
    centred = torch.where((categories == 3)[:, None], moments.mean[3], poses)
    process = CategoricalProcess(make_categorical_schedule(kernel, 10), 4)
    mean, std = moments.given_state(process)
    t = 6
    noisy = sample_categorical(process.marginal(categories, torch.tensor(t)), torch.Generator().manual_seed(1))
    for state in noisy.unique().tolist():
        own = centred[noisy == state]
        torch.testing.assert_close(mean[t, state], own.mean(dim=0), atol=0.03, rtol=0)
        torch.testing.assert_close(std[t, state], own.std(dim=0).clamp(min=1e-3), atol=0.03, rtol=0.03)


def test_preconditioning_survives_json() -> None:
    poses, categories = _data(500)
    whole = Preconditioning(poses.mean(dim=0), poses.std(dim=0), CategoryMoments.fit(poses, categories, 4))
    again = Preconditioning.from_state(whole.state())
    assert again.by_category is not None
    assert whole.by_category is not None
    torch.testing.assert_close(again.by_category.std, whole.by_category.std)
    torch.testing.assert_close(again.mean, whole.mean)


def test_a_category_that_is_hardly_met_takes_the_moments_of_all_objects() -> None:
    """Two slots that happen to be alike say nothing of how far a third may be."""
    poses, categories = _data(2_000)
    rare = torch.cat([categories[categories != 2], torch.tensor([2, 2])])
    stood = torch.cat([poses[categories != 2], torch.tensor([[1.0, 1.0], [1.0, 1.0]])])
    moments = CategoryMoments.fit(stood, rare, 4)
    objects = stood[rare != 3]
    torch.testing.assert_close(moments.std[2], objects.std(dim=0), atol=1e-5, rtol=0)
    torch.testing.assert_close(moments.mean[2], objects.mean(dim=0), atol=1e-5, rtol=0)
