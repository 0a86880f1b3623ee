"""The process of ``examples/flow_matching.py`` against closed forms, and its prior through training and sampling."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import pytest
import torch
from torch import Generator, Tensor
from torch.distributions import Categorical, Normal

from agents import ScenePrior, post_train
from agents.diffusion import GaussianProcess, Preconditioning, StepTable
from agents.diffusion.reverse_steps import state_of
from agents.post_training import DenoisingPolicy
from agents.priors import prior as priors
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from scene_envs.scene import POSE_FEATURES
from tests.helpers.examples import load_example
from tests.helpers.small_runs import small_config

T, MEAN, STD = 1000, 0.3, 0.5
NO_MOMENTS = Preconditioning(torch.zeros(1), torch.ones(1))


@pytest.fixture(scope="module")
def flow() -> Iterator[ModuleType]:
    with patch.dict(priors._CLASSES):
        yield load_example("flow_matching")


@pytest.fixture(scope="module")
def process(flow: ModuleType) -> GaussianProcess:
    return flow.FlowProcess(flow.flow_schedule(T, 0.002, 50.0), NO_MOMENTS)


@pytest.fixture(scope="module")
def prior(flow: ModuleType) -> ScenePrior:
    return flow.FlowPrior.like(tiny_prior("dimsum_table", process="mixed")).eval()


def times(process: GaussianProcess) -> Tensor:
    """(T + 1,) place t of each level on the line."""
    return process.schedule.noise_to_signal / (1 + process.schedule.noise_to_signal)


def velocity(z: Tensor, t: float) -> Tensor:
    """E[eps - x_0 | z_t] of independent x_0 ~ N(MEAN, STD^2): a line in z."""
    variance = (1 - t) ** 2 * STD**2 + t**2
    return -MEAN + (t - (1 - t) * STD**2) / variance * (z - (1 - t) * MEAN)


def step(
    process: GaussianProcess, x: Tensor, t: int, s: int, eta: float, residual: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Mean and deviation of the step t -> s of the exact denoiser."""
    output = velocity(process.network_input(x, t), float(times(process)[t]))
    return process.posterior(x, process.x0_from_output(x, t, output), t, s, residual, eta)


class TestLine:
    def test_levels_are_even_in_t_and_the_ends_are_those_of_the_noise(self, flow: ModuleType) -> None:
        for shift in (1.0, 0.2):
            ratio = flow.flow_schedule(100, 0.002, 20.0, shift).noise_to_signal
            torch.testing.assert_close(ratio[[0, 1, -1]], torch.tensor([0.0, 0.002, 20.0]).double())
            t = ratio / shift / (1 + ratio / shift)
            torch.testing.assert_close(t[1:].diff(), t[1:].diff().mean().expand(99))
        for wrong in ((1, 0.1, 1.0, 1.0), (9, 1.0, 0.1, 1.0), (9, 0.1, 1.0, 0.0)):
            with pytest.raises(InvalidInputError, match="needs two levels or more"):
                flow.flow_schedule(*wrong)

    def test_scenes_go_along_straight_lines_and_the_target_is_their_velocity(self, process: GaussianProcess) -> None:
        x0, noise = torch.randn(2, 5, 34, 12, generator=Generator().manual_seed(0))
        levels = torch.tensor([1, 200, 500, 900, T])
        t = times(process)[levels].float()[:, None, None]
        x_t = process.add_noise(x0, levels, noise)
        z = process.network_input(x_t, levels)
        torch.testing.assert_close(z, (1 - t) * x0 + t * noise, rtol=1e-5, atol=1e-5)
        target = process.target(x0, x_t, levels, noise)
        torch.testing.assert_close(target, noise - x0)
        torch.testing.assert_close(process.x0_from_output(x_t, levels, target), x0, rtol=1e-4, atol=1e-4)

    def test_lognormal_levels_are_logit_normal_in_t(self, flow: ModuleType) -> None:
        prior = flow.FlowPrior.like(tiny_prior("dimsum_table", process="mixed"))
        t, weights = times(prior.process), prior._timestep_weights
        logit, config = (t[1:] / (1 - t[1:])).log(), prior.config
        first, last = (Normal(config.noise_mean, config.noise_std).cdf(logit[end]) for end in (0, -1))
        below = (Normal(config.noise_mean, config.noise_std).cdf(logit) - first) / (last - first)
        torch.testing.assert_close(weights[1:].cumsum(0), below, rtol=0, atol=0.01)


