"""Targets that a run holds by adjusting its regularisation, and discriminative losses."""

from __future__ import annotations

import csv
import logging
import math
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.cli.keys import compose
from agents.configuration.composition import changed
from agents.post_training import PostTrainConfig, post_train, post_train_and_compare
from agents.post_training.regularisation import (
    MAX_FACTOR,
    MIN_FACTOR,
    DiscriminativeLoss,
    HoldState,
    Regularisation,
    adjust,
)
from agents.post_training.settings import RegularisationSettings, algorithm_settings
from agents.post_training.trainer import PostTrainer
from agents.priors.prior import NoisedScenes, ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.errors import SceneEnvsError
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import count_objects, small_config


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("strength", [0.3, 1.0, 10.0])
def test_a_plant_is_brought_to_the_target(every: int, strength: float) -> None:
    """Excess that rises with the reward's push, falls with the weight, and follows both with a lag of 15 iterations."""
    target, state, excess = 1.05, HoldState(), 0.0
    tail = []
    for iteration in range(1, 601):
        excess += (0.05 * strength / state.factor - excess) / 15
        if iteration % every == 0:
            state = adjust(state, target, 1 + excess, iteration)
        tail.append(excess)
    assert tail[-1] == pytest.approx(0.05, rel=0.05)
    assert state.factor == pytest.approx(strength, rel=0.05)
    assert state.lost_at is None


@pytest.mark.parametrize("every", [1, 5])
def test_a_run_that_speeds_up_passes_its_target_by_less_than_half(every: int) -> None:
    """The distance from the base prior grows with a push that gets stronger, and the excess is its square.

    Control of the last measurement alone brings this plant to an excess of 0.14 for a target of 0.05: the factor falls
    to a tenth while the excess is small, and takes as long to come back.
    """
    target, state, distance, excess = 1.05, HoldState(), 0.0, []
    for iteration in range(1, 301):
        push = 0.0025 + 0.0042 * min(1.0, max(0.0, (iteration - 20) / 30))
        distance += push - 0.029 * state.factor * distance
        excess.append(distance**2)
        if iteration % every == 0:
            state = adjust(state, target, 1 + excess[-1], iteration)
    assert 0.05 < max(excess) < 0.078
    assert excess[-1] == pytest.approx(0.05, rel=0.02)


@pytest.mark.parametrize(("hold", "kept"), [(None, True), (1.05, False), (1.2, True)])
def test_no_checkpoint_beyond_a_held_ratio_is_kept(tmp_path: Path, hold: float | None, kept: bool) -> None:
    run = PostTrainer(_run(tmp_path, "ddpo_sf", guard__samples=0, regularisation__hold=hold), prior=tiny_prior())
    run.prepare()
    guard = run.guard
    guard.start(run.prior)
    guard.base_loss /= 1.1  # as if the base prior had been better
    reading = guard.check(run.prior, 1, reward=1.0)
    assert reading.ratio == pytest.approx(1.1)
    assert reading.kept == kept
    assert reading.beyond == ()  # within guard.limit the run is not over-optimised


@pytest.mark.parametrize(
    ("measured", "bound", "lost"), [(2.0, MAX_FACTOR, True), (1.0, MIN_FACTOR, False), (math.nan, MAX_FACTOR, True)]
)
def test_the_factor_stays_within_its_bounds(measured: float, bound: float, lost: bool) -> None:
    """Only a figure above the target at the upper bound is one that could not be held."""
    state = HoldState()
    for iteration in range(1, 200):
        state = adjust(state, 1.05, measured, iteration)
    assert state.factor == pytest.approx(bound)
    assert (state.lost_at is not None) == lost


def test_the_target_is_the_same_in_python() -> None:
    config = compose("post-train", PostTrainConfig, ["regularisation.hold=1.05"])
    assert config == PostTrainConfig(regularisation={"hold": 1.05})
    assert config.regularisation.hold == 1.05


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["regularisation.hold=0.9"], "ratio above 1"),
        (["regularisation.hold=1"], "ratio above 1"),
        (["regularisation.hold=much"], "hold"),
        (["regularisation.hold=1.05", "regularisation.weight=0"], "which is 0"),
        (["regularisation.hold=1.6"], "guard.limit"),
    ],
)
def test_nonsense_is_refused(words: list[str], said: str) -> None:
    with pytest.raises(SceneEnvsError, match=said):
        compose("post-train", PostTrainConfig, words)


