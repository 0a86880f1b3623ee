"""Guidance distillation: its targets, its loss in a closed form, and a prior that learns from it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Generator

from agents import ScenePrior
from agents.post_training import GuidanceDistillationLoss, PostTrainer
from agents.post_training.algorithms.guidance_distillation import GuidanceDistillation
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from scene_envs.physics.correction import corrections
from scene_envs.scene import POSE_FEATURES, TRANSLATION
from tests.helpers.small_runs import count_objects, small_config

NAME = "guidance_distillation"
STEPS = 12


@pytest.fixture
def trainer(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[PostTrainer]:
    keys: dict[str, Any] = getattr(request, "param", {})
    settings = {"name": NAME, **keys.get("algorithm", {})}
    rest = {key: value for key, value in keys.items() if key != "algorithm"}
    config = small_config(tmp_path, reward=count_objects, num_steps=STEPS, algorithm=settings, **rest)
    made = PostTrainer(config, prior=ScenePrior.load("dimsum_table"))
    made.prepare()
    yield made
    made.close()


def algorithm(trainer: PostTrainer) -> GuidanceDistillation:
    found = trainer.learner.algorithm
    assert isinstance(found, GuidanceDistillation)
    return found


@pytest.mark.parametrize("name", ["dimsum_table", "dimsum_table_continuous", "living_room_shelf"])
def test_a_prior_that_denoises_as_the_teacher_has_no_loss(name: str) -> None:
    prior = ScenePrior.load(name)
    x, table = prior.initial(2, 23, Generator().manual_seed(0)), prior.step_table(10)
    with torch.no_grad():
        own: Any = prior.transition(x, 4, table)
        states = {"scene": x, "timestep": table.timesteps[4].expand(2), "denoised": own.denoised[..., :POSE_FEATURES]}
        assert float(GuidanceDistillationLoss(prior)(TensorDict(states, [2]))["loss_objective"]) < 1e-6


@pytest.mark.parametrize(
    ("process", "huber", "error", "expected"),
    [("mixed", math.inf, 0.7, 0.49), ("continuous", math.inf, 0.7, 0.49), ("mixed", 0.5, 2.5, 0.5 * (2 * 2.5 - 0.5))],
)
def test_the_loss_is_the_squared_difference_in_units_of_the_denoiser_error_and_linear_above_the_limit(
    process: str, huber: float, error: float, expected: float
) -> None:
    prior = tiny_prior(process=process)
    table, generator = prior.step_table(10), Generator().manual_seed(0)
    x, step = prior.initial(3, 34, generator), 6
    t = int(table.timesteps[step])
    denoised: Any = prior.transition(x, step, table)
    own = denoised.denoised[..., :POSE_FEATURES]
    _, std = prior.process.estimate(t, int(table.previous[step]), prior.residual)
    moved = error * std[:POSE_FEATURES].float()
    trained = torch.zeros(3, 34, dtype=torch.bool)
    trained[:, 4:9] = True
    states = {"scene": x, "timestep": torch.full((3, 1), t), "denoised": own + moved, "trained": trained}
    found = GuidanceDistillationLoss(prior, huber)(TensorDict(states, [3]))["loss_objective"]
    assert float(found.detach()) == pytest.approx(expected, rel=1e-3)
    found.backward()
    assert any(p.grad is not None and bool(p.grad.any()) for p in prior.parameters())


def test_targets_are_the_corrections_of_what_the_sampler_denoises(trainer: PostTrainer) -> None:
    learner, found = algorithm(trainer), trainer.learner.rollout(0)
    step, prior, table = learner.steps[-3], learner.sampler, trainer.learner.policy.table
    states = learner.corrected(found, step)
    torch.testing.assert_close(states["scene"], found["scene"][:, step])
    with torch.no_grad():
        reverse: Any = prior.transition(found["scene"][:, step], step, table)
    std = prior.position_std(step, table)
    moves = corrections(prior.decode(reverse.denoised), std)
    expected = reverse.denoised[..., :POSE_FEATURES].clone()
    expected[..., TRANSLATION] += prior.normalizer.scale[TRANSLATION] * moves
    torch.testing.assert_close(states["denoised"], expected)
    torch.testing.assert_close(states["moved"], moves.norm(dim=-1))
    assert float(moves.norm(dim=-1).max()) > 1e-4
    assert not states["trained"][:, 0].any()  # the table
    assert (states["trained"].sum(dim=1) > 0).all()


def test_the_prior_comes_nearer_to_guided_samples(trainer: PostTrainer) -> None:
    """Eight updates on the states of one batch lower their loss."""
    learner, found = trainer.learner, trainer.learner.rollout(0)
    states = learner.algorithm.corrected(found, learner.algorithm.steps[2])  # type: ignore[attr-defined]
    loss = algorithm(trainer).loss
    before = float(loss(states)["loss_objective"].detach())
    optimizer = torch.optim.AdamW(learner.parameters, lr=1e-4)
    for _ in range(8):
        optimizer.zero_grad()
        loss(states)["loss_objective"].backward()
        optimizer.step()
    assert float(loss(states)["loss_objective"].detach()) < 0.85 * before


def test_a_prior_that_knows_no_position_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prior = tiny_prior()
    monkeypatch.setattr(type(prior), "estimate", lambda *_: (0.5, torch.full((3,), 0.5)))
    with pytest.raises(InvalidInputError, match=r"known to 3 cm.*num_steps=12"):
        PostTrainer(small_config(tmp_path, num_steps=STEPS, algorithm={"name": NAME}), prior=prior)


@pytest.mark.parametrize(
    "keys", [{"huber": 0.0}, {"states": 0}, {"memory": 0}, {"sampler_decay": 1.0}, {"strength": 2.0}]
)
def test_values_that_cannot_be_are_named(tmp_path: Path, keys: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(keys))):
        small_config(tmp_path, algorithm={"name": NAME, **keys})


def test_steps_are_those_at_which_the_guidance_acts(trainer: PostTrainer) -> None:
    learner = algorithm(trainer)
    stds = [
        float(learner.sampler.position_std(step, trainer.learner.policy.table)[:2].max())  # type: ignore[arg-type]
        for step in range(STEPS)
    ]
    assert learner.steps == np.flatnonzero(np.array(stds) <= 0.03).tolist()
    assert 0 < len(learner.steps) < STEPS