class TestSampler:
    def test_an_euler_step_of_the_velocity_is_the_deterministic_step(self, process: GaussianProcess) -> None:
        x, t, s = torch.randn(64, 3, 2, generator=Generator().manual_seed(1)), 700, 400
        start, end = (float(times(process)[level]) for level in (t, s))
        z = process.network_input(x, t)
        mean, std = step(process, x, t, s, 0.0)
        expected = z + (end - start) * velocity(z, start)
        torch.testing.assert_close(process.network_input(mean, s), expected, rtol=1e-4, atol=1e-5)
        assert float(std) == 0

    def test_the_flow_of_gaussian_data_is_its_closed_form(self, process: GaussianProcess) -> None:
        """dz / dt = v keeps (z - (1 - t) mean) / sqrt((1 - t)^2 std^2 + t^2)."""
        x = torch.randn(64, 3, 2, generator=Generator().manual_seed(2))
        table, t = StepTable.spaced(T, T), float(times(process)[T])
        kept = (process.network_input(x, T) - (1 - t) * MEAN) / math.sqrt((1 - t) ** 2 * STD**2 + t**2)
        for t, s in zip(table.timesteps.tolist(), table.previous.tolist(), strict=True):
            x, _ = step(process, x, t, s, 0.0)
        torch.testing.assert_close(x, MEAN + STD * kept, rtol=0, atol=3e-3)

    @pytest.mark.parametrize(("eta", "num_steps", "tolerance"), [(1.0, 5, 1e-5), (1.0, 50, 1e-5), (0.5, T, 5e-3)])
    def test_stochastic_steps_keep_the_marginals(
        self, process: GaussianProcess, eta: float, num_steps: int, tolerance: float
    ) -> None:
        """Mean and variance of x_t at every level, carried through steps that are linear: those of q(x_t).

        With eta = 1 and the error of the denoiser the reverse step is exact at any length.
        """
        table, ends = StepTable.spaced(T, num_steps), torch.tensor([0.0, 1.0]).view(2, 1, 1)
        alpha, sigma = process.alpha[T], process.sigma[T]
        mean, variance = float(alpha * MEAN), float(alpha**2 * STD**2 + sigma**2)
        for t, s in zip(table.timesteps.tolist(), table.previous.tolist(), strict=True):
            a, b = float(process.alpha[t]), float(process.sigma[t])
            residual = torch.tensor((b * STD) ** 2 / (a**2 * STD**2 + b**2))
            (low, high), std = step(process, ends, t, s, eta, residual)
            gain = float(high - low)
            mean, variance = float(low) + gain * mean, gain**2 * variance + float(std) ** 2
            if s:
                a, b = float(process.alpha[s]), float(process.sigma[s])
                assert mean == pytest.approx(a * MEAN, abs=tolerance)
                assert variance == pytest.approx(a**2 * STD**2 + b**2, abs=tolerance)

    def test_short_steps_are_those_of_flow_grpo(self, process: GaussianProcess) -> None:
        """Liu et al. 2025, Eq. 9: z - dt (v + a^2 / (2 (1 - t)) (z + (1 - t) v)) and a sqrt(dt t / (1 - t))."""
        a, x = 0.7, torch.randn(64, 3, 2, generator=Generator().manual_seed(3))
        for level in (300, 600, 900):
            t, s = (float(times(process)[each]) for each in (level, level - 1))
            factor = float(process.alpha[level - 1] + process.sigma[level - 1])
            z, dt = process.network_input(x, level), t - s
            v = velocity(z, t)
            mean, std = step(process, x, level, level - 1, a / math.sqrt(2))
            drift = v + a**2 / (2 * (1 - t)) * (z + (1 - t) * v)
            moved = process.network_input(mean, level - 1) - z
            torch.testing.assert_close(moved / dt, -drift, rtol=0.02, atol=0.02)
            assert float(std) / factor == pytest.approx(a * math.sqrt(t / (1 - t) * dt), rel=0.01)