def _run(output: Path, algorithm: str, **changes: Any) -> PostTrainConfig:
    """Four iterations; ``changes`` are keys with two underscores for a dot."""
    settings = algorithm_settings(algorithm)(credit="scene")  # type: ignore[call-arg]
    values = {key.replace("__", "."): value for key, value in changes.items()}
    return changed(small_config(output, reward="object_count"), {"algorithm": settings, **values})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hold", "algorithm", "process"),
    [(1.05, "ddpo_sf", "continuous"), (1.05, "nft", "mixed")],
)
def test_a_killed_run_goes_on_with_the_weight_it_had(tmp_path: Path, hold: float, algorithm: str, process: str) -> None:
    """Killed after the iteration that follows a checkpoint, the resumed run is the uninterrupted one bit for bit."""
    prior = tiny_prior(process=process)
    whole = post_train(_run(tmp_path / "whole", algorithm, regularisation__hold=hold), prior=prior)
    config = _run(tmp_path / "killed", algorithm, regularisation__hold=hold)

    class Killed(Exception):
        """Stands for SIGKILL."""

    trainer = PostTrainer(config, prior=prior)
    step, calls = trainer.step, []

    def dying() -> Any:
        calls.append(1)
        if len(calls) == 4:
            raise Killed
        return step()

    trainer.step = dying  # type: ignore[method-assign]
    with pytest.raises(Killed):
        trainer.run()
    trainer.close()
    resumed = post_train(config, prior=prior)
    without = [{k: v for k, v in row.items() if k != "seconds"} for row in resumed.history]
    assert without == [{k: v for k, v in row.items() if k != "seconds"} for row in whole.history]
    for name, tensor in whole.prior.state_dict().items():
        assert torch.equal(tensor, resumed.prior.state_dict()[name])
    assert resumed.metrics["hold"] == whole.metrics["hold"]
    factors = [row["hold_factor"] for row in whole.history]
    assert len(set(factors)) > 1
    with (tmp_path / "killed" / "log.csv").open() as file:
        assert [float(row["regularisation_weight"]) for row in csv.DictReader(file)] == factors


