"""The Gaussian process against diffusers' schedulers and closed forms: steps, loss weights, moments."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import DDPMScheduler

from agents.diffusion import CategoricalProcess, GaussianProcess, Preconditioning, StepTable
from agents.diffusion.categorical import inverted, make_categorical_schedule
from agents.diffusion.gaussian import (
    CategoryMoments,
    check_weighting,
    lognormal_timesteps,
    loss_weights,
    make_schedule,
    timestep_weights,
)
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar

D = 20


@pytest.fixture
def moments() -> Preconditioning:
    generator = torch.Generator().manual_seed(3)
    return Preconditioning(torch.rand(D, generator=generator) - 0.5, torch.rand(D, generator=generator) + 0.1)


@pytest.mark.parametrize("num_steps", [50, 150, 1000])
def test_strided_posterior_equals_diffusers(num_steps: int, moments: Preconditioning) -> None:
    """Mean and std of every stride equal DDPMScheduler's at its own timesteps (offset by one)."""
    process = GaussianProcess(make_schedule("linear"), "epsilon", moments)
    scheduler = DDPMScheduler(num_train_timesteps=1000, beta_schedule="linear", clip_sample=False)
    scheduler.set_timesteps(num_steps)
    theirs = scheduler.timesteps
    stride = 1000 // num_steps
    generator = torch.Generator().manual_seed(0)
    for t in theirs[:: max(1, num_steps // 7)].tolist():
        previous = t - stride
        if previous < 0:
            continue
        x_t, eps = torch.randn(2, 3, 34, D, generator=generator)
        seed = torch.Generator().manual_seed(7)
        expected = scheduler.step(eps, t, x_t, generator=seed).prev_sample
        noise = torch.randn(x_t.shape, generator=torch.Generator().manual_seed(7))
        x0 = process.x0_from_output(x_t, torch.tensor(t + 1), eps)
        mean, std = process.posterior(x_t, x0, t + 1, previous + 1)
        torch.testing.assert_close(mean + std * noise, expected, atol=2e-4, rtol=2e-4)


def test_add_noise_equals_diffusers(moments: Preconditioning) -> None:
    process = GaussianProcess(make_schedule("linear"), "epsilon", moments)
    scheduler = DDPMScheduler(num_train_timesteps=1000, beta_schedule="linear")
    x0, noise = torch.randn(2, 4, 34, D)
    t = torch.tensor([0, 10, 500, 999])
    torch.testing.assert_close(process.add_noise(x0, t + 1, noise), scheduler.add_noise(x0, noise, t))


@pytest.mark.parametrize("name", ["karras", "linear"])
@pytest.mark.parametrize("prediction", ["edm", "epsilon", "x0", "v"])
def test_the_target_decodes_to_the_clean_scene(name: str, prediction: str, moments: Preconditioning) -> None:
    """A network that outputs the regression target has denoised perfectly."""
    process = GaussianProcess(make_schedule(name), prediction, moments)
    x0, noise = torch.randn(2, 5, 34, D)
    t = torch.tensor([1, 10, 100, 400, 700])
    x_t = process.add_noise(x0, t, noise)
    target = process.target(x0, x_t, t, noise)
    torch.testing.assert_close(process.x0_from_output(x_t, t, target), x0, atol=2e-3, rtol=2e-3)


def test_edm_input_and_target_have_unit_variance() -> None:
    """For data with the assumed moments the network sees and predicts unit variance at every level."""
    moments = Preconditioning(torch.full((D,), 0.3), torch.linspace(0.1, 0.9, D))
    process = GaussianProcess(make_schedule("karras"), "edm", moments)
    generator = torch.Generator().manual_seed(0)
    x0 = 0.3 + moments.std * torch.randn(20_000, 1, D, generator=generator)
    noise = torch.randn(x0.shape, generator=generator)
    for level in (1, 200, 500, 800, 1000):
        t = torch.full((len(x0),), level)
        x_t = process.add_noise(x0, t, noise)
        for quantity in (process.network_input(x_t, t), process.target(x0, x_t, t, noise)):
            assert torch.allclose(quantity.std(dim=0), torch.ones(D), atol=0.03)
            assert torch.allclose(quantity.mean(dim=0), torch.zeros(D), atol=0.05)


@pytest.mark.parametrize("num_steps", [10, 25, 150])
def test_the_optimal_gaussian_chain_reproduces_the_data(num_steps: int) -> None:
    """With the exact denoiser of Gaussian data and its known error, few ancestral steps return mean and std.

    For x_0 ~ N(m, s^2) the error of the best denoiser is s^2 sigma^2 / (alpha^2 s^2 + sigma^2).
    """
    moments = Preconditioning(torch.full((D,), 0.2), torch.full((D,), 0.5))
    process = GaussianProcess(make_schedule("karras"), "edm", moments)
    generator = torch.Generator().manual_seed(0)
    table = StepTable.spaced(1000, num_steps)
    x = torch.randn(4000, 1, D, generator=generator)
    for t, previous in zip(table.timesteps.tolist(), table.previous.tolist(), strict=True):
        x0 = process.x0_from_output(x, torch.full((len(x),), t), torch.zeros_like(x))
        alpha, sigma = process.alpha[t], process.sigma[t]
        error = 0.25 * sigma**2 / (0.25 * alpha**2 + sigma**2)
        mean, std = process.posterior(x, x0, t, previous, residual=error)
        x = mean + std * torch.randn(x.shape, generator=generator)
    assert float(x.mean()) == pytest.approx(0.2, abs=0.01)
    assert float(x.std()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("num_steps", [1, 25, 50, 150, 1000])
def test_step_tables_visit_both_ends(num_steps: int) -> None:
    table = StepTable.spaced(1000, num_steps)
    assert len(table) == num_steps
    assert int(table.timesteps[0]) == 1000
    assert int(table.previous[-1]) == 0
    assert bool((table.timesteps[1:] < table.timesteps[:-1]).all())
    if num_steps > 1:
        assert int(table.timesteps[-1]) == 1


@pytest.mark.parametrize("num_steps", [0, 1001, -3])
def test_steps_outside_the_schedule_are_refused(num_steps: int) -> None:
    with pytest.raises(InvalidInputError, match=str(num_steps)):
        StepTable.spaced(1000, num_steps)


def test_broken_step_tables_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="chain"):
        StepTable(torch.tensor([10, 5]), torch.tensor([4, 0]))


def test_unknown_schedule_names_the_nearest() -> None:
    with pytest.raises(UnknownNameError, match="karras"):
        make_schedule("karas")


def test_half_of_both_distributions_of_timesteps_is_uniform() -> None:
    schedule = make_schedule("karras", num_timesteps=100)
    weights = [timestep_weights(name, schedule, -1.2, 1.0) for name in ("both", "lognormal", "uniform")]
    torch.testing.assert_close(weights[0], (weights[1] + weights[2]) / 2)
    assert float(weights[0].sum()) == pytest.approx(1.0)


def test_training_timesteps_follow_the_lognormal_distribution() -> None:
    """ln(noise-to-signal) of drawn timesteps has the asked mean and std."""
    schedule = make_schedule("karras")
    weights = lognormal_timesteps(schedule, -1.2, 1.0)
    log_sigma = schedule.noise_to_signal.clamp(min=1e-9).log()
    mean = float((weights * log_sigma).sum())
    std = float((weights * (log_sigma - mean) ** 2).sum().sqrt())
    assert float(weights[0]) == 0.0
    assert mean == pytest.approx(-1.2, abs=0.01)
    assert std == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("prediction", ["epsilon", "v", "x0"])
def test_min_snr_weighs_the_error_of_the_clean_scene(prediction: str) -> None:
    """Whatever is predicted, weight times error is min(SNR, 5) times the squared error of x_0 (Hang et al. 2023)."""
    schedule = make_schedule("linear")
    process = GaussianProcess(schedule, prediction, Preconditioning(torch.zeros(1), torch.ones(1)))
    t = torch.tensor([1, 50, 150, 400, 700])
    generator = torch.Generator().manual_seed(0)
    x_t, output = torch.randn(2, 5, 3, 1, generator=generator, dtype=torch.float64)
    wrong = 1e-2 * torch.randn(output.shape, generator=generator, dtype=torch.float64)
    error = process.x0_from_output(x_t, t, output + wrong) - process.x0_from_output(x_t, t, output)
    snr = schedule.alpha_bar[t] / (1 - schedule.alpha_bar[t])
    expected = snr.clamp(max=5.0)[:, None, None] * error.square()
    weights = loss_weights(schedule, t, prediction, "min_snr").double()
    torch.testing.assert_close(weights[:, None, None] * wrong.square(), expected, rtol=1e-3, atol=0)


def test_weights_of_one_and_names() -> None:
    schedule, t = make_schedule("karras"), torch.tensor([1, 500, 1000])
    assert loss_weights(schedule, t, "edm", "none").tolist() == [1.0, 1.0, 1.0]
    with pytest.raises(InvalidInputError, match="prediction='edm'"):
        check_weighting("min_snr", "edm")
    with pytest.raises(UnknownNameError, match="did you mean 'min_snr'"):
        loss_weights(schedule, t, "v", "min-snr")
    with pytest.raises(UnknownNameError, match="prediction"):
        check_weighting("none", "noise")


def test_a_prior_weighs_its_loss() -> None:
    base = tiny_prior(process="continuous")
    config = replace(base.config, schedule="linear", prediction="v")
    plain: ScenePrior = type(base)(config, base.normalizer, base.preconditioning)  # type: ignore[call-arg]
    weighted = deepcopy(plain)
    weighted.config = replace(config, loss_weighting="min_snr")
    x0 = plain.encode(get_grammar("dimsum_table").sample(np.random.default_rng(0), 4))
    t = torch.tensor([1, 100, 400, 900])
    losses = [prior.pretraining_loss(x0, torch.Generator().manual_seed(0), "none", t) for prior in (plain, weighted)]
    weights = loss_weights(make_schedule("linear"), t, "v", "min_snr")
    torch.testing.assert_close(losses[1], weights * losses[0])
    karras = tiny_prior()
    with pytest.raises(InvalidInputError, match="min_snr"):
        type(karras)(replace(karras.config, loss_weighting="min_snr"), karras.normalizer, karras.preconditioning)  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("prediction", "timesteps", "uniform"),
    [("edm", None, False), ("epsilon", None, True), ("v", "lognormal", False), ("edm", "uniform", True)],
)
def test_timesteps_are_drawn_as_published_or_as_asked(prediction: str, timesteps: str | None, uniform: bool) -> None:
    base = tiny_prior()
    config = replace(base.config, prediction=prediction, timesteps=timesteps)
    prior: ScenePrior = type(base)(config, base.normalizer, base.preconditioning)  # type: ignore[call-arg]
    drawn = prior.draw_timesteps(20_000, torch.Generator().manual_seed(0))
    assert 1 <= int(drawn.min()) <= int(drawn.max()) <= 1000
    quarters = torch.bincount((drawn - 1) // 250, minlength=4) / 20_000
    assert bool((quarters - 0.25).abs().max() < 0.02) == uniform


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
    assert float(moments.std[3].max()) == pytest.approx(1e-4)


@pytest.mark.parametrize("kernel", ["early_absorbing", "mask_and_replace"])
def test_moments_given_a_state_are_those_of_the_poses_that_lead_to_it(kernel: str) -> None:
    poses, categories = _data(200_000)
    moments = CategoryMoments.fit(poses, categories, 4)
    centred = torch.where((categories == 3)[:, None], moments.mean[3], poses)
    process = CategoricalProcess(make_categorical_schedule(kernel, 10), 4)
    mean, std = moments.given_state(process)
    t = 6
    uniform = torch.rand(categories.shape, generator=torch.Generator().manual_seed(1))
    noisy = inverted(process.marginal(categories, torch.tensor(t)).cumsum(-1), uniform)
    for state in noisy.unique().tolist():
        own = centred[noisy == state]
        torch.testing.assert_close(mean[t, state], own.mean(dim=0), atol=0.03, rtol=0)
        torch.testing.assert_close(std[t, state], own.std(dim=0).clamp(min=1e-4), atol=0.03, rtol=0.03)


def test_a_coordinate_that_never_varies_is_known_whatever_the_network_says() -> None:
    """Shelves stand against a wall: in a room whose unit is 5 m, errors of a network are then at most 2 mm."""
    poses, categories = _data(2_000)
    poses[categories == 1, 0] = -0.95
    moments = CategoryMoments.fit(poses, categories, 4)
    whole = Preconditioning(poses.mean(dim=0), poses.std(dim=0), moments)
    process = GaussianProcess(make_schedule("karras", noise_floor=0.0004), "edm", whole)
    generator = torch.Generator().manual_seed(0)
    own = moments.mean[1], moments.std[1]
    for level in (1, 100, 1000):
        clean, t = torch.tensor([-0.95, 0.3]).expand(500, 2), torch.full((500,), level)
        noisy = process.add_noise(clean, t, torch.randn(500, 2, generator=generator))
        output = torch.randn(500, 2, generator=generator).clamp(-3, 3)
        found = process.x0_from_output(noisy, t, output, own)
        assert float((found[:, 0] + 0.95).abs().max()) < 4e-4


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
