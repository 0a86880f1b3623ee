"""The Gaussian process against diffusers' schedulers and closed forms."""

from __future__ import annotations

import pytest
import torch
from diffusers import DDPMScheduler

from agents.diffusion import GaussianProcess, Preconditioning, StepTable
from agents.diffusion.gaussian import lognormal_timesteps, make_schedule, timestep_weights
from scene_envs.errors import InvalidInputError, UnknownNameError

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


@pytest.mark.parametrize("name", ["karras", "linear", "cosine"])
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
