"""Examples of post-training in one file: they train priors of every kind and agree with the package."""

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
from tensordict import TensorDict
from torch import Tensor

from agents.post_training import NFTLoss, PostTrainer, compute_advantages
from agents.post_training.algorithms.forward_process import Expectation
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from agents.utils.weight_average import WeightAverage
from rewards import evaluate_reward, make_reward
from scene_envs.grammars import get_grammar
from tests.helpers.examples import load_example
from tests.helpers.small_runs import small_config

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
