"""The expectation of own samples: it begins as the sampling policy, ends the drift of bad samples, and is learned."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.post_training.algorithms.forward_process import AWMLoss, Expectation, NFTLoss
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior


@pytest.fixture(params=["mixed", "continuous"])
def prior(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior("dimsum_table", process=request.param)


def scenes_of(prior: ScenePrior, advantage: Tensor) -> TensorDict:
    return TensorDict({"scene": prior.encode(prior.sample(4, num_steps=3, seed=1)), "advantage": advantage}, [4])


def gradient(loss: NFTLoss | AWMLoss, scenes: TensorDict) -> Tensor:
    loss.prior.zero_grad()
    loss.generator = Generator().manual_seed(3)
    loss(scenes)["loss_objective"].backward()
    return torch.cat([p.grad.flatten() for p in loss.prior.parameters() if p.grad is not None])


@pytest.mark.parametrize("kind", [NFTLoss, AWMLoss])
def test_a_new_expectation_is_the_sampling_policy(prior: ScenePrior, kind: type[NFTLoss] | type[AWMLoss]) -> None:
    scenes = scenes_of(prior, torch.linspace(-1, 1, 4)[:, None].expand(4, 34).contiguous())
    without, with_one = kind(prior, prior), kind(prior, prior, expectation=Expectation(prior))
    torch.testing.assert_close(gradient(with_one, scenes), gradient(without, scenes), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", [NFTLoss, AWMLoss])
def test_the_step_is_the_covariance_wherever_the_sampling_policy_stands(
    kind: type[NFTLoss] | type[AWMLoss],
) -> None:
    """Targets +1 and -1 with 0.3 and 0.7, advantages 0.8 and -0.2; o_old is off their mean, -0.4, by anything.

    The gradient at o_old is -2 beta Cov for NFT and -2 Cov for AWM. With o_old as the mean it would hold in addition
    the mean advantage times the error of o_old.
    """
    prior = tiny_prior()
    loss = kind(prior, prior)
    probability, target = torch.tensor([0.3, 0.7]), torch.tensor([1.0, -1.0])
    advantage = torch.tensor([0.8, -0.2])
    covariance = float((probability * advantage * (target + 0.4)).sum())
    for old in (-0.4, 0.5, 3.0):
        output = torch.full((), old, requires_grad=True)
        errors = loss.continuous_loss(output, torch.tensor(old), old + target + 0.4, advantage)
        (probability * errors).sum().backward()
        factor = 2 * (loss.beta if kind is NFTLoss else 1.0)
        assert float(output.grad) == pytest.approx(-factor * covariance, rel=1e-5)


@pytest.mark.slow
def test_bad_samples_alone_do_not_push_once_it_knows_their_mean() -> None:
    """All samples bad, as at little noise around a bad object: the push shrinks by much when the mean is learned."""
    prior = tiny_prior()
    other = deepcopy(prior)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=Generator().manual_seed(0)))
    scenes = scenes_of(prior, torch.full((4, 34), -1.0))
    scenes["timestep"] = torch.full((4,), 40)
    expectation = Expectation(prior, learning_rate=3e-3)
    loss = NFTLoss(other, other, expectation=expectation, generator=Generator().manual_seed(0))
    for _ in range(60):
        loss(scenes)["loss_expectation"].backward()
        expectation.step()
    push = gradient(NFTLoss(other, other), scenes).norm()
    assert gradient(loss, scenes).norm() < 0.5 * push


def test_its_loss_is_the_pretraining_loss_of_poses() -> None:
    """Of a continuous prior, whose pretraining loss has no other part."""
    prior = tiny_prior("dimsum_table", process="continuous")
    scenes = scenes_of(prior, torch.zeros(4, 1))
    expectation = Expectation(prior)
    found = NFTLoss(prior, prior, expectation=expectation, generator=Generator().manual_seed(5))(scenes)
    exact = prior.pretraining_loss(scenes["scene"], Generator().manual_seed(5))
    assert float(found["loss_expectation"].detach()) == pytest.approx(float(exact.detach()), rel=1e-4)


def test_its_state_survives(prior: ScenePrior) -> None:
    first, second = Expectation(prior), Expectation(prior)
    noised = prior.noised(prior.encode(prior.sample(2, num_steps=3)), Generator().manual_seed(0))
    for _ in range(2):
        (first(noised) - 1.0).square().mean().backward()
        first.step()
    second.restore(deepcopy(first.state()))
    for expectation in (first, second):
        (expectation(noised) - 1.0).square().mean().backward()
        expectation.step()
    assert torch.equal(first(noised), second(noised))
