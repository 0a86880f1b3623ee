"""Discrete diffusion: rows, composition, posteriors by Bayes' rule, few steps against the whole chain."""

from __future__ import annotations

import pytest
import torch

from agents.diffusion.categorical import (
    CATEGORICAL_KERNELS,
    CategoricalProcess,
    inverted,
    make_categorical_schedule,
)
from agents.diffusion.gaussian import StepTable
from scene_envs.errors import InvalidInputError, UnknownNameError

K, T = 5, 20
KERNELS = sorted(CATEGORICAL_KERNELS)


def _process(name: str, steps: int = T) -> CategoricalProcess:
    return CategoricalProcess(make_categorical_schedule(name, steps), K)


@pytest.mark.parametrize("name", KERNELS)
def test_rows_sum_to_one_and_rates_start_at_the_data(name: str) -> None:
    process = _process(name)
    for start in range(T):
        for end in range(start + 1, T + 1):
            matrix = process.transition(start, end)
            assert float(matrix.min()) >= -1e-12
            torch.testing.assert_close(matrix.sum(dim=1), torch.ones(K + 1, dtype=torch.float64))
    assert process.schedule.keep[0] == 1
    assert process.schedule.mask[0] == 0
    assert bool((process.schedule.keep[1:] < 1).all())


@pytest.mark.parametrize("name", KERNELS)
def test_strides_compose(name: str) -> None:
    process = _process(name)
    for middle in (1, 7, 19):
        composed = process.transition(0, middle) @ process.transition(middle, T)
        torch.testing.assert_close(composed, process.transition(0, T), atol=1e-12, rtol=0)
    single = process.transition(0, 1)
    for t in range(1, T):
        single = single @ process.transition(t, t + 1)
    torch.testing.assert_close(single, process.transition(0, T), atol=1e-12, rtol=0)


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize(("t", "s"), [(20, 13), (13, 5), (5, 4), (2, 1), (1, 0), (20, 0)])
def test_the_posterior_is_bayes_rule(name: str, t: int, s: int) -> None:
    process = _process(name)
    generator = torch.Generator().manual_seed(0)
    p0 = torch.rand(K, generator=generator, dtype=torch.float64)
    p0 /= p0.sum()
    to_s, s_to_t = process.transition(0, s)[:K], process.transition(s, t)
    if s == 0:
        to_s, s_to_t = torch.eye(K, K + 1, dtype=torch.float64), process.transition(0, t)
    for state in range(K + 1):
        likelihood = process.transition(0, t)[:K, state]
        if not (likelihood > 0).any():
            continue
        expected = torch.zeros(K + 1, dtype=torch.float64)
        weights = p0 * (likelihood > 0)
        for x0, weight in enumerate(weights / weights.sum()):
            if weight > 0:
                expected += weight * to_s[x0] * s_to_t[:, state] / likelihood[x0]
        found = process.posterior(torch.tensor([state]), p0[None], t, s)[0]
        torch.testing.assert_close(found, expected, atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", KERNELS)
def test_few_steps_of_the_true_denoiser_reach_the_data_whatever_their_number(name: str) -> None:
    """With one slot and the exact p(x_0 | x_t), the marginal of every chain is the data's distribution."""
    process = _process(name)
    data = torch.tensor([0.4, 0.3, 0.2, 0.1, 0.0], dtype=torch.float64)
    start = data @ process.transition(0, T)[:K]
    for steps in (1, 2, 5, 7, T):
        state = start
        table = StepTable.spaced(T, steps)
        for t, s in zip(table.timesteps.tolist(), table.previous.tolist(), strict=True):
            joint = data[:, None] * process.transition(0, t)[:K]  # (x_0, x_t)
            x0_probs = (joint / joint.sum(dim=0).clamp(min=1e-30)).T  # rows x_t
            step = process.posterior(torch.arange(K + 1), x0_probs, t, s)
            state = state @ step
        torch.testing.assert_close(state[:K], data, atol=1e-9, rtol=0)
        assert float(state[K]) < 1e-9


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize(("t", "s"), [(20, 0), (20, 13), (9, 2), (2, 0)])
def test_one_stride_is_the_composed_chain_of_single_steps(name: str, t: int, s: int) -> None:
    """With the exact p(x_0 | x_t) a stride has, from every state, the distribution of its single steps in a row."""
    process = _process(name)
    data = torch.tensor([0.4, 0.3, 0.2, 0.1, 0.0], dtype=torch.float64)

    def reverse(start: int, end: int) -> torch.Tensor:
        joint = data[:, None] * process.transition(0, start)[:K]  # (x_0, x_t)
        x0_probs = (joint / joint.sum(dim=0).clamp(min=1e-30)).T
        return process.posterior(torch.arange(K + 1), x0_probs, start, end)

    composed = torch.eye(K + 1, dtype=torch.float64)
    for level in range(t, s, -1):
        composed = composed @ reverse(level, level - 1)
    possible = (data @ process.transition(0, t)[:K]) > 1e-12
    torch.testing.assert_close(composed[possible], reverse(t, s)[possible], atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", KERNELS)
def test_the_first_level_of_noise_already_changes_categories(name: str) -> None:
    """Its keep-probability (that of t = 0 where levels count from 0) is below 1, so that the last step has work."""
    schedule = make_categorical_schedule(name, 1000)
    assert 0 < float(schedule.keep[1]) < 1
    assert bool((schedule.keep[1:] <= schedule.keep[:-1]).all())


def test_noise_is_drawn_from_the_marginal() -> None:
    process = _process("mask_and_replace", 100)
    x0 = torch.full((40_000,), 2)
    t = torch.full((40_000,), 50)
    uniform = torch.rand(40_000, generator=torch.Generator().manual_seed(0))
    drawn = inverted(process.marginal(x0, t).cumsum(-1), uniform).bincount(minlength=K + 1) / 40_000
    expected = process.marginal(x0[:1], t[:1])[0]
    torch.testing.assert_close(drawn, expected, atol=0.01, rtol=0)
    torch.testing.assert_close(expected.double(), process.transition(0, 50)[2], atol=1e-6, rtol=0)


def test_sampling_follows_probabilities_and_never_draws_impossible_ones() -> None:
    probs = torch.tensor([0.0, 0.25, 0.0, 0.75, 0.0]).expand(8000, 5)
    uniform = torch.rand(8000, generator=torch.Generator().manual_seed(1))
    counts = inverted(probs.cumsum(-1), uniform).bincount(minlength=5)
    assert counts[[0, 2, 4]].sum() == 0
    assert float(counts[1]) / 8000 == pytest.approx(0.25, abs=0.02)


@pytest.mark.parametrize("name", KERNELS)
def test_the_loss_is_smallest_at_the_truth_and_gradients_are_finite(name: str) -> None:
    process = _process(name)
    generator = torch.Generator().manual_seed(0)
    x0 = torch.randint(K, (16, 3), generator=generator)
    t = torch.arange(1, 17)
    x_t = inverted(process.marginal(x0, t).cumsum(-1), torch.rand(16, 3, generator=generator))
    logits = torch.zeros(16, 3, K, requires_grad=True)
    loss = process.loss(x0, x_t, t, logits)
    loss.sum().backward()
    assert logits.grad is not None
    assert bool(torch.isfinite(logits.grad).all())
    sure = 50.0 * torch.nn.functional.one_hot(x0, K).float()
    assert float(process.loss(x0, x_t, t, sure).abs().max()) < 1e-5
    assert float(loss.detach().min()) >= 0
    first = process.loss(x0[:1], x_t[:1], t[:1], logits[:1], auxiliary=0.0)
    torch.testing.assert_close(first, torch.full((1, 3), K).float().log())  # -log p(x_0) at t = 1


def test_unknown_kernels_and_too_few_levels_are_refused() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'early_absorbing'"):
        make_categorical_schedule("early_absorbin")
    with pytest.raises(InvalidInputError, match="at least 2"):
        make_categorical_schedule("early_absorbing", 1)


@pytest.mark.parametrize("kernel", ["early_absorbing", "mask_and_replace"])
def test_the_tables_of_a_stride_give_the_posterior_of_every_state(kernel: str) -> None:
    """A timestep of all scenes reads tables, one for each scene computes anew: the bits are the same."""
    process = CategoricalProcess(make_categorical_schedule(kernel, 50), 4)
    states, probs = torch.arange(5).repeat(3, 1), torch.rand(3, 5, 4, generator=torch.Generator().manual_seed(0))
    for _ in range(2):  # made, then kept
        for t, previous in ((50, 40), (7, 3), (3, 0)):
            own = process.posterior(states, probs, torch.full((3,), t), torch.full((3,), previous))
            assert torch.equal(process.posterior(states, probs, t, previous), own)
