"""Both priors against diffusers' schedulers: the same step tables, means, variances and chains; eta.

The schedulers keep their rates in float32, where 1 - alpha_bar has few digits at low noise; here they are recomputed in
float64 from the schedulers' own betas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from agents.diffusion import GaussianProcess, Preconditioning, ResidualVariance, StepTable
from agents.diffusion.gaussian import make_schedule
from agents.post_training import DenoisingPolicy
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.envs import DenoisingCore
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar

diffusers = pytest.importorskip("diffusers")

STEPS = (25, 50, 1000)
PREDICTIONS = {"epsilon": "epsilon", "v": "v_prediction", "x0": "sample"}
PROCESSES = ("continuous", "mixed")
POSE, STD = 12, 0.5
CHAIN = 50
"""Steps of a chain at most: of 1000, the last ones, whose every step is one timestep."""


def _answer(prediction: str, x: Tensor, level: Tensor) -> Tensor:
    """What the best denoiser of data N(0, STD^2) says at noise-to-signal ``level``, and a little that is not linear."""
    alpha, sigma = 1 / (1 + level**2).sqrt(), level / (1 + level**2).sqrt()
    x0 = alpha * STD**2 * x / (alpha**2 * STD**2 + sigma**2) + 0.1 * torch.sin(3 * x) * sigma
    noise = (x - alpha * x0) / sigma
    return {"epsilon": noise, "v": alpha * noise - sigma * x0, "x0": x0}[prediction]


class _Continuous(nn.Module):
    """A continuous network in closed form."""

    def __init__(self, prediction: str) -> None:
        super().__init__()
        self.prediction = prediction

    def forward(self, x: Tensor, position: Tensor, noise_level: Tensor) -> Tensor:
        return _answer(self.prediction, x, noise_level[:, None, None].to(x.dtype))


class _Mixed(_Continuous):
    """The same for poses, beside categories that are all alike."""

    config: Any

    def forward(self, pose: Tensor, states: Tensor, time: Tensor, **given: Any) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        level = given["noise_level"][..., None].to(pose.dtype)
        return _answer(self.prediction, pose, level), pose.new_zeros(*states.shape, self.config.categories)


def _prior(process: str, prediction: str) -> ScenePrior:
    """A prior with the linear schedule whose network is a formula."""
    base = tiny_prior(process=process)
    config = getattr(base, "mixed", base.config)
    # no entry is observed: the formula does not know of any
    extra = {"observed_share": 0.0} if process == "mixed" else {}
    config = replace(config, schedule="linear", prediction=prediction, **extra)
    prior: ScenePrior = type(base)(config, base.normalizer, base.preconditioning)  # type: ignore[call-arg]
    network = (_Mixed if process == "mixed" else _Continuous)(prediction)
    if isinstance(network, _Mixed):
        network.config = config.network
    prior.denoiser.network = network
    return prior.eval()


def _exact(scheduler: Any) -> Any:
    """The scheduler with its rates in float64."""
    scheduler.alphas_cumprod = torch.cumprod(1.0 - scheduler.betas.double(), dim=0)
    scheduler.one = scheduler.final_alpha_cumprod = torch.ones((), dtype=torch.float64)
    return scheduler


def _ddpm(prediction: str, num_steps: int, spacing: str = "linspace") -> Any:
    scheduler = diffusers.DDPMScheduler(
        num_train_timesteps=1000,
        beta_schedule="linear",
        prediction_type=PREDICTIONS[prediction],
        clip_sample=False,
        timestep_spacing=spacing,
    )
    scheduler.set_timesteps(num_steps)
    return _exact(scheduler)


def _ddim(prediction: str, num_steps: int) -> Any:
    scheduler = diffusers.DDIMScheduler(
        num_train_timesteps=1000,
        beta_schedule="linear",
        prediction_type=PREDICTIONS[prediction],
        clip_sample=False,
        timestep_spacing="leading",
    )
    scheduler.set_timesteps(num_steps)
    return _exact(scheduler)


def _levels(num_steps: int) -> list[int]:
    return sorted({*range(0, num_steps, max(1, num_steps // 12)), 1, num_steps - 2, num_steps - 1})


def _moments(step: Any) -> tuple[Tensor, Tensor]:
    return step.mean[..., :POSE], step.std[..., :POSE]


def _start(prior: ScenePrior, seed: int = 0) -> tuple[Tensor, Tensor]:
    """x_T (2, 6, D) in float64, and which of its pose entries are free, (6, 12)."""
    x = prior.initial(2, 6, torch.Generator().manual_seed(seed)).double()
    return x, ~prior.known(6)[:, :POSE]


def _chain(num_steps: int, x: Tensor) -> range:
    """The steps of a chain from ``x``, whose poses become those of data where it begins with little noise."""
    if num_steps > CHAIN:
        x[..., :POSE] *= STD
    return range(num_steps)[-CHAIN:]


def _output(scheduler: Any, prediction: str, x: Tensor, t: int) -> Tensor:
    """What the network says of poses ``x`` at the scheduler's timestep ``t``."""
    alpha_bar = scheduler.alphas_cumprod[t]
    return _answer(prediction, x, ((1 - alpha_bar) / alpha_bar).sqrt())


