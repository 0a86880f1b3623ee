"""Forward-process losses against closed forms, the expectation of own samples, and runs."""

from __future__ import annotations

import csv
import sys
from copy import deepcopy
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.post_training import PostTrainConfig, PostTrainer, PostTrainResult, compute_advantages, post_train
from agents.post_training.algorithms.forward_process import AWMLoss, Expectation, ForwardProcessLoss, NFTLoss
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from agents.utils.weight_average import WeightAverage
from rewards import evaluate_reward, make_reward
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar
from tests.helpers.examples import load_example
from tests.helpers.forward_losses import gradient, minimum, own_scenes
from tests.helpers.small_runs import count_objects, small_config


@pytest.fixture(scope="module", params=["mixed", "continuous"])
def prior(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior("dimsum_table", process=request.param)


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


@pytest.fixture(params=["mixed", "continuous"])
def either_prior(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior("dimsum_table", process=request.param)


def scenes_of(either_prior: ScenePrior, advantage: Tensor) -> TensorDict:
    return TensorDict(
        {"scene": either_prior.encode(either_prior.sample(4, num_steps=3, seed=1)), "advantage": advantage}, [4]
    )


def gradient_of(loss: NFTLoss | AWMLoss, scenes: TensorDict) -> Tensor:
    loss.prior.zero_grad()
    loss.generator = Generator().manual_seed(3)
    loss(scenes)["loss_objective"].backward()
    return torch.cat([p.grad.flatten() for p in loss.prior.parameters() if p.grad is not None])


@pytest.mark.parametrize("kind", [NFTLoss, AWMLoss])
def test_a_new_expectation_is_the_sampling_policy(
    either_prior: ScenePrior, kind: type[NFTLoss] | type[AWMLoss]
) -> None:
    scenes = scenes_of(either_prior, torch.linspace(-1, 1, 4)[:, None].expand(4, 34).contiguous())
    without, with_one = (
        kind(either_prior, either_prior),
        kind(either_prior, either_prior, expectation=Expectation(either_prior)),
    )
    torch.testing.assert_close(gradient_of(with_one, scenes), gradient_of(without, scenes), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", [NFTLoss, AWMLoss])
def test_the_step_is_the_covariance_wherever_the_sampling_policy_stands(
    kind: type[NFTLoss] | type[AWMLoss],
) -> None:
    """Targets +1 and -1 with 0.3 and 0.7, advantages 0.8 and -0.2; o_old is off their mean, -0.4, by anything.

    The gradient at o_old is -2 beta Cov for NFT and -2 Cov for AWM. With o_old as the mean it would hold in addition
    the mean advantage times the error of o_old.
    """
    either_prior = tiny_prior()
    loss = kind(either_prior, either_prior)
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
    either_prior = tiny_prior()
    other = deepcopy(either_prior)
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape, generator=Generator().manual_seed(0)))
    scenes = scenes_of(either_prior, torch.full((4, 34), -1.0))
    scenes["timestep"] = torch.full((4,), 40)
    expectation = Expectation(either_prior, learning_rate=3e-3)
    loss = NFTLoss(other, other, expectation=expectation, generator=Generator().manual_seed(0))
    for _ in range(60):
        loss(scenes)["loss_expectation"].backward()
        expectation.step()
    push = gradient_of(NFTLoss(other, other), scenes).norm()
    assert gradient_of(loss, scenes).norm() < 0.5 * push


def test_its_loss_is_the_pretraining_loss_of_poses() -> None:
    """Of a continuous prior, whose pretraining loss has no other part."""
    either_prior = tiny_prior("dimsum_table", process="continuous")
    scenes = scenes_of(either_prior, torch.zeros(4, 1))
    expectation = Expectation(either_prior)
    found = NFTLoss(either_prior, either_prior, expectation=expectation, generator=Generator().manual_seed(5))(scenes)
    exact = either_prior.pretraining_loss(scenes["scene"], Generator().manual_seed(5))
    assert float(found["loss_expectation"].detach()) == pytest.approx(float(exact.detach()), rel=1e-4)


def test_its_state_survives(either_prior: ScenePrior) -> None:
    first, second = Expectation(either_prior), Expectation(either_prior)
    noised = either_prior.noised(either_prior.encode(either_prior.sample(2, num_steps=3)), Generator().manual_seed(0))
    for _ in range(2):
        (first(noised) - 1.0).square().mean().backward()
        first.step()
    second.restore(deepcopy(first.state()))
    for expectation in (first, second):
        (expectation(noised) - 1.0).square().mean().backward()
        expectation.step()
    assert torch.equal(first(noised), second(noised))


def forward_config(
    output: Path, algorithm: str, algorithm_settings: dict | None = None, **changes: Any
) -> PostTrainConfig:
    """A few short iterations of ``algorithm`` on the number of objects."""
    keys: dict[str, Any] = {
        "reward": count_objects,
        "iterations": 4,
        "batch_size": 6,
        "num_steps": 3,
        "algorithm": {"name": algorithm, **(algorithm_settings or {})},
        "regularisation": {"weight": 1.0, "batch_size": 6, "bank_size": 24},
        "guard": {"scenes": 8, "every": 2},
        "logger": {"checkpoint_every": 2},
        "progress": "none",
        "optimizer": {"lr": 1e-3},
    }
    return PostTrainConfig(output=str(output), **(keys | changes))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "process"),
    [
        ("nft", "mixed"),
        ("awm", "continuous"),
        ("guidance_distillation", "continuous"),
    ],
)
def test_stopped_and_resumed_run_equals_the_uninterrupted_one(tmp_path: Path, algorithm: str, process: str) -> None:
    settings, slots = {}, None
    if algorithm == "guidance_distillation":  # scenes of an untrained prior have many overlaps
        settings, slots = {"updates": 1, "states": 6}, 8

    def run(folder: str, iterations: int) -> PostTrainResult:
        guard = {"scenes": 8, "every": 1}
        config = forward_config(tmp_path / folder, algorithm, settings, iterations=iterations, guard=guard)
        return post_train(config, prior=tiny_prior(process=process, slots=slots))

    whole = run("whole", 2)
    run("parts", 1)
    torch.randn(7)  # the global generator has moved on
    parts = run("parts", 2)
    ours, theirs = (
        torch.load(tmp_path / name / "checkpoint.pt", weights_only=True)["learner"] for name in ("parts", "whole")
    )
    assert all(torch.equal(ours["prior"][name], value) for name, value in theirs["prior"].items())
    sampler = theirs["algorithm"]["sampler"]
    assert all(torch.equal(ours["algorithm"]["sampler"][name], value) for name, value in sampler.items())
    assert [row["reward"] for row in parts.history] == [row["reward"] for row in whole.history]


