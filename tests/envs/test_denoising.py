"""The core MDP: transitions, clamping, the reward's timing, and the distribution of the noise mode."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rewards.base import RewardOutput
from scene_envs.envs import DenoisingCore, ResetNeededError
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.scene import SceneBatch


def generators(count, seed=0):
    return [np.random.default_rng(seed + i) for i in range(count)]


def make(prior, reward, count=3, **kwargs):
    return DenoisingCore(count, prior=prior, reward=reward, **{"num_steps": 4, **kwargs})


def test_next_sample_transition_is_the_identity_outside_known_entries(prior, height):
    core = make(prior, height)
    core.reset(generators(3))
    action = torch.randn(3, 34, 20, generator=torch.Generator().manual_seed(1))
    core.step(action)
    assert torch.equal(core.x[:, 1:], action[:, 1:])
    table = prior.normalizer.normalize(SceneBatch.empty("dimsum_table", 3, 1).tensor)
    assert torch.equal(core.x[:, :1], table)
    assert prior.calls == 0  # the posterior belongs to the policy


def test_reward_comes_at_the_last_step_only_and_is_the_rewards_value(prior, height):
    core = make(prior, height)
    core.reset(generators(3))
    height.scored = 0
    for step in range(4):
        result = core.step(torch.full((3, 34, 20), 0.1 * step))
        last = step == 3
        assert result.terminated.tolist() == [last] * 3
        if not last:
            assert result.reward.tolist() == [0.0] * 3
    assert height.scored == 3  # one evaluation per episode
    expected = core.scenes().translations[..., 2].mean(dim=1)
    assert torch.equal(result.reward, expected)
    assert torch.equal(result.terms["height"], expected)


def test_timesteps_walk_the_step_table_down_to_zero(prior, height):
    core = make(prior, height, count=1)
    core.reset(generators(1))
    seen = [int(core.timesteps[0])]
    for _ in range(4):
        core.step(torch.zeros(1, 34, 20))
        seen.append(int(core.timesteps[0]))
    assert seen == [*prior.step_table(4).timesteps.tolist(), 0]


def test_noise_mode_equals_the_bare_sampling_loop(prior, height):
    core = make(prior, height, action_mode="noise")
    core.reset(generators(3))
    x, table = core.x, prior.step_table(4)
    draw = torch.Generator().manual_seed(5)
    for step in range(4):
        noise = torch.randn(x.shape, generator=draw)
        mean, std = prior.posterior(x, step, table)
        x = prior.clamp(mean + std * noise)
        core.step(noise)
        assert torch.equal(core.x, x)


def test_noise_mode_with_normal_actions_has_the_priors_distribution(prior, height):
    """The toy chain is linear, so mean and variance of x_0 follow from a recursion over its steps."""
    count, steps = 64, 10
    core = make(prior, height, count=count, num_steps=steps, action_mode="noise")
    draw = torch.Generator().manual_seed(0)
    core.reset(generators(count))
    for _ in range(steps):
        core.step(torch.randn(core.x.shape, generator=draw))
    mean, variance = 0.0, 1.0
    for step in range(steps):
        a, b, std = prior.linear_step(step, core.table)
        mean, variance = a * mean + b, a * a * variance + std * std
    free = core.x[:, 1:].double()
    samples = free.numel()
    assert abs(float(free.mean()) - mean) < 5 * (variance / samples) ** 0.5
    assert abs(float(free.var()) / variance - 1) < 5 * (2 / samples) ** 0.5


def test_start_depends_on_the_generator_and_not_on_the_batch(prior, height):
    large, small = make(prior, height, count=5), make(prior, height, count=2)
    large.reset(generators(5))
    small.reset(generators(2))
    assert torch.equal(large.x[:2], small.x)
    assert not torch.equal(large.x[0], large.x[1])


def test_actions_are_clipped_at_the_bound(prior, height):
    core = make(prior, height, max_action=0.5)
    core.reset(generators(3))
    core.step(torch.full((3, 34, 20), 7.0))
    assert torch.equal(core.x[:, 1:], torch.full((3, 33, 20), 0.5))


def test_extra_slots_are_allowed(prior, height):
    core = make(prior, height, slots=40)
    core.reset(generators(3))
    assert core.step(torch.zeros(3, 40, 20)).reward.shape == (3,)


def test_invalid_rows_get_reward_zero_and_are_flagged(prior, picky_height):
    core = make(prior, picky_height, num_steps=1)
    core.reset(generators(3))
    action = torch.full((3, 34, 20), -1.0)
    action[..., 2] = 0.5  # above the middle of the workspace
    action[..., 13] = 1.0  # plates everywhere ...
    action[1, 1, 19] = 2.0  # ... but in slot 1 of environment 1
    result = core.step(action)
    assert result.valid.tolist() == [True, False, True]
    assert result.reward[1] == 0.0
    assert (result.reward[[0, 2]] > 0).all()
    assert core.info(result)["reward_valid"].tolist() == [1, 0, 1]


def test_a_reward_that_raises_gives_invalid_rows(prior):
    def broken(batch, context):
        raise RuntimeError("no luck today")

    core = make(prior, broken, num_steps=1)
    core.reset(generators(3))
    result = core.step(torch.zeros(3, 34, 20))
    assert result.valid.tolist() == [False] * 3
    assert result.reward.tolist() == [0.0] * 3
    assert result.terminated.all()


def test_a_reward_that_is_not_finite_is_invalid(prior):
    def nan_for_all(batch, context):
        return RewardOutput(torch.full((len(batch),), float("nan")))

    core = make(prior, nan_for_all, num_steps=1)
    core.reset(generators(3))
    result = core.step(torch.zeros(3, 34, 20))
    assert not result.valid.any()
    assert result.reward.tolist() == [0.0] * 3


def test_episodes_at_different_steps_do_not_mix(prior, height):
    """Staggered episodes give, row by row, what each would give alone."""
    core = make(prior, height, count=2, action_mode="noise")
    core.reset(generators(2))
    action = torch.full((2, 34, 20), 0.3)
    core.step(action, np.array([True, False]))
    assert core.steps.tolist() == [1, 0]
    core.step(action)
    alone = make(prior, height, count=1, action_mode="noise")
    for row, taken in enumerate((2, 1)):
        alone.reset(generators(1, seed=row))
        for _ in range(taken):
            alone.step(action[:1])
        torch.testing.assert_close(core.x[row], alone.x[0])


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_an_action_that_is_not_finite_is_named(prior, height, bad):
    core = make(prior, height)
    core.reset(generators(3))
    action = torch.zeros(3, 34, 20)
    action[1, 4, 7] = bad
    before = core.x
    with pytest.raises(InvalidInputError, match=r"(nan|inf) at environment 1, slot 4, feature 7.*finite"):
        core.step(action)
    assert core.x is before  # nothing happened
    core.step(torch.zeros(3, 34, 20))


def test_an_action_of_the_wrong_shape_is_named(prior, height):
    core = make(prior, height)
    core.reset(generators(3))
    with pytest.raises(InvalidInputError, match=r"\(3, 34, 19\).*must be \(3, 34, 20\)"):
        core.step(torch.zeros(3, 34, 19))


def test_stepping_without_or_beyond_an_episode_needs_a_reset(prior, height):
    core = make(prior, height, num_steps=1)
    with pytest.raises(ResetNeededError, match="never reset"):
        core.step(torch.zeros(3, 34, 20))
    core.reset(generators(3))
    core.step(torch.zeros(3, 34, 20))
    with pytest.raises(ResetNeededError, match="ended after its 1 steps"):
        core.step(torch.zeros(3, 34, 20))


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"scene": "dimsum_tabel"}, UnknownNameError, "did you mean 'dimsum_table'"),
        ({"action_mode": "nois"}, UnknownNameError, "did you mean 'noise'"),
        ({"num_steps": 0}, InvalidInputError, "num_steps=0"),
        ({"num_steps": 2.5}, InvalidInputError, "num_steps=2.5"),
        ({"num_steps": 1000}, InvalidInputError, "num_steps=1000"),
        ({"slots": 1}, InvalidInputError, "at least 2 slots"),
        ({"max_action": 0.0}, InvalidInputError, "max_action"),
        ({"max_action": float("nan")}, InvalidInputError, "max_action"),
        ({"workers": -1}, InvalidInputError, "workers=-1"),
        ({"prior": 3}, InvalidInputError, "prior=3"),
    ],
)
def test_bad_arguments_are_named(prior, height, kwargs, error, message):
    with pytest.raises(error, match=message):
        make(kwargs.pop("prior", prior), height, **kwargs)


def test_an_unknown_reward_offers_the_nearest_name(prior):
    with pytest.raises(UnknownNameError, match="did you mean 'object_count'"):
        make(prior, "object_cuont")