@pytest.fixture
def given_noise(monkeypatch: pytest.MonkeyPatch) -> Callable[[Tensor], None]:
    """Sets the noise that DDPMScheduler draws."""
    noise: list[Tensor] = [torch.zeros(())]
    monkeypatch.setattr("diffusers.schedulers.scheduling_ddpm.randn_tensor", lambda *_, **__: noise[0])

    def put(value: Tensor) -> None:
        noise[0] = value

    return put


@pytest.mark.parametrize("num_steps", STEPS)
def test_step_tables_are_those_of_linspace(num_steps: int) -> None:
    """Ours count from 1, theirs from 0."""
    table = StepTable.spaced(1000, num_steps)
    assert (table.timesteps - 1).tolist() == _ddpm("epsilon", num_steps).timesteps.tolist()


def test_rates_are_those_of_the_linear_schedule() -> None:
    theirs = _ddpm("epsilon", 1000).alphas_cumprod
    torch.testing.assert_close(make_schedule("linear").alpha_bar[1:], theirs, atol=1e-9, rtol=1e-6)


@pytest.mark.parametrize("num_steps", STEPS)
@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("process", PROCESSES)
def test_steps_have_the_mean_and_variance_of_ddpm(
    process: str, prediction: str, num_steps: int, given_noise: Callable[[Tensor], None]
) -> None:
    prior, scheduler = _prior(process, prediction), _ddpm(prediction, num_steps)
    table = prior.step_table(num_steps)
    x, free = _start(prior)
    for step in _levels(num_steps):
        t = int(scheduler.timesteps[step])
        mean, std = _moments(prior.transition(x, step, table))
        pose = x[..., :POSE]
        given_noise(torch.zeros_like(pose))
        expected = scheduler.step(_output(scheduler, prediction, pose, t), t, pose).prev_sample
        torch.testing.assert_close(mean[:, free], expected[:, free], atol=1e-6, rtol=0)
        variance = scheduler._get_variance(t) if t > 0 else torch.zeros(())
        torch.testing.assert_close(
            std[free].double() ** 2, variance.expand(int(free.sum())).double(), atol=1e-6, rtol=0
        )


