"""The critic of noised scenes: it begins at 0, takes from advantages what it foresees, and learns what can be seen."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch import Generator

from agents.post_training.critic import Critic
from agents.post_training.forward_losses import AWMLoss, NFTLoss
from agents.priors.base import ScenePrior
from agents.priors.testing import tiny_prior


@pytest.fixture(params=["mixed", "continuous"])
def prior(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior("dimsum_table", process=request.param)


def scenes_of(prior: ScenePrior, advantage: torch.Tensor, timestep: int | None = None) -> TensorDict:
    fields = {"scene": prior.encode(prior.sample(len(advantage), num_steps=3, seed=1)), "advantage": advantage}
    if timestep is not None:
        fields["timestep"] = torch.full((len(advantage),), timestep)
    return TensorDict(fields, [len(advantage)])


def gradient(loss: NFTLoss | AWMLoss, scenes: TensorDict) -> torch.Tensor:
    loss.prior.zero_grad()
    loss.generator = Generator().manual_seed(3)
    loss(scenes)["loss_objective"].backward()
    return torch.cat([p.grad.flatten() for p in loss.prior.parameters() if p.grad is not None])


def test_a_new_critic_changes_nothing(prior: ScenePrior) -> None:
    scenes = scenes_of(prior, torch.linspace(-1, 1, 4)[:, None].expand(4, 34).contiguous())
    without, with_one = NFTLoss(prior, prior), NFTLoss(prior, prior, critic=Critic(prior))
    assert torch.equal(gradient(without, scenes), gradient(with_one, scenes))


@pytest.mark.parametrize("kind", [NFTLoss, AWMLoss])
@pytest.mark.parametrize("columns", [1, 34])
def test_what_is_foreseen_exactly_is_not_reinforced(
    prior: ScenePrior, kind: type[NFTLoss] | type[AWMLoss], columns: int
) -> None:
    """Scenes whose advantage is 0.7 everywhere, and a critic that says so."""
    critic = Critic(prior)
    with torch.no_grad():
        critic.read.bias.fill_(0.7)
    loss = kind(prior, prior, critic=critic)
    scenes = scenes_of(prior, torch.full((4, columns), 0.7))
    if columns > 1:  # empty slots have no advantage
        scenes["advantage"] = scenes["advantage"] * prior.decode(scenes["scene"]).is_free
    assert gradient(loss, scenes).abs().max() < 1e-5
    assert float(loss(scenes)["loss_critic"].detach()) == pytest.approx(0.0, abs=1e-9)
    assert float(loss(scenes)["foreseen"]) == pytest.approx(1.0)
    assert gradient(kind(prior, prior), scenes).abs().max() > 1e-3


def test_the_squared_error_without_knowledge_is_the_mean_square(prior: ScenePrior) -> None:
    advantage = torch.where(torch.rand(4, 34, generator=Generator().manual_seed(0)) < 0.5, 0.6, -0.6)
    found = NFTLoss(prior, prior, critic=Critic(prior))(scenes_of(prior, advantage))
    assert float(found["loss_critic"].detach()) == pytest.approx(0.36, rel=1e-5)


def test_it_learns_what_can_be_seen(prior: ScenePrior) -> None:
    """Objects on the right half are good; at little noise that can be seen."""
    scenes = scenes_of(prior, torch.zeros(16, 34), timestep=5)
    batch = prior.decode(scenes["scene"])
    scenes["advantage"] = torch.where(batch.translations[..., 0] > 0, 1.0, -1.0)
    critic = Critic(prior, learning_rate=1e-2)
    loss = NFTLoss(prior, prior, critic=critic, generator=Generator().manual_seed(0))
    before = float(loss(scenes)["foreseen"])
    for _ in range(40):
        loss(scenes)["loss_critic"].backward()
        critic.step()
    assert before == pytest.approx(0.0, abs=1e-6)
    assert float(loss(scenes)["foreseen"]) > 0.5


def test_its_state_survives(prior: ScenePrior) -> None:
    first, second = Critic(prior), Critic(prior)
    noised = prior.noised(prior.encode(prior.sample(2, num_steps=3)), Generator().manual_seed(0))
    for _ in range(2):
        (first(noised) - 1.0).square().mean().backward()
        first.step()
    second.restore(deepcopy(first.state()))
    assert torch.equal(first(noised), second(noised))
    for critic in (first, second):
        (critic(noised) - 1.0).square().mean().backward()
        critic.step()
    assert torch.equal(first(noised), second(noised))