@pytest.mark.slow
@pytest.mark.parametrize(("algorithm", "process"), [("nft", "mixed"), ("awm", "continuous")])
def test_more_objects_after_training_on_their_number(tmp_path: Path, algorithm: str, process: str) -> None:
    config = forward_config(
        tmp_path,
        algorithm,
        iterations=12,
        batch_size=12,
        num_steps=4,
        regularisation={"weight": 0.0, "bank_size": 24},
        optimizer={"lr": 5e-3},
        algorithm_settings={"credit": "scene", "sampler_decay": 0.3},
    )
    rewards = [row["reward"] for row in post_train(config, prior=tiny_prior(process=process)).history]
    assert sum(rewards[-5:]) / 5 > sum(rewards[:5]) / 5 + 1.0


@pytest.mark.slow
def test_what_sampled_the_scenes_is_saved(tmp_path: Path) -> None:
    trainer = PostTrainer(
        forward_config(tmp_path, "nft", guard={"scenes": 8, "every": 2, "limit": 100.0}), prior=tiny_prior()
    )
    try:
        result = trainer.run()
    finally:
        trainer.close()
    sampler = dict(trainer.learner.algorithm.sampling_policy.prior.named_parameters())
    trained = dict(trainer.learner.prior.named_parameters())
    best = result.metrics["guard"]["best_iteration"]
    saved = dict(ScenePrior.load(tmp_path).named_parameters())
    assert any(not torch.equal(sampler[name], trained[name]) for name in trained)
    if best == 4:
        assert all(torch.allclose(saved[name], sampler[name]) for name in sampler)


def test_credit_per_object_leaves_categories_alone(tmp_path: Path) -> None:
    trainer = PostTrainer(forward_config(tmp_path, "nft"), prior=tiny_prior())
    try:
        trainer.prepare()
        final = trainer.learner.write_advantage(trainer.learner.rollout(0))[:, -1]
    finally:
        trainer.close()
    empty = final["finished"][..., -1] == 1
    assert final["advantage"].shape == empty.shape
    assert (final["category_advantage"] == 0).all()
    assert (final["advantage"][empty] == 0).all()


def test_chunks_do_not_change_the_gradient_of_given_noise(tmp_path: Path) -> None:
    trainer = PostTrainer(forward_config(tmp_path, "nft", {"expectation_lr": 0.0}), prior=tiny_prior())
    try:
        trainer.prepare()
        algorithm = trainer.learner.algorithm
        batch = trainer.learner.write_advantage(trainer.learner.rollout(0))
        norms = []
        for chunk in (None, 6, 12):
            algorithm.policy.chunk = chunk
            trainer.learner.optimizer.zero_grad(set_to_none=True)
            norms.append(algorithm.accumulate(batch, torch.Generator().manual_seed(0)).loss)
    finally:
        trainer.close()
    assert norms == pytest.approx([norms[0]] * 3)


def test_wrong_settings_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="above 1"):
        forward_config(tmp_path, "awm", algorithm_settings={"beta": 0.5})
    with pytest.raises(UnknownNameError, match="category_credit"):
        forward_config(tmp_path, "nft", algorithm_settings={"category_credit": "slot"})


SMALL = {"iterations": 2, "batch_size": 4, "num_steps": 4, "real_scenes": 32}


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return load_example("forward_process")


