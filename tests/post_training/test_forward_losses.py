"""Forward-process losses against closed forms, and against each other in the limit that they share."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.post_training.algorithms.forward_process import AWMLoss, ForwardProcessLoss, NFTLoss
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError


@pytest.fixture(scope="module", params=["mixed", "continuous"])
def prior(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior("dimsum_table", process=request.param)


def minimum(loss, start: Tensor, steps: int = 400) -> Tensor:
    """The argument that minimises ``loss``, by L-BFGS."""
    x = start.clone().requires_grad_()
    optimizer = torch.optim.LBFGS(
        [x], max_iter=steps, tolerance_grad=1e-12, tolerance_change=1e-14, line_search_fn="strong_wolfe"
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss(x)
        value.backward()
        return value

    optimizer.step(closure)
    return x.detach()


class TestGaussianMixture:
    """One x_t whose clean scene is +1 with probability 0.3 and -1 with 0.7; o_old is its posterior mean, -0.4."""

    probability = torch.tensor([0.3, 0.7], dtype=torch.float64)
    target = torch.tensor([1.0, -1.0], dtype=torch.float64)
    old = torch.tensor(-0.4, dtype=torch.float64)
    advantage = torch.tensor([0.8, -0.2], dtype=torch.float64)

    def expected(self, loss: ForwardProcessLoss):
        return lambda o: (self.probability * loss.continuous_loss(o, self.old, self.target, self.advantage)).sum()

    @pytest.mark.parametrize("beta", [0.3, 1.0])
    def test_nft_moves_by_the_covariance_of_advantage_and_target_over_beta(
        self, prior: ScenePrior, beta: float
    ) -> None:
        found = minimum(self.expected(NFTLoss(prior, prior, beta=beta)), self.old)
        step = (self.probability * self.advantage * (self.target - self.old)).sum() / beta
        assert found == pytest.approx(float(self.old + step), abs=1e-9)

    def test_awm_is_the_weighted_mean_of_targets_and_the_old_output(self, prior: ScenePrior) -> None:
        found = minimum(self.expected(AWMLoss(prior, prior, beta=2.0)), self.old)
        weights = self.probability * self.advantage
        assert found == pytest.approx(
            float(((weights * self.target).sum() + 2.0 * self.old) / (weights.sum() + 2.0)), abs=1e-9
        )

    def test_advantages_beyond_the_clip_count_as_the_clip(self, prior: ScenePrior) -> None:
        loss = NFTLoss(prior, prior, clip=0.5)
        assert loss.optimality(torch.tensor([-9.0, -0.5, 0.0, 0.25, 9.0])).tolist() == [0.0, 0.0, 0.5, 0.75, 1.0]


class TestTwoCategories:
    """One masked category: first with probability 0.6, whose advantage is -0.5, or second, whose advantage is 1."""

    probability = torch.tensor([0.6, 0.4], dtype=torch.float64)
    advantage = torch.tensor([[-0.5], [1.0]], dtype=torch.float64)
    category = torch.tensor([[0], [1]])

    def log_odds_at_minimum(self, loss: ForwardProcessLoss) -> float:
        old = self.probability.log().expand(2, 1, 2)

        def expected(change: Tensor) -> Tensor:
            logits = old + torch.stack([change, torch.zeros_like(change)])
            losses = loss.category_loss(logits, old, self.category, self.advantage)
            return (self.probability * losses[:, 0]).sum()

        return float(minimum(expected, torch.zeros((), dtype=torch.float64)))

    def test_nft_solves_its_stationary_equation(self, prior: ScenePrior) -> None:
        beta, p = 0.5, 0.6
        good = 0.5 + 0.5 * self.advantage[:, 0].numpy()
        base = np.log(p / (1 - p))

        def slope(change: float) -> float:
            plus, minus = (1 / (1 + np.exp(-(base + sign * beta * change))) for sign in (1, -1))
            one_hot, weight = np.array([1.0, 0.0]), np.array([p, 1 - p])
            return float((weight * (good * (plus - one_hot) - (1 - good) * (minus - one_hot))).sum())

        exact = brentq(slope, -20, 20, xtol=1e-12)
        assert self.log_odds_at_minimum(NFTLoss(prior, prior, beta=beta)) == pytest.approx(exact, abs=1e-6)
        assert exact < 0  # the better category gains


def gradient(loss: ForwardProcessLoss, scenes: TensorDict) -> Tensor:
    loss.prior.zero_grad()
    loss.generator = Generator().manual_seed(3)
    loss(scenes)["loss_objective"].backward()
    return torch.cat([p.grad.flatten().double() for p in loss.prior.parameters() if p.grad is not None])


def own_scenes(prior: ScenePrior, **advantages: Tensor) -> TensorDict:
    return TensorDict({"scene": prior.encode(prior.sample(4, num_steps=3, seed=1)), **advantages}, [4])


def test_nft_and_awm_have_the_same_gradient_at_the_sampling_policy(prior: ScenePrior) -> None:
    torch.manual_seed(0)
    advantages = {"advantage": torch.rand(4, 34) * 2 - 1, "category_advantage": torch.rand(4, 1) * 2 - 1}
    scenes = own_scenes(prior, **advantages)
    nft = gradient(NFTLoss(prior, prior, beta=0.25), scenes)
    awm = gradient(AWMLoss(prior, prior, beta=2.0), scenes)
    assert nft.norm() > 0
    torch.testing.assert_close(nft, 0.25 * awm, rtol=1e-4, atol=1e-7)


def test_no_advantage_at_the_sampling_policy_gives_no_gradient(prior: ScenePrior) -> None:
    scenes = own_scenes(prior, advantage=torch.zeros(4, 1))
    for loss in (NFTLoss(prior, prior), AWMLoss(prior, prior)):
        assert gradient(loss, scenes).abs().max() < 1e-6


def test_invalid_scenes_have_no_part(prior: ScenePrior) -> None:
    advantage = torch.tensor([[0.5], [-0.5], [1.0], [1.0]])
    valid = torch.tensor([True, True, False, False])
    scenes = own_scenes(prior, advantage=advantage, valid=valid)
    other = scenes.clone()
    other["advantage"][2:] = -1.0
    torch.testing.assert_close(gradient(NFTLoss(prior, prior), scenes), gradient(NFTLoss(prior, prior), other))


def test_credit_of_an_object_reaches_its_own_pose_alone() -> None:
    prior = tiny_prior("dimsum_table", process="mixed")
    advantage = torch.zeros(4, 34)
    advantage[:, 5] = 1.0
    loss = NFTLoss(prior, prior, generator=Generator().manual_seed(0))
    scenes = own_scenes(prior, advantage=advantage)
    noised = prior.noised(scenes["scene"], Generator().manual_seed(0))
    output = torch.zeros_like(noised.target, requires_grad=True)
    loss.continuous_loss(output, output.detach(), noised.target, advantage[..., None]).sum().backward()
    moved = output.grad.abs().sum(dim=-1) > 0
    assert moved[:, 5].all()
    assert not moved[:, :5].any()
    assert not moved[:, 6:].any()


def test_wrong_settings_and_shapes_are_named(prior: ScenePrior) -> None:
    with pytest.raises(InvalidInputError, match="beta=0"):
        NFTLoss(prior, prior, beta=0.0)
    with pytest.raises(InvalidInputError, match="above 1"):
        AWMLoss(prior, prior, beta=1.0)
    with pytest.raises(InvalidInputError, match="'advantage' has 7 values per scene"):
        NFTLoss(prior, prior)(own_scenes(prior, advantage=torch.zeros(4, 7)))
