"""Weights of the training loss against published formulas, and the distribution of its timesteps."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.diffusion import GaussianProcess, Preconditioning
from agents.diffusion.gaussian import check_weighting, loss_weights, make_schedule
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar


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