class TestPrior:
    def test_log_probabilities_are_those_of_torch(self, prior: ScenePrior) -> None:
        table, generator = prior.step_table(4), Generator().manual_seed(0)
        x_t = prior.initial(3, 34, generator)
        action, log_prob = DenoisingPolicy(prior, 4).draw(x_t, 1, generator=generator)
        reverse: Any = prior.transition(x_t, 1, table)
        poses, free = action[..., :POSE_FEATURES], reverse.pose_std > 0
        normal = Normal(reverse.mean, torch.where(free, reverse.pose_std, 1.0)).log_prob(poses)
        states = Categorical(reverse.probs).log_prob(state_of(action[..., POSE_FEATURES:]))
        expected = (normal * free).sum(dim=-1) + torch.where(reverse.random, states, torch.zeros_like(states))
        torch.testing.assert_close(log_prob, expected, rtol=1e-5, atol=1e-4)

    def test_steps_are_permutation_equivariant(self, prior: ScenePrior) -> None:
        x, table = prior.initial(2, 34, Generator().manual_seed(0)), prior.step_table(4)
        order = torch.cat(
            [torch.zeros(1, dtype=torch.long), 1 + torch.randperm(33, generator=Generator().manual_seed(1))]
        )
        straight, permuted = (prior.transition(scene, 1, table) for scene in (x, x[:, order]))
        torch.testing.assert_close(straight.mean[:, order], permuted.mean, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(straight.probs[:, order], permuted.probs, rtol=1e-4, atol=1e-5)

    def test_other_levels_leave_the_weights(self, flow: ModuleType, prior: ScenePrior) -> None:
        other = flow.FlowPrior.like(prior, shift=0.2)
        assert float(other.process.schedule.noise_to_signal[500]) == pytest.approx(0.2, rel=0.1)
        assert all(torch.equal(value, prior.weights()[name]) for name, value in other.weights().items())

    def test_a_continuous_prior_is_refused(self, flow: ModuleType) -> None:
        with pytest.raises(InvalidInputError, match="made from a mixed prior, not 'continuous'"):
            flow.FlowPrior.like(tiny_prior("dimsum_table"))

    @pytest.mark.usefixtures("few_grammar_scenes", "few_residual_levels")
    def test_it_is_pretrained_saved_loaded_and_trained_further(self, flow: ModuleType, tmp_path: Path) -> None:
        words = [
            "data=grammar", "iterations=2", "batch_size=4", "network.hidden=16", "network.heads=2", "network.depth=1",
            "optimizer.rate.warmup=1", "progress=none",
        ]  # fmt: skip
        assert flow.main(["pretrain", *words, "shift=0.5", f"output={tmp_path / 'run'}"]) == 0
        prior = ScenePrior.load(tmp_path / "run")
        assert isinstance(prior, flow.FlowPrior)
        assert (prior.process_name, prior.config.shift, prior.process.schedule.name) == ("flow", 0.5, "flow")
        assert prior.residual is not None
        assert bool(torch.isfinite(prior.sample(2, num_steps=3, seed=0, eta=0.0).tensor).all())
        further = ["pretrain", *words, f"prior={tmp_path / 'run'}", f"output={tmp_path / 'further'}"]
        assert flow.main(further) == 0
        assert ScenePrior.load(tmp_path / "further").config == prior.config

    @pytest.mark.usefixtures("few_grammar_scenes")
    @pytest.mark.parametrize("algorithm", ["ddpo_sf", "nft"])
    def test_it_is_post_trained(self, flow: ModuleType, prior: ScenePrior, tmp_path: Path, algorithm: str) -> None:
        prior.save(tmp_path / "prior")
        config = small_config(tmp_path / "run", algorithm=algorithm, iterations=2)
        config.prior = str(tmp_path / "prior")
        result = post_train(config)
        trained = ScenePrior.load(tmp_path / "run")
        assert isinstance(trained, flow.FlowPrior)
        assert result.metrics["reward"]["invalid_scenes"] == 0
        changed = [not torch.equal(value, prior.weights()[name]) for name, value in trained.weights().items()]
        assert any(changed)
