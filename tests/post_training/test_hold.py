"""Targets that a run holds by adjusting its regularisation."""

from __future__ import annotations

import csv
import logging
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from agents.cli.keys import compose
from agents.configuration.composition import changed
from agents.post_training import PostTrainConfig, post_train, post_train_and_compare
from agents.post_training.regularisation import MAX_FACTOR, MIN_FACTOR, HoldState, Regularisation, adjust
from agents.post_training.settings import RegularisationSettings, algorithm_settings
from agents.post_training.trainer import PostTrainer
from agents.priors.testing import tiny_prior
from scene_envs.errors import SceneEnvsError
from tests.helpers.small_runs import small_config


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


@pytest.mark.parametrize(("hold", "kept"), [(None, True), ("guard:1.05", False), ("guard:1.2", True)])
def test_no_checkpoint_beyond_a_held_ratio_is_kept(tmp_path: Path, hold: str | None, kept: bool) -> None:
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
    config = compose("post-train", PostTrainConfig, ["regularisation.hold=guard:1.05"])
    assert config == PostTrainConfig(regularisation={"hold": "guard:1.05"})
    assert config.regularisation.target == 1.05


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["regularisation.hold=guard:0.9"], "above 1, the base"),
        (["regularisation.hold=guard:inf"], "finite"),
        (["regularisation.hold=guard:much"], "such as guard:1.05"),
        (["regularisation.hold=guard"], "must be guard:RATIO"),
        (["regularisation.hold=gard:1.05"], "must be guard:RATIO"),
        (["regularisation.hold=guard:1.05", "regularisation.weight=0"], "which is 0"),
        (["regularisation.hold=guard:1.6"], "guard.limit"),
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
    [("guard:1.05", "ddpo_sf", "continuous"), ("guard:1.05", "nft", "mixed")],
)
def test_a_killed_run_goes_on_with_the_weight_it_had(tmp_path: Path, hold: str, algorithm: str, process: str) -> None:
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
    config = _run(tmp_path, "ddpo_sf", regularisation__hold="guard:1.001", guard__every=1, optimizer__lr=0.05)
    with caplog.at_level(logging.WARNING):
        metrics = post_train_and_compare(config, scenes=2, num_steps=2, prior=tiny_prior(slots=6))
    assert metrics["hold"]["not_held_from"] is not None
    assert "could not be held" in caplog.text
    page = (tmp_path / "report.html").read_text()
    assert "What was held" in page
    assert "could not be held" in page
    assert (tmp_path / "prior" / "model.safetensors").exists()


def test_a_target_that_was_not_reached_at_the_end_does_not_count_as_held() -> None:
    regularisation = Regularisation(RegularisationSettings(weight=1.0, hold="guard:1.05"), tiny_prior())
    regularisation.observe(1.2, iteration=5)  # the bound of the weights is far away
    assert "was not held at the end: guard 1.2" in regularisation.verdict()
    regularisation.observe(1.06, iteration=10)  # 0.2 of the way beyond
    assert regularisation.verdict() == "hold=guard:1.05 was held: guard 1.06 at the last measurement."


def test_a_rollback_does_not_count_as_a_fall_of_the_figure() -> None:
    """The figure rises by 0.002 per iteration before and after the run returns to a checkpoint with 1.0."""
    target, state = 1.05, HoldState()
    for iteration in range(5, 105, 5):
        state = adjust(state, target, 1 + 0.002 * iteration, iteration)
    kept, forgotten = state.returned(1.0), state
    for iteration in range(105, 125, 5):
        measured = 1 + 0.002 * (iteration - 100)
        kept, forgotten = (adjust(one, target, measured, iteration) for one in (kept, forgotten))
    assert kept.factor == pytest.approx(state.factor, rel=0.2)
    assert forgotten.factor < 0.5 * state.factor  # as if training had lowered the figure