@pytest.mark.slow
def test_a_target_that_cannot_be_held_is_said_in_log_metrics_and_report(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agents.post_training.regularisation.MAX_FACTOR", 1.1)
    config = _run(tmp_path, "ddpo_sf", regularisation__hold=1.001, guard__every=1, num_steps=5, optimizer__lr=0.05)
    with caplog.at_level(logging.WARNING):
        metrics = post_train_and_compare(config, scenes=2, num_steps=2, prior=tiny_prior(slots=6))
    assert metrics["hold"]["not_held_from"] is not None
    assert "could not be held" in caplog.text
    page = (tmp_path / "report.html").read_text()
    assert "What was held" in page
    assert "could not be held" in page
    assert (tmp_path / "prior" / "model.safetensors").exists()


def test_a_target_that_was_not_reached_at_the_end_does_not_count_as_held() -> None:
    regularisation = Regularisation(RegularisationSettings(weight=1.0, hold=1.05), tiny_prior())
    regularisation.observe(1.2, iteration=5)  # the bound of the weights is far away
    assert "was not held at the end: guard 1.2" in regularisation.verdict()
    regularisation.observe(1.06, iteration=10)  # 0.2 of the way beyond
    assert regularisation.verdict() == "hold=1.05 was held: guard 1.06 at the last measurement."


def test_a_rollback_does_not_count_as_a_fall_of_the_figure() -> None:
    """The figure rises by 0.002 per iteration before and after the run returns to a checkpoint with 1.0."""
    target, state = 1.05, HoldState()
    for iteration in range(5, 105, 5):
        state = adjust(state, target, 1 + 0.002 * iteration, iteration)
    kept, forgotten = replace(state, measured=1.0, slope=0.0), state  # as Regularisation.return_to_checkpoint does
    for iteration in range(105, 125, 5):
        measured = 1 + 0.002 * (iteration - 100)
        kept, forgotten = (adjust(one, target, measured, iteration) for one in (kept, forgotten))
    assert kept.factor == pytest.approx(state.factor, rel=0.2)
    assert forgotten.factor < 0.5 * state.factor  # as if training had lowered the figure


PROCESSES = ("continuous", "mixed")


def noised_scenes(prior: ScenePrior) -> NoisedScenes:
    scenes = prior.encode(prior.sample(4, num_steps=3, seed=1))
    return prior.noised(scenes, torch.Generator().manual_seed(2))


@pytest.mark.parametrize("process", PROCESSES)
def test_gradients_at_the_base_prior_are_those_of_the_pretraining_loss_and_its_negative(process: str) -> None:
    prior = tiny_prior(process=process)
    parameters = [p.requires_grad_(True) for p in prior.parameters()]
    noised = noised_scenes(prior)
    loss = DiscriminativeLoss(prior, deepcopy(prior), sharpness=20.0)
    pretraining = torch.autograd.grad(prior.noised_loss(noised).mean(), parameters, allow_unused=True)
    for losses, sign in ((loss.of_real, 1.0), (loss.of_base, -1.0)):
        found = torch.autograd.grad(losses(noised).mean(), parameters, allow_unused=True)
        for ours, theirs in zip(found, pretraining, strict=True):
            if theirs is not None:
                torch.testing.assert_close(ours, sign * theirs, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("gap", [-3.0, 0.0, 0.5])
def test_losses_are_those_of_logistic_regression_on_the_gap(gap: float, monkeypatch: pytest.MonkeyPatch) -> None:
    prior = tiny_prior(process="mixed")
    noised = noised_scenes(prior)
    monkeypatch.setattr(DiscriminativeLoss, "gap", lambda self, noised, text=None: torch.full((4,), gap))
    loss = DiscriminativeLoss(prior, prior, sharpness=8.0)
    real, base = (-math.log(1 / (1 + math.exp(-sign * 8.0 * gap))) / 4 for sign in (1, -1))
    torch.testing.assert_close(loss.of_real(noised), torch.full((4,), real))
    torch.testing.assert_close(loss.of_base(noised), torch.full((4,), base))


def test_base_samples_far_from_the_prior_repel_no_more() -> None:
    prior = tiny_prior(process="mixed")
    base = deepcopy(prior)
    for parameter in prior.parameters():
        parameter.requires_grad_(True).data.add_(0.3 * torch.randn(parameter.shape, generator=torch.Generator()))
    noised = noised_scenes(base)
    loss = DiscriminativeLoss(prior, base, sharpness=1e4)
    assert bool((loss.gap(noised) < -0.01).all())
    loss.of_base(noised).sum().backward()
    assert max(float(p.grad.abs().max()) for p in prior.parameters() if p.grad is not None) < 1e-6


@pytest.mark.parametrize("process", PROCESSES)
def test_a_run_is_resumed_exactly_and_logs_both_losses(process: str, tmp_path: Path) -> None:
    keys = {
        "reward": count_objects,
        "algorithm": "nft",
        "regularisation.objective": "discriminative",
        "regularisation.weight": 0.5,
        "regularisation.base_samples": 8,
    }
    prior = partial(tiny_prior, process=process, text=process == "mixed")
    for folder, lengths in ((tmp_path / "whole", [2]), (tmp_path / "parts", [1, 2])):
        for iterations in lengths:
            post_train(small_config(folder, **keys, guard_every=1, iterations=iterations), prior=prior())
    whole, parts = (ScenePrior.load(tmp_path / name).state_dict() for name in ("whole", "parts"))
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    rows = list(csv.DictReader((tmp_path / "whole" / "log.csv").open()))
    assert all(float(row["base_sample_loss"]) > 0 and float(row["base_sample_gradient_norm"]) > 0 for row in rows)


def test_base_samples_are_those_of_the_base_prior_with_the_prompts_of_real_scenes(tmp_path: Path) -> None:
    prior = tiny_prior(process="mixed", text=True)
    config = small_config(
        tmp_path,
        algorithm="nft",
        reward=count_objects,
        **{"regularisation.objective": "discriminative", "regularisation.base_samples": 40},
    )
    trainer = PostTrainer(config, prior=deepcopy(prior))
    trainer.prepare()
    base = trainer.scenes.base
    trainer.close()
    assert base is not None
    assert base.prompts is not None
    known = {text for i in range(len(trainer.scenes.train)) for text in (trainer.scenes.prompts or (lambda i: ()))(i)}
    assert set(base.prompts) - {""} <= known
    assert any(base.prompts)
    saved = SceneBatch.load(tmp_path / "base_samples.safetensors")
    assert len(saved) == len(base.scenes) == 40
    torch.testing.assert_close(prior.encode(saved), base.scenes)
    drawn = base.batch(200, torch.Generator().manual_seed(0))
    pairs = {(scene.numpy().tobytes(), text) for scene, text in zip(base.scenes, base.prompts, strict=True)}
    assert drawn.prompts is not None
    assert {(scene.numpy().tobytes(), text) for scene, text in zip(drawn.scenes, drawn.prompts, strict=True)} <= pairs
