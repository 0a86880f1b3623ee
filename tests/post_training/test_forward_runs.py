"""Runs of the forward-process algorithms: they learn, resume exactly, and save what sampled the scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from agents.post_training import PostTrainConfig, PostTrainer, PostTrainResult, post_train
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError, UnknownNameError
from tests.helpers.small_runs import count_objects


def forward_config(
    output: Path, algorithm: str, algorithm_settings: dict | None = None, **changes: Any
) -> PostTrainConfig:
    """A few short iterations of ``algorithm`` on the number of objects."""
    keys: dict[str, Any] = {
        "reward": count_objects,
        "iterations": 4,
        "batch_size": 6,
        "num_steps": 5,
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
        settings, slots = {"updates": 1, "draws": 1}, 8

    def run(folder: str, iterations: int) -> PostTrainResult:
        config = forward_config(tmp_path / folder, algorithm, settings, iterations=iterations)
        return post_train(config, prior=tiny_prior(process=process, slots=slots))

    whole = run("whole", 3)
    run("parts", 2)
    torch.randn(7)  # the global generator has moved on
    parts = run("parts", 3)
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
