"""Neon: two copies of a prior, one trained on real scenes and one on own samples, and the step away from the latter."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from agents.priors.prior import ScenePrior
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.post_training import PostTrainer, SelfTrainingLoss
from agents.post_training.expectation import TrainedCopy
from agents.post_training.neon import Neon
from agents.post_training.scene_bank import PromptedScenes
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from tests.helpers.small_runs import count_objects, small_config


def named(prior: ScenePrior) -> dict[str, Tensor]:
    return {name: parameter.detach().clone() for name, parameter in prior.named_parameters()}


@pytest.fixture
def trainer(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[PostTrainer]:
    settings: dict[str, Any] = {"name": "neon", "updates": 2, "period": 2, "w": 1.5}
    keys = {"reward": count_objects, "iterations": 2, "algorithm": settings, **getattr(request, "param", {})}
    made = PostTrainer(small_config(tmp_path, **keys), prior=tiny_prior(process="mixed"))
    made.prepare()
    yield made
    made.close()


def test_a_round_ends_with_a_step_from_the_own_copy_to_the_real_copy(
    trainer: PostTrainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    algorithm = trainer.learner.algorithm
    assert isinstance(algorithm, Neon)
    base = named(trainer.prior)
    trainer.step()
    assert all(torch.equal(value, base[name]) for name, value in named(algorithm.sampler).items())
    before: list[dict[str, Tensor]] = []
    end = algorithm.end_iteration

    def seen() -> None:
        before.extend((named(trainer.prior), named(algorithm.copy.prior)))
        end()

    monkeypatch.setattr(algorithm, "end_iteration", seen)
    trainer.step()
    real, own = before
    assert any(not torch.equal(real[name], own[name]) for name in real)
    for module in (trainer.prior, algorithm.sampler, algorithm.copy.prior):
        for name, value in named(module).items():
            torch.testing.assert_close(value, base[name] + 1.5 * (real[name] - own[name]), rtol=1e-5, atol=1e-6)
    with trainer.learner.averaged() as saved:
        assert all(torch.equal(value, named(algorithm.sampler)[name]) for name, value in saved.named_parameters())


@pytest.mark.parametrize(
    "trainer", [{"regularisation.weight": 0.0, "optimizer.lr": 1e-3, "batch_size": 16, "num_steps": 3}], indirect=True
)
def test_without_real_scenes_the_prior_moves_away_from_its_samples(trainer: PostTrainer) -> None:
    algorithm = trainer.learner.algorithm
    assert isinstance(algorithm, Neon)
    base = deepcopy(trainer.prior)
    samples = [trainer.step()[0].batch]
    copy = {name: value.clone() for name, value in algorithm.copy.prior.state_dict().items()}
    samples.append(trainer.step()[0].batch)

    def loss(state: dict[str, Tensor]) -> float:
        base.load_state_dict(state)
        x0 = torch.cat([base.encode(batch) for batch in samples])
        with torch.no_grad():
            return float(base.pretraining_loss(x0.repeat(8, 1, 1), Generator().manual_seed(0)))

    anchor = loss(base.state_dict())  # the first: the others replace it
    assert loss(copy) < anchor < loss(trainer.prior.state_dict())


def test_the_learning_rate_of_both_copies_falls_to_zero_in_a_round(trainer: PostTrainer) -> None:
    algorithm, rates = trainer.learner.algorithm, []
    assert isinstance(algorithm, Neon)
    for _ in range(3):
        row = trainer.step()[1]  # of the second of two updates
        rates.append(row["learning_rate"])
        assert {group["lr"] for group in algorithm.copy.optimizer.param_groups} == {row["learning_rate"]}
    assert rates == pytest.approx([0.75e-3, 0.25e-3, 0.75e-3])


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_the_loss_is_the_pretraining_loss_of_the_copy(process: str) -> None:
    prior = tiny_prior(process=process)
    x0 = prior.encode(prior.sample(3, num_steps=3, seed=0))
    copy = TrainedCopy(prior, 1e-3)
    loss = SelfTrainingLoss(prior, copy=copy, generator=Generator().manual_seed(5))
    said = loss(TensorDict({"scene": x0}, [3]))
    torch.testing.assert_close(said["loss_expectation"], prior.pretraining_loss(x0, Generator().manual_seed(5)))
    assert float(said["loss_objective"]) == 0.0
    said["loss_expectation"].backward()
    assert all(parameter.grad is None for parameter in prior.parameters())
    assert sum(float(parameter.grad.abs().sum()) for parameter in copy.trained if parameter.grad is not None) > 0


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_nothing_changes_where_the_real_scenes_are_the_own_samples(tmp_path: Path, process: str) -> None:
    """Both copies see the same timesteps and noise, so that only the scenes can tell them apart."""
    keys: dict[str, Any] = {"algorithm": {"name": "neon", "updates": 2, "period": 1}}
    config = small_config(tmp_path, iterations=1, **keys, **{"regularisation.batch_size": 6})
    trainer = PostTrainer(config, prior=tiny_prior(process=process))
    trainer.prepare()
    base, learner = named(trainer.prior), trainer.learner
    rollout = learner.rollout(0)
    own = trainer.prior.encode(rollout.batch)
    real = SimpleNamespace(batch=lambda count, generator: PromptedScenes(own, None), base=None)
    for index in range(2):
        learner.update(rollout, learner.algorithm.advantage(rollout), real, index)  # type: ignore[arg-type]
    assert any(not torch.equal(value, base[name]) for name, value in named(trainer.prior).items())
    learner.algorithm.end_iteration()
    for name, value in named(trainer.prior).items():
        torch.testing.assert_close(value, base[name], rtol=1e-5, atol=1e-6)
    trainer.close()


@pytest.mark.parametrize("keys", [{"w": 0.0}, {"period": 0}])
def test_values_that_cannot_be_are_named(tmp_path: Path, keys: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(keys))):
        small_config(tmp_path, algorithm={"name": "neon", **keys})
