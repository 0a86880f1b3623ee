"""The policy gradient against closed forms and against torch.distributions."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Normal

from agents.diffusion.reverse_steps import gaussian_log_prob
from agents.post_training import DDPOSFLoss, DenoisingPolicy
from agents.post_training.policy import gradient_weights
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from tests.helpers.toy_chain import LinearChain

THETA, SIGMAS, START = 0.8, (0.5, 0.3), 1.5


def draw_chain(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """x_2, x_1, x_0 of the stochastic steps of the linear chain, (count,) each."""
    generator = torch.Generator().manual_seed(seed)
    x2 = torch.full((count,), START, dtype=torch.float64)
    x1 = THETA * x2 + SIGMAS[0] * torch.randn(count, generator=generator, dtype=torch.float64)
    x0 = THETA * x1 + SIGMAS[1] * torch.randn(count, generator=generator, dtype=torch.float64)
    return x2, x1, x0


def transitions(x: torch.Tensor, timestep: int, action: torch.Tensor, advantage: torch.Tensor) -> TensorDict:
    count = x.shape[0]
    return TensorDict(
        {
            "scene": x.reshape(count, 1, 1),
            "timestep": torch.full((count, 1), timestep),
            "action": action.reshape(count, 1, 1),
            "advantage": advantage,
        },
        [count],
    )


def policy_gradient(count: int = 6) -> tuple[float, float]:
    """Gradient of the loss over both stochastic steps of the chain: ours, and the closed form of the same draws."""
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, x0 = draw_chain(count)
    advantage = torch.linspace(-1, 2, count, dtype=torch.float64)
    for timestep, state, action in ((3, x2, x1), (2, x1, x0)):
        loss(transitions(state, timestep, action, advantage))["loss_objective"].backward()
    score = (x1 - THETA * x2) * x2 / SIGMAS[0] ** 2 + (x0 - THETA * x1) * x1 / SIGMAS[1] ** 2
    return float(chain.theta.grad), float(-(advantage * score).mean())


def test_gradient_is_the_score_function_of_every_sample() -> None:
    ours, closed_form = policy_gradient()
    assert ours == pytest.approx(closed_form, rel=1e-12)


def test_mean_gradient_is_that_of_the_expected_reward() -> None:
    # reward x_0 of two steps: E x_0 = theta^2 x_2, so d E / d theta = 2 theta x_2
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, x0 = draw_chain(400_000)
    advantage = x0 - THETA**2 * START
    for timestep, state, action in ((3, x2, x1), (2, x1, x0)):
        loss(transitions(state, timestep, action, advantage))["loss_objective"].backward()
    score = (x1 - THETA * x2) * x2 / SIGMAS[0] ** 2 + (x0 - THETA * x1) * x1 / SIGMAS[1] ** 2
    standard_error = float((advantage * score).std() / len(score) ** 0.5)
    assert -float(chain.theta.grad) == pytest.approx(2 * THETA * START, abs=4 * standard_error)
    assert standard_error < 0.02


def test_gradient_differs_when_states_are_not_detached() -> None:
    chain = LinearChain(THETA, SIGMAS)
    x2, x1, x0 = draw_chain(6)
    advantage = torch.linspace(-1, 2, 6, dtype=torch.float64)
    noise = (x1 - THETA * x2) / SIGMAS[0]
    attached = chain.theta * x2 + SIGMAS[0] * noise  # the same values, with their history
    first = Normal(chain.theta * x2, SIGMAS[0]).log_prob(attached)
    second = Normal(chain.theta * attached, SIGMAS[1]).log_prob(x0)
    (-(advantage * (first + second)).mean()).backward()
    _, closed_form = policy_gradient()
    assert abs(float(chain.theta.grad) - closed_form) > 0.1 * abs(closed_form)

    ours = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(ours, 3))
    attached = ours.theta * x2 + SIGMAS[0] * noise
    for timestep, state, action in ((3, x2, attached), (2, attached, x0)):
        loss(transitions(state, timestep, action, advantage))["loss_objective"].backward()
    assert float(ours.theta.grad) == pytest.approx(closed_form, rel=1e-12)


def test_rows_at_different_steps_in_one_batch() -> None:
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, x0 = draw_chain(6)
    advantage = torch.linspace(-1, 2, 6, dtype=torch.float64)
    both = torch.cat([transitions(x2, 3, x1, advantage), transitions(x1, 2, x0, advantage)])
    (2 * loss(both)["loss_objective"]).backward()
    assert float(chain.theta.grad) == pytest.approx(policy_gradient()[1], rel=1e-12)


def test_deterministic_last_step_has_no_gradient() -> None:
    chain = LinearChain(THETA, SIGMAS)
    x = torch.ones(4, dtype=torch.float64)
    result = DDPOSFLoss(DenoisingPolicy(chain, 3))(transitions(x, 1, x, x))
    assert result["loss_objective"].item() == 0.0
    result["loss_objective"].backward()
    assert float(chain.theta.grad) == 0.0


def test_invalid_rows_leave_the_mean() -> None:
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, _ = draw_chain(4)
    advantage = torch.tensor([1.0, -1.0, 2.0, 7.0], dtype=torch.float64)
    batch = transitions(x2, 3, x1, advantage)
    batch["valid"] = torch.tensor([True, True, True, False])
    expected = loss(batch[:3].exclude("valid"))["loss_objective"]
    assert loss(batch)["loss_objective"].item() == pytest.approx(expected.item(), rel=1e-12)


def test_log_prob_agrees_with_torch_distributions_and_skips_certain_entries() -> None:
    generator = torch.Generator().manual_seed(0)
    x, mean = torch.randn(3, 4, 5, generator=generator), torch.randn(3, 4, 5, generator=generator)
    std = torch.rand(4, 5, generator=generator) + 0.1
    std[1] = 0.0
    std[:, 2] = 0.0
    random = std > 0
    expected = torch.where(random, Normal(mean, std.clamp(min=1e-3)).log_prob(x), 0.0).sum(dim=-1)
    torch.testing.assert_close(gaussian_log_prob(x, mean, std), expected)


def test_mean_reduction_divides_by_the_random_entries() -> None:
    prior = tiny_prior()
    policy = DenoisingPolicy(prior, 4)
    scene = prior.initial(3, 34, torch.Generator().manual_seed(0))
    action, _ = policy.draw(scene, 0, torch.Generator().manual_seed(1))
    batch = TensorDict(
        {
            "scene": scene,
            "timestep": policy.table.timesteps[:1].expand(3, 1),
            "action": action,
            "advantage": torch.tensor([1.0, 2.0, -1.0]),
        },
        [3],
    )
    # 33 free slots; the tiny prior's z-column rotations are constant: 5 of 20 features
    assert policy.random_entries(34) == 33 * int((~prior.normalizer.is_constant).sum())
    total = DDPOSFLoss(policy, reduction="sum")(batch)["loss_objective"]
    mean = DDPOSFLoss(policy, reduction="mean")(batch)["loss_objective"]
    assert total.item() == pytest.approx(mean.item() * policy.random_entries(34), rel=1e-5)


def test_credit_per_slot_with_equal_values_is_credit_per_scene() -> None:
    prior = tiny_prior()
    policy = DenoisingPolicy(prior, 4)
    scene = prior.initial(3, 34, torch.Generator().manual_seed(0))
    action, _ = policy.draw(scene, 1, torch.Generator().manual_seed(1))
    advantage = torch.tensor([1.0, 2.0, -1.0])
    fields = {"scene": scene, "timestep": policy.table.timesteps[1].expand(3, 1), "action": action}
    per_scene = TensorDict({**fields, "advantage": advantage}, [3])
    per_slot = TensorDict({**fields, "advantage": advantage[:, None].expand(3, 34)}, [3])
    loss = DDPOSFLoss(policy)
    assert loss(per_scene)["loss_objective"].item() == pytest.approx(loss(per_slot)["loss_objective"].item(), rel=1e-5)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
def test_clipped_objective_before_the_first_update_has_the_score_function_gradient(reduction: str) -> None:
    gradients = []
    for clip in (None, 0.2):
        prior = tiny_prior()
        policy = DenoisingPolicy(prior, 4)
        scene = prior.initial(3, 34, torch.Generator().manual_seed(0))
        action, log_prob = policy.draw(scene, 1, torch.Generator().manual_seed(1))
        fields = {"scene": scene, "timestep": policy.table.timesteps[1].expand(3, 1), "action": action}
        batch = TensorDict({**fields, "advantage": torch.tensor([1.0, 2.0, -1.0]), "slot_log_prob": log_prob}, [3])
        result = DDPOSFLoss(policy, reduction=reduction, clip_epsilon=clip)(batch)
        result["loss_objective"].backward()
        assert float(result["log_ratio"]) == 0.0
        gradients.append(torch.cat([p.grad.flatten() for p in prior.parameters() if p.grad is not None]))
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-5, atol=1e-6)


def test_clip_stops_the_gradient_of_rows_that_have_moved_far_enough() -> None:
    chain = LinearChain(THETA, SIGMAS)
    x2, x1, _ = draw_chain(1)
    batch = transitions(x2, 3, x1, torch.ones(1, dtype=torch.float64))
    now = Normal(THETA * x2, SIGMAS[0]).log_prob(x1)
    batch["slot_log_prob"] = (now - 1.0).reshape(1, 1)  # the ratio is e: beyond 1.2 with a positive advantage
    result = DDPOSFLoss(DenoisingPolicy(chain, 3), clip_epsilon=0.2)(batch)
    assert result["loss_objective"].item() == pytest.approx(-1.2)
    result["loss_objective"].backward()
    assert float(chain.theta.grad) == 0.0
    assert float(result["clip_fraction"]) == 1.0


def test_keys_can_be_renamed() -> None:
    chain = LinearChain(THETA, SIGMAS)
    loss = DDPOSFLoss(DenoisingPolicy(chain, 3))
    x2, x1, _ = draw_chain(2)
    batch = transitions(x2, 3, x1, torch.ones(2, dtype=torch.float64))
    expected = loss(batch)["loss_objective"].item()
    loss.set_keys(advantage="credit")
    assert loss(batch.rename_key_("advantage", "credit"))["loss_objective"].item() == expected


def test_weights_exclude_steps_below_the_floor_and_have_mean_one() -> None:
    stds = torch.tensor([0.6, 0.4, 0.2, 0.005, 0.0])
    for weighting in ("uniform", "std", "variance"):
        weights = gradient_weights(stds, min_std=1e-2, weighting=weighting)
        assert weights[3:].tolist() == [0.0, 0.0]
        assert float(weights[:3].mean()) == pytest.approx(1.0)
    weights = gradient_weights(stds, weighting="variance")
    assert float(weights[0] / weights[1]) == pytest.approx(2.25)
    assert gradient_weights(stds, skip_first=0.4).tolist() == [0.0, 0.0, 1.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [({"reduction": "median"}, "median"), ({"clip_epsilon": 2.0}, "2.0"), ({"step_weights": torch.ones(2)}, "3 steps")],
)
def test_wrong_settings_are_named(kwargs: dict, named: str) -> None:
    with pytest.raises(InvalidInputError, match=named):
        DDPOSFLoss(DenoisingPolicy(LinearChain(THETA, SIGMAS), 3), **kwargs)


def test_timestep_of_another_chain_is_refused() -> None:
    x = torch.ones(1, dtype=torch.float64)
    with pytest.raises(InvalidInputError, match="num_steps"):
        DDPOSFLoss(DenoisingPolicy(LinearChain(THETA, SIGMAS), 3))(transitions(x, 17, x, x))
