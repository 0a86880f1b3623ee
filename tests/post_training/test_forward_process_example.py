"""The forward-process example: it trains priors of every kind and agrees with the package."""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from agents.priors.prior import ScenePrior
from tensordict import TensorDict

from agents.post_training import NFTLoss, compute_advantages
from agents.post_training.expectation import Expectation
from agents.priors.testing import tiny_prior
from agents.utils.weight_average import WeightAverage
from rewards import evaluate_reward, make_reward
from scene_envs.grammars import get_grammar
from tests.helpers.examples import load_example

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