@pytest.mark.slow
@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_it_trains_and_saves_a_prior(
    example: ModuleType, tmp_path: Path, process: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = tiny_prior(process=process)
    base.save(tmp_path / "base")
    command = next(line for line in example.__doc__.splitlines() if line.startswith("    python examples/"))
    small = {**SMALL, "output": tmp_path / "run", "prior": tmp_path / "base"}
    options = [word for name, value in small.items() for word in ("--" + name.replace("_", "-"), str(value))]
    monkeypatch.setattr(sys, "argv", [*command.split()[1:], *options])
    example.main(example.parse_args())
    with (tmp_path / "run" / "log.csv").open() as file:
        assert [row["iteration"] for row in csv.DictReader(file)] == ["1", "2"]
    before, after = base.weights(), ScenePrior.load(tmp_path / "run").weights()
    assert any(not torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_its_gradient_is_that_of_the_package(example: ModuleType, process: str) -> None:
    trained, sampler, args = tiny_prior(process=process), tiny_prior(process=process, seed=1), example.Args()
    expectation = Expectation(tiny_prior(process=process, seed=2))
    x0 = trained.encode(trained.sample(3, num_steps=3, seed=0))
    advantage = torch.randn(x0.shape[:2], generator=torch.Generator().manual_seed(0))
    mine = example.losses(trained, sampler, expectation.prior, x0, advantage, args, torch.Generator().manual_seed(5))
    loss = NFTLoss(
        trained, sampler, beta=args.beta, clip=args.advantage_clip, expectation=expectation,
        generator=torch.Generator().manual_seed(5),
    )  # fmt: skip
    theirs = loss(TensorDict({"scene": x0, "advantage": advantage}, [3]))
    torch.testing.assert_close(mine[1].mean(), theirs["loss_expectation"])
    poses = list(trained.denoiser.network.parameters())
    gradients = [
        torch.autograd.grad(value, poses, allow_unused=True) for value in (mine[0].mean(), theirs["loss_objective"])
    ]
    for ours, reference in zip(*gradients, strict=True):
        if ours is not None and reference is not None:
            torch.testing.assert_close(ours, reference, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_its_reward_weighting_without_advantages_is_the_pretraining_loss(example: ModuleType, process: str) -> None:
    prior, other = tiny_prior(process=process), tiny_prior(process=process, seed=1)
    x0 = prior.encode(prior.sample(3, num_steps=3, seed=0))
    none, args = torch.zeros(x0.shape[:2]), example.Args(loss="reward_weighted")
    found, _ = example.losses(prior, other, other, x0, none, args, torch.Generator().manual_seed(5))
    torch.testing.assert_close(found.mean(), prior.pretraining_loss(x0, torch.Generator().manual_seed(5)))
    good, _ = example.losses(prior, other, other, x0, none + 1, args, torch.Generator().manual_seed(5))
    assert bool((good > found).all())


def test_its_advantages_are_those_of_the_package(example: ModuleType) -> None:
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(0), 4)
    batch.tensor[:, 3:, :3] += 0.003 * torch.randn(4, 31, 3, generator=torch.Generator().manual_seed(0))
    scored = evaluate_reward(make_reward("feasible_share"), batch)
    expected = compute_advantages(scored.per_object.float(), batch.is_free & scored.is_valid[:, None], clip=1e9)
    assert expected.abs().sum() > 0
    torch.testing.assert_close(example.advantages(batch, scored), expected)


def test_its_sampler_follows_as_in_the_package(example: ModuleType) -> None:
    trained, sampler = tiny_prior(seed=1), tiny_prior()
    average = WeightAverage(sampler, 0.9)
    for iteration in range(3):
        example.follow(sampler, trained, iteration, example.Args())
        average.update(trained)
    for name, parameter in sampler.named_parameters():
        torch.testing.assert_close(parameter, average.tensors[name])


@pytest.mark.parametrize("process", ["continuous", "mixed"])
def test_neon_steps_away_from_the_copy_that_is_trained_on_samples(tmp_path: Path, process: str) -> None:
    neon, base = load_example("neon"), tiny_prior(process=process)
    settings = {"name": "neon", "updates": 2, "period": 2, "w": 1.5, "lr": 1e-3}
    copies: list[dict[str, Tensor]] = []

    def run(folder: str, iterations: int) -> ScenePrior:
        keys: dict[str, Any] = {"algorithm": settings, "iterations": iterations, "regularisation.weight": 0.0}
        trainer = PostTrainer(small_config(tmp_path / folder, **keys), prior=base)
        algorithm: Any = trainer.learner.algorithm
        begin = algorithm.begin
        algorithm.begin = lambda prior: (copies.append(deepcopy(algorithm.own.weights())), begin(prior))
        trainer.run()
        return trainer.prior

    whole = run("whole", 3)
    (own,), before, after = copies, base.weights(), whole.weights()
    assert neon.NeonSettings().regularisation_weight == 0
    assert any(not torch.equal(own[name], before[name]) for name in before)
    for name in before:
        torch.testing.assert_close(after[name], before[name] + 1.5 * (before[name] - own[name]), rtol=1e-5, atol=1e-6)
    run("parts", 1)
    parts = run("parts", 3)
    assert all(torch.equal(weight, after[name]) for name, weight in parts.weights().items())
