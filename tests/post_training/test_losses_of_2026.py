"""Losses of ``examples/``: UDM-GRPO, CRD and GARDO against closed forms and against losses of the package."""

from __future__ import annotations

import math
from copy import deepcopy
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Generator, Tensor
from torch.distributions import Categorical, Normal

from agents.post_training import DenoisingPolicy, PostTrainConfig, post_train
from agents.post_training.algorithms.forward_process import AWMLoss, NFTLoss
from agents.post_training.settings import make_algorithm
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from agents.utils.checkpoints import load_checkpoint
from tests.helpers.examples import load_example
from tests.helpers.forward_losses import gradient, minimum, own_scenes
from tests.helpers.small_runs import small_config


@pytest.fixture(scope="module")
def udm_grpo() -> ModuleType:
    return load_example("udm_grpo")


@pytest.fixture(scope="module")
def crd() -> ModuleType:
    return load_example("crd")


@pytest.fixture(scope="module")
def gardo() -> ModuleType:
    return load_example("gardo")


@pytest.fixture(scope="module", params=["mixed", "continuous"])
def prior(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior("dimsum_table", process=request.param)


def random_advantages() -> dict[str, Tensor]:
    generator = Generator().manual_seed(0)
    return {
        "advantage": torch.rand(4, 34, generator=generator) * 2 - 1,
        "category_advantage": torch.rand(4, 1, generator=generator) * 2 - 1,
    }


class TestUDMGRPO:
    def test_the_gradient_at_ratio_1_is_that_of_advantage_times_log_likelihood(self, udm_grpo: ModuleType) -> None:
        loss = udm_grpo.UDMGRPOLoss(tiny_prior(), tiny_prior(), clip=9.0)
        loss.std = 0.7
        generator = Generator().manual_seed(0)
        old, target, advantage = torch.randn(3, 2, 5, 4, generator=generator)
        output = old.clone().requires_grad_()
        loss.continuous_loss(output, old, target, advantage).sum().backward()
        expected = old.clone().requires_grad_()
        (-advantage * Normal(expected, 0.7).log_prob(target)).sum().backward()
        torch.testing.assert_close(output.grad, expected.grad)

        before, credit = torch.randn(2, 5, 4, generator=generator), torch.randn(2, 5, generator=generator)
        category = torch.randint(4, (2, 5), generator=generator)
        logits = before.clone().requires_grad_()
        loss.category_loss(logits, before, category, credit).sum().backward()
        free = before.clone().requires_grad_()
        (-credit * Categorical(logits=free).log_prob(category)).sum().backward()
        torch.testing.assert_close(logits.grad, free.grad)

    def test_at_ratio_1_it_is_awm_without_its_pull(self, udm_grpo: ModuleType, prior: ScenePrior) -> None:
        scenes = own_scenes(prior, **random_advantages())
        if prior.process_name == "mixed":  # a category has factor 1, a pose 1 / (2 s^2)
            scenes["category_advantage"] *= 0
        ours = gradient(udm_grpo.UDMGRPOLoss(prior, prior, clip=9.0), scenes)
        awm = gradient(AWMLoss(prior, prior, clip=1.0), scenes)
        assert ours.norm() > 0
        torch.testing.assert_close(ours, 0.5 * awm, rtol=1e-4, atol=1e-7)

    @pytest.mark.parametrize(
        ("advantage", "moved", "pushes"), [(1.0, 0.5, False), (1.0, -0.5, True), (-1.0, 0.5, True)]
    )
    def test_beyond_the_clip_only_a_step_back_has_a_gradient(
        self, udm_grpo: ModuleType, advantage: float, moved: float, pushes: bool
    ) -> None:
        """Log ratios of +-0.5 lie outside of log(1 +- 0.2); at +0.5 a good sample has gained enough."""
        loss = udm_grpo.UDMGRPOLoss(tiny_prior(), tiny_prior(), beta=0.2)
        log_ratio = torch.tensor(moved, requires_grad=True)
        value = loss.surrogate(log_ratio, torch.tensor(advantage))
        value.backward()
        bounded = min(max(math.exp(moved), 0.8), 1.2)
        assert float(value.detach()) == pytest.approx(-min(math.exp(moved) * advantage, bounded * advantage))
        assert bool(log_ratio.grad) is pushes

    @pytest.mark.parametrize("advantage", [0.0, 1.0, -1.0])
    def test_an_outlier_has_no_gradient(self, udm_grpo: ModuleType, advantage: float) -> None:
        """The target lies 20 standard deviations from the older output and on the new one: the ratio is e^200."""
        loss = udm_grpo.UDMGRPOLoss(tiny_prior(), tiny_prior())
        target = torch.tensor(20.0)
        output = target.clone().requires_grad_()
        value = loss.continuous_loss(output, torch.tensor(0.0), target, torch.tensor(advantage))
        value.backward()
        assert math.isfinite(float(value.detach()))
        assert float(output.grad) == 0.0


class TestCRD:
    """Of two finished scenes with targets +1 and -1 at one x_t, the first has the better reward."""

    def loss(self, crd: ModuleType, beta: float, clip: float = 1.0) -> Any:
        prior = tiny_prior("dimsum_table", process="mixed", slots=2)
        loss = crd.CRDLoss(prior, prior, beta=beta, clip=clip)
        loss.base, loss.poses, loss.drawn = prior, torch.zeros(1), torch.ones(2, 1)
        loss.groups = torch.zeros(2, dtype=torch.long)
        return loss

    @pytest.mark.parametrize("beta", [0.5, 2.0])
    def test_the_minimum_on_two_points(self, crd: ModuleType, beta: float) -> None:
        """o solves Sum (2 beta o y - h y) y = 0 with R - mean R = h y, here h = advantage / (2 c) = 0.2."""
        loss = self.loss(crd, beta)
        target, advantage = torch.tensor([1.0, -1.0]).double(), torch.tensor([0.4, -0.4]).double()

        def objective(output: Tensor) -> Tensor:
            gain = (target.square() - (output - target).square())[:, None]
            return loss.regression(gain, advantage[:, None]).sum()

        found = torch.zeros((), dtype=torch.float64)
        for _ in range(1000):  # the centred mean is a constant, so that this is a fixed point and no minimum
            output = found.clone().requires_grad_()
            objective(output).backward()
            found = found - 0.04 / beta * output.grad
        assert float(found) == pytest.approx(0.2 / (2 * beta), abs=1e-6)
        exact = math.tanh(0.2 / (2 * beta))  # the mean of the tilted policy with tau = 2 beta
        assert float(found) == pytest.approx(exact, abs=0.01)

    def test_a_constant_of_the_reward_of_a_group_changes_nothing(self, crd: ModuleType) -> None:
        """This is the normaliser: it depends on the prompt alone."""
        loss = self.loss(crd, 0.5, clip=10.0)
        loss.groups = torch.tensor([0, 1, 0, 1])
        implicit, advantage = torch.randn(2, 4, 3, generator=Generator().manual_seed(0)).double()
        shifted = advantage + torch.tensor([2.0, -3.0, 2.0, -3.0])[:, None]
        torch.testing.assert_close(loss.regression(implicit, advantage), loss.regression(implicit, shifted))
        torch.testing.assert_close(
            loss.regression(implicit, advantage),
            loss.regression(implicit + torch.tensor([5.0, 1.0, 5.0, 1.0])[:, None], advantage),
        )

    def test_categories_reach_the_exact_tilted_policy(self, crd: ModuleType) -> None:
        """p* of two categories has log odds log(p / (1 - p)) + (R_1 - R_2) / beta, as r is exact there."""
        loss = self.loss(crd, 2.0)
        loss.logits = torch.zeros(2, 1, 2)
        old = torch.tensor([0.5, 0.5]).double().log().expand(2, 1, 2)
        category, advantage = torch.tensor([[0], [1]]), torch.tensor([[0.6], [-0.6]]).double()

        def objective(change: Tensor) -> Tensor:
            logits = old + torch.stack([change, torch.zeros_like(change)])
            return loss.category_loss(logits, old, category, advantage).sum()

        found = minimum(objective, torch.zeros((), dtype=torch.float64))
        assert float(found) == pytest.approx(0.6 / 2.0, abs=1e-5)

    def test_at_the_reference_it_is_awm_without_its_pull(self, crd: ModuleType, prior: ScenePrior) -> None:
        """Rewards with mean 0 over a group: the centring changes nothing."""
        scenes = own_scenes(prior, **random_advantages())
        scenes["advantage"] = scenes["advantage"][:, :1] - scenes["advantage"][:, :1].mean()
        scenes["category_advantage"] = scenes["advantage"].clone()
        if prior.process_name == "mixed":
            del scenes["category_advantage"]
        loss = crd.CRDLoss(prior, prior, beta=0.3, clip=9.0)
        loss.base = prior
        ours = gradient(loss, scenes)
        awm = gradient(AWMLoss(prior, prior, clip=9.0), scenes)
        assert ours.norm() > 0
        assert torch.nn.functional.cosine_similarity(ours, awm, dim=0) > 0.99

    def test_the_anchor_follows_the_reward(self, crd: ModuleType) -> None:
        loss = self.loss(crd, 0.5, clip=2.0)
        loss.anchor, loss.floor = 0.5, 0.2
        found = loss.strength(torch.tensor([-5.0, -2.0, 0.0, 2.0]))
        torch.testing.assert_close(found, 0.5 * torch.tensor([0.2, 0.2, 0.6, 1.0]))


class TestGARDO:
    def test_without_penalty_and_diversity_a_run_is_that_of_nft(self, gardo: ModuleType, tmp_path: Path) -> None:
        prior = tiny_prior("dimsum_table", process="mixed")
        runs = {
            "nft": {"name": "nft"},
            "gardo": {"name": "gardo", "penalty": 0.0, "diversity": 0.0},
        }
        weights = [
            torch.cat([p.flatten() for p in run_of(tmp_path / name, prior, keys, iterations=2).prior.parameters()])
            for name, keys in runs.items()
        ]
        assert torch.equal(*weights)

    def test_the_penalty_is_that_of_uncertain_scenes_alone(self, gardo: ModuleType, prior: ScenePrior) -> None:
        """Its gradient at no advantage is that of the squared distance, and of the KL divergence, of these scenes."""
        uncertain = torch.tensor([[True], [False], [False], [True]])
        scenes = own_scenes(prior, advantage=torch.zeros(4, 1), uncertain=uncertain)
        loss = gardo.GARDOLoss(prior, deepcopy(prior))
        loss.reference, loss.penalty = tiny_prior("dimsum_table", seed=1, process=prior.process_name), 500.0
        noised = prior.noised(scenes["scene"], Generator().manual_seed(3))
        with_penalty = float(loss.of_noised(noised, scenes)["loss_objective"].detach())
        without = float(NFTLoss(prior, prior).of_noised(noised, scenes)["loss_objective"].detach())
        output, said = prior.output(noised), loss.reference.output(noised)
        weight = noised.weight / noised.weight.sum(dim=(1, 2), keepdim=True).clamp(min=1.0)
        far = ((output.continuous - said.continuous).square() * weight).sum(dim=(1, 2)) * noised.scale
        if output.logits is not None:
            base = Categorical(logits=said.logits)
            kl = torch.distributions.kl_divergence(base, Categorical(logits=output.logits))
            far = far + prior.config.category_weight * (kl * noised.drawn).sum(1) / noised.drawn.sum(1).clamp(min=1.0)
        assert with_penalty - without == pytest.approx(500.0 * float(far[[0, 3]].sum().detach()) / 4, rel=1e-4)

    def test_diverse_good_scenes_have_more_advantage(self, gardo: ModuleType) -> None:
        """Two equal good scenes have a nearest neighbour at distance 0, a third good one has the mean's threefold."""
        prior = tiny_prior("dimsum_table", process="mixed")
        settings = gardo.GARDOSettings(share=0.5)
        algorithm = make_algorithm(settings, DenoisingPolicy(prior, 4, independent=False), torch.ones(4))
        scenes = prior.sample(3, num_steps=3, seed=1)
        tensor = scenes.tensor[[0, 0, 1, 2]]
        reward = torch.tensor([1.0, 1.0, 1.0, 0.0])[:, None, None].expand(4, 2, 1)
        batch = TensorDict(
            {
                "finished": tensor[:, None].expand(4, 2, *tensor.shape[1:]),
                "next": {"reward": reward, "done": torch.tensor([False, True])[None, :, None].expand(4, 2, 1)},
            },
            [4, 2],
        ).set_non_tensor("scene_type", scenes.scene_type)
        plain = algorithm.plain(batch.clone())["advantage"][:, 0, 0]
        shaped = algorithm.advantage(batch)
        found = shaped["advantage"][:, 0, 0]
        assert found[0] == found[1] == pytest.approx(0.0, abs=1e-3)
        assert found[2] > plain[2]
        assert found[3] == plain[3] < 0
        assert int(shaped["uncertain"][:, 0].sum()) <= 2


def run_of(output: Path, prior: ScenePrior, algorithm: dict[str, Any], **changes: Any) -> Any:
    config = small_config(output, **changes)
    plain = {name: getattr(config, name) for name in ("reward", "output", "iterations", "batch_size", "num_steps")}
    return post_train(
        PostTrainConfig(
            **plain, algorithm=algorithm, regularisation=config.regularisation, guard=config.guard,
            logger=config.logger, progress="none", optimizer=config.optimizer,
        ),
        prior=deepcopy(prior),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["udm_grpo", "crd", "gardo"])
def test_a_run_moves_a_continuous_prior(name: str, tmp_path: Path) -> None:
    load_example(name)
    prior = tiny_prior("dimsum_table", process="continuous")
    run = run_of(tmp_path, prior, {"name": name}, iterations=1)
    assert any(not torch.equal(run.prior.state_dict()[key], value) for key, value in prior.state_dict().items())


@pytest.mark.parametrize("name", ["udm_grpo", "crd", "gardo"])
def test_a_run_moves_a_mixed_prior_and_resumes_exactly(name: str, tmp_path: Path) -> None:
    load_example(name)
    prior = tiny_prior("dimsum_table", process="mixed")
    whole = run_of(tmp_path / "whole", prior, {"name": name}, iterations=2)
    half = tmp_path / "half"
    run_of(half, prior, {"name": name}, iterations=1)
    resumed = run_of(half, prior, {"name": name}, iterations=2)
    states = [load_checkpoint(folder / "checkpoint.pt")["learner"]["prior"] for folder in (tmp_path / "whole", half)]
    assert all(torch.equal(states[0][key], states[1][key]) for key in states[0])
    assert any(not torch.equal(states[0][key], value) for key, value in prior.state_dict().items())
    assert [row["reward"] for row in whole.history] == [row["reward"] for row in resumed.history]