@pytest.mark.slow
@pytest.mark.parametrize("eta", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("process", PROCESSES)
def test_steps_have_the_mean_and_variance_of_ddim(process: str, prediction: str, eta: float) -> None:
    """At their own timesteps, from 1 on."""
    prior = _prior(process, prediction)
    x, free = _start(prior)
    for num_steps in STEPS:
        scheduler = _ddim(prediction, num_steps)
        table = StepTable.from_timesteps((scheduler.timesteps + 1).tolist(), 1000)
        for step in _levels(num_steps):
            t = int(scheduler.timesteps[step])
            mean, std = _moments(prior.transition(x, step, table, eta=eta))  # type: ignore[call-arg]
            pose = x[..., :POSE]
            output = _output(scheduler, prediction, pose, t)
            results = [
                scheduler.step(output, t, pose, eta=eta, variance_noise=torch.full_like(pose, value)).prev_sample
                for value in (0.0, 1.0)
            ]
            torch.testing.assert_close(mean[:, free], results[0][:, free], atol=1e-6, rtol=0)
            spread = (results[1] - results[0])[:, free]
            torch.testing.assert_close(std[free].double().expand_as(spread), spread, atol=1e-6, rtol=0)
            assert eta > 0 or bool((std == 0).all())


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", STEPS)
@pytest.mark.parametrize("process", PROCESSES)
def test_whole_chains_end_where_those_of_ddpm_end(
    process: str, num_steps: int, given_noise: Callable[[Tensor], None]
) -> None:
    prior, scheduler = _prior(process, "epsilon"), _ddpm("epsilon", num_steps)
    table, generator = prior.step_table(num_steps), torch.Generator().manual_seed(1)
    x, free = _start(prior)
    steps = _chain(num_steps, x)
    theirs = x[..., :POSE].clone()
    for step in steps:
        noise = torch.randn(x.shape, generator=generator, dtype=x.dtype)
        t = int(scheduler.timesteps[step])
        given_noise(noise[..., :POSE])
        theirs = scheduler.step(_output(scheduler, "epsilon", theirs, t), t, theirs).prev_sample
        x = prior.transition(x, step, table).from_noise(noise)
    torch.testing.assert_close(x[..., :POSE][:, free], theirs[:, free], atol=2e-6, rtol=0)
    assert 0.1 < float(theirs[:, free].std()) < 1.0  # of the data's order, neither collapsed nor diverged


@pytest.mark.slow
@pytest.mark.parametrize("num_steps", STEPS)
@pytest.mark.parametrize("process", PROCESSES)
def test_whole_chains_without_noise_end_where_those_of_ddim_end(process: str, num_steps: int) -> None:
    prior, scheduler = _prior(process, "v"), _ddim("v", num_steps)
    table = StepTable.from_timesteps((scheduler.timesteps + 1).tolist(), 1000)
    x, free = _start(prior)
    steps = _chain(num_steps, x)
    theirs = x[..., :POSE].clone()
    for step in steps:
        t = int(scheduler.timesteps[step])
        theirs = scheduler.step(_output(scheduler, "v", theirs, t), t, theirs, eta=0.0).prev_sample
        x = prior.transition(x, step, table, eta=0.0).from_noise(torch.randn(x.shape).double())  # type: ignore[call-arg]
    torch.testing.assert_close(x[..., :POSE][:, free], theirs[:, free], atol=2e-6, rtol=0)


# -- eta -------------------------------------------------------------------------------------------


def _process(prediction: str = "x0") -> GaussianProcess:
    return GaussianProcess(make_schedule("karras"), prediction, Preconditioning(torch.zeros(1), torch.ones(1)))


@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_every_eta_keeps_the_marginals(eta: float) -> None:
    """With the true x_0, x_s has mean alpha_s x_0 and variance sigma_s^2 (Song et al. 2021, Lemma 1)."""
    process = _process()
    for t, s in ((1000, 800), (800, 420), (420, 419), (30, 1)):
        ones, zeros = torch.ones(1, 1, 1, dtype=torch.float64), torch.zeros(1, 1, 1, dtype=torch.float64)
        mean, std = process.posterior(process.alpha[t] * ones, ones, t, s, eta=eta)
        gain, _ = process.posterior(ones, zeros, t, s, eta=eta)
        variance = float(gain) ** 2 * float(process.sigma[t]) ** 2 + float(std) ** 2
        assert float(mean) == pytest.approx(float(process.alpha[s]), abs=1e-6)
        assert variance == pytest.approx(float(process.sigma[s]) ** 2, rel=1e-4)


def test_the_error_of_the_denoiser_adds_no_noise_to_a_deterministic_chain() -> None:
    process, x = _process(), torch.ones(1, 1, 1)
    stds = [float(process.posterior(x, x, 500, 400, torch.tensor([0.04]), eta)[1]) for eta in (0.0, 0.5, 1.0)]
    plain = [float(process.posterior(x, x, 500, 400, None, eta)[1]) for eta in (0.0, 0.5, 1.0)]
    assert stds[0] == plain[0] == 0.0
    assert stds[2] > plain[2]
    mean, _ = process.posterior(0 * x, x, 500, 400)  # the weight of x_0
    assert stds[2] ** 2 == pytest.approx(plain[2] ** 2 + float(mean) ** 2 * 0.04, rel=1e-5)
    weight, _ = process.posterior(0 * x, x, 500, 400, None, 0.5)
    assert stds[1] ** 2 == pytest.approx(plain[1] ** 2 + 0.25 * float(weight) ** 2 * 0.04, rel=1e-5)


@pytest.mark.parametrize("process", PROCESSES)
def test_deterministic_chains_depend_on_their_start_alone(process: str) -> None:
    prior = tiny_prior(process=process)
    prior.residual = ResidualVariance(
        torch.tensor([1, 1000]), torch.full((2, 20 if process == "continuous" else 12), 0.1)
    )
    table = prior.step_table(5)
    x = prior.initial(2, 34, torch.Generator().manual_seed(0))
    step = prior.transition(x, 1, table, eta=0.0)
    drawn = [step.from_noise(torch.randn(x.shape, generator=torch.Generator().manual_seed(i))) for i in (0, 1)]
    assert torch.equal(drawn[0][..., :POSE], drawn[1][..., :POSE])
    assert step.entries == (0 if process == "continuous" else 33)  # categories stay random
    if process == "continuous":
        assert (step.log_prob(drawn[0]) == 0).all()
    ancestral = prior.sample(2, num_steps=5, seed=3)
    assert torch.equal(ancestral.tensor, prior.sample(2, num_steps=5, seed=3, eta=1.0).tensor)
    assert not torch.equal(ancestral.tensor, prior.sample(2, num_steps=5, seed=3, eta=0.0).tensor)


@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("eta", [-0.1, 1.5, float("nan")])
def test_eta_outside_its_range_is_refused(process: str, eta: float) -> None:
    with pytest.raises(InvalidInputError, match=rf"eta={eta} is outside 0\.\.1"):
        tiny_prior(process=process).sample(1, num_steps=2, eta=eta)


# -- steps outside the schedule --------------------------------------------------------------------


@pytest.mark.parametrize("num_steps", [0, 1001])
@pytest.mark.parametrize("process", PROCESSES)
def test_steps_outside_the_schedule_are_refused_everywhere(process: str, num_steps: int) -> None:
    prior = tiny_prior(process=process)
    scenes = get_grammar("dimsum_table").sample(np.random.default_rng(0), 1)
    calls: list[Callable[[], object]] = [
        lambda: prior.sample(1, num_steps=num_steps),
        lambda: prior.complete(scenes, num_steps=num_steps),
        lambda: prior.rearrange(scenes, num_steps=num_steps),
        lambda: DenoisingPolicy(prior, num_steps),
        lambda: DenoisingCore(1, prior=prior, num_steps=num_steps),
    ]
    for call in calls:
        with pytest.raises(InvalidInputError, match=f"num_steps={num_steps}"):
            call()


@pytest.mark.parametrize("num_steps", [2.5, "50", True])
def test_steps_that_are_no_whole_number_are_refused(num_steps: Any) -> None:
    with pytest.raises(InvalidInputError, match="whole number"):
        StepTable.spaced(1000, num_steps)


@pytest.mark.parametrize("timesteps", [[], [5, 0], [5, 7], [5, 5], [-3]])
def test_timesteps_that_do_not_go_down_to_one_are_refused(timesteps: list[int]) -> None:
    with pytest.raises(InvalidInputError, match="step table"):
        StepTable.from_timesteps(timesteps)


def test_timesteps_above_the_schedule_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"1\.\.1200 are outside 1\.\.1000"):
        StepTable.from_timesteps([1200, 1], 1000)
    with pytest.raises(InvalidInputError, match=r"1001 -> 1 is not a stride down within 0\.\.1000"):
        _process().posterior(torch.zeros(1, 1, 1), torch.zeros(1, 1, 1), 1001, 1)
    for process in PROCESSES:
        prior = tiny_prior(process=process)
        with pytest.raises(InvalidInputError, match=r"1200 -> 1"):
            prior.transition(prior.initial(1, 34), 0, StepTable.from_timesteps([1200, 1]))
