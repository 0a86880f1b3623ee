"""Reverse steps: noise gives the distribution whose log-probability they state."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from scipy.stats import chisquare, kstest
from torch.distributions import Categorical, Normal

from agents.diffusion import GaussianStep, MixedStep
from agents.diffusion.categorical import systematic
from agents.diffusion.reverse_steps import concatenate_steps, one_hot_state, state_of


def _mixed(batch: int = 1, slots: int = 2) -> MixedStep:
    generator = torch.Generator().manual_seed(0)
    probs = torch.rand(batch, slots, 4, generator=generator).softmax(dim=-1)
    mean = torch.randn(batch, slots, 3, generator=generator)
    return MixedStep(mean, torch.rand(slots, 3, generator=generator) + 0.1, probs, torch.ones(slots, dtype=torch.bool))


def test_normal_noise_draws_the_stated_distribution() -> None:
    step = _mixed()
    wide = step._replace(mean=step.mean.expand(20_000, -1, -1), probs=step.probs.expand(20_000, -1, -1))
    x = wide.from_noise(torch.randn(20_000, 2, 6, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(x[..., :3].mean(dim=0), step.mean[0], atol=0.03, rtol=0)
    torch.testing.assert_close(x[..., :3].std(dim=0), step.pose_std, atol=0.02, rtol=0.02)
    shares = torch.stack([(state_of(x[..., 3:]) == state).float().mean(dim=0) for state in range(4)], dim=-1)
    torch.testing.assert_close(shares, step.probs[0], atol=0.015, rtol=0)


def test_log_probabilities_are_those_of_torch_distributions() -> None:
    step = _mixed(5)
    x = step.from_noise(torch.randn(5, 2, 6, generator=torch.Generator().manual_seed(2)))
    expected = Normal(step.mean, step.pose_std).log_prob(x[..., :3]).sum(-1)
    expected = expected + Categorical(step.probs).log_prob(state_of(x[..., 3:]))
    torch.testing.assert_close(step.log_prob(x), expected)
    assert step.entries == 2 * 3 + 2
    assert step.std.shape == (2, 6)


def test_certain_states_take_the_likeliest_and_carry_no_probability() -> None:
    step = _mixed(3)._replace(pose_std=torch.zeros(2, 3), random=torch.zeros(2, dtype=torch.bool))
    x = step.from_noise(torch.randn(3, 2, 6))
    assert (state_of(x[..., 3:]) == step.probs.argmax(dim=-1)).all()
    assert (step.log_prob(x) == 0).all()
    assert step.entries == 0


def test_the_mask_token_is_all_zeros_and_comes_back() -> None:
    states = torch.tensor([[0, 3], [2, 1]])
    one_hot = one_hot_state(states, torch.zeros(2, 2, 4))
    assert one_hot[0, 1].tolist() == [0.0, 0.0, 0.0]
    assert (state_of(one_hot) == states).all()


def _masked(chance: float, batch: int = 1) -> MixedStep:
    """Four masked slots among five, of three categories each; the third slot is seen. All scenes are alike."""
    chosen = torch.rand(1, 5, 3, generator=torch.Generator().manual_seed(0)).softmax(dim=-1)
    probs = torch.cat([chance * chosen, torch.full((1, 5, 1), 1 - chance)], dim=-1)
    probs[:, 2] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    masked = torch.tensor([[True, True, False, True, True]]).expand(batch, -1)
    random = torch.ones(5, dtype=torch.bool)
    return MixedStep(torch.zeros(batch, 5, 1), torch.zeros(5, 1), probs.expand(batch, -1, -1), random, masked)


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("chance", [0.1, 0.3, 0.5, 0.9])
def test_slots_unmasked_together_are_as_many_as_expected(chance: float, grouped: bool) -> None:
    step = _masked(chance, 40_000)
    if grouped:
        step = step._replace(groups=torch.tensor([[2, 5, 2]]).expand(40_000, -1))
    state = state_of(step.from_noise(torch.randn(40_000, 5, 4, generator=torch.Generator().manual_seed(1)))[..., 1:])
    number = (state[:, [0, 1, 3, 4]] < 3).sum(dim=1)
    assert set(number.unique().tolist()) <= {int(4 * chance), int(4 * chance) + 1}
    assert (state[:, 2] == 1).all()
    shares = torch.stack([(state == value).float().mean(dim=0) for value in range(4)], dim=-1)
    torch.testing.assert_close(shares, step.probs[0], atol=0.012, rtol=0)  # each slot as if it were alone


@pytest.mark.parametrize("chance", [0.1, 0.3, 0.5, 0.9])
def test_the_probabilities_of_all_outcomes_of_unmasking_sum_to_one(chance: float) -> None:
    states = torch.tensor(list(product(range(4), range(4), [1], range(4), range(4))))
    step = _masked(chance, len(states))
    x = torch.cat([torch.zeros(len(states), 5, 1), one_hot_state(states, step.probs)], dim=-1)
    probability = step.log_prob(x).double().sum(dim=1).exp()
    assert float(probability.sum()) == pytest.approx(1.0, abs=1e-5)
    number = (states[:, [0, 1, 3, 4]] < 3).sum(dim=1)
    of_number = torch.stack([probability[number == value].sum() for value in range(5)])
    assert float((of_number * torch.arange(5)).sum()) == pytest.approx(4 * chance, abs=1e-5)


@pytest.mark.parametrize("slots", [1, 2, 7, 40])
def test_systematic_numbers_are_uniform_and_a_step_apart(slots: int) -> None:
    uniform = torch.rand(20_000, slots + 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    unmasked = torch.ones(20_000, slots + 2, dtype=torch.bool)
    unmasked[:, [0, slots]] = False
    spread = systematic(unmasked, uniform)
    assert torch.equal(spread[~unmasked], uniform[~unmasked])
    numbers = spread[unmasked].view(20_000, slots)
    expected = torch.full((20_000, slots - 1), 1 / slots, dtype=torch.float64)
    torch.testing.assert_close(numbers.sort(dim=1).values.diff(), expected)
    for slot in range(slots):
        assert kstest(numbers[:, slot], "uniform").pvalue > 1e-4
    if slots > 1:  # two slots take every pair of different ranks equally often
        ranks = (numbers[:, :2] * slots).long()
        pairs = torch.bincount(ranks[:, 0] * slots + ranks[:, 1], minlength=slots**2).view(slots, slots)
        assert not pairs.diagonal().any()
        assert chisquare(pairs[~torch.eye(slots, dtype=torch.bool)]).pvalue > 1e-4


def test_systematic_sampling_gives_each_group_its_expected_number() -> None:
    """Thirty masked slots with probabilities 0.1, 0.25, 0.05 and 0.6; the second and the third are one group."""
    chosen, groups = torch.tensor([0.1, 0.25, 0.05, 0.6]), torch.tensor([7, 1, 1, 0])
    probs = torch.cat([chosen, torch.zeros(1)]).expand(500, 30, 5)
    masked, random = torch.ones(500, 30, dtype=torch.bool), torch.ones(30, dtype=torch.bool)
    alone = MixedStep(torch.zeros(500, 30, 1), torch.zeros(30, 1), probs, random, masked)
    step = alone._replace(groups=groups.expand(500, -1))
    noise = torch.randn(500, 30, 5, generator=torch.Generator().manual_seed(0))
    state = state_of(step.from_noise(noise)[..., 1:])
    numbers = torch.stack([(state == value).sum(dim=1) for value in range(4)], dim=-1)
    assert numbers[:, 0].eq(3).all()
    assert numbers[:, 1:3].sum(dim=1).eq(9).all()
    assert numbers[:, 3].eq(18).all()
    spread = (9 * (5 / 6) * (1 / 6)) ** 0.5  # within the group slots draw independently
    assert float(numbers[:, 1].float().std()) == pytest.approx(spread, rel=0.1)
    torch.testing.assert_close(numbers.float().mean(dim=0), 30 * chosen, atol=0.2, rtol=0)
    assert torch.equal(step.independent().from_noise(noise), alone.from_noise(noise))


def test_steps_of_parts_are_the_step_of_the_whole() -> None:
    whole = _mixed(5)
    parts = [MixedStep(whole.mean[a:b], whole.pose_std, whole.probs[a:b], whole.random) for a, b in ((0, 2), (2, 5))]
    together = concatenate_steps(parts)
    noise = torch.randn(5, 2, 6)
    assert (together.from_noise(noise) == whole.from_noise(noise)).all()
    masked = _masked(0.5, 4)._replace(groups=torch.arange(3).expand(4, -1))
    noise = torch.randn(4, 5, 4)
    together = concatenate_steps(
        [
            masked._replace(**{name: getattr(masked, name)[rows] for name in ("mean", "probs", "masked", "groups")})
            for rows in (slice(2), slice(2, 4))
        ]
    )
    assert (together.from_noise(noise) == masked.from_noise(noise)).all()
    noise = torch.randn(5, 2, 6)
    gaussian = GaussianStep(torch.randn(4, 2, 3), torch.rand(2, 3))
    halves = [GaussianStep(gaussian.mean[:2], gaussian.std), GaussianStep(gaussian.mean[2:], gaussian.std)]
    assert (concatenate_steps(halves).from_noise(noise[:4, :, :3]) == gaussian.from_noise(noise[:4, :, :3])).all()
