"""Runs: exact at the start, exact when resumed, and safe when something breaks."""

from __future__ import annotations

import csv
import json
import os
import signal
from pathlib import Path

import pytest
import torch

from agents.configuration.composition import changed
from agents.post_training import PostTrainer, post_train
from agents.post_training import regularisation as regularisation_module
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards.base import RewardContext, RewardOutput
from scene_envs.errors import CorruptFileError, InvalidInputError, TrainingError, UnknownNameError
from scene_envs.scene import SceneBatch
from tests.helpers.forked import forked
from tests.helpers.small_runs import count_objects, not_a_number, small_config


def weights(path: Path) -> dict[str, torch.Tensor]:
    return torch.load(path / "checkpoint.pt", weights_only=True)["learner"]["prior"]


def without_seconds(history: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{name: value for name, value in row.items() if name != "seconds"} for row in history]


@pytest.mark.parametrize("chunk", [None, 4])
def test_log_ratio_is_exactly_zero_before_the_first_update(tmp_path: Path, chunk: int | None) -> None:
    result = post_train(small_config(tmp_path, iterations=1, gradient_steps=4, chunk=chunk), prior=tiny_prior())
    assert result.history[0]["log_ratio"] == 0.0


def test_the_base_prior_is_left_as_it_was(tmp_path: Path) -> None:
    prior = tiny_prior()
    before = {name: tensor.clone() for name, tensor in prior.state_dict().items()}
    post_train(small_config(tmp_path, iterations=1), prior=prior)
    assert all(torch.equal(before[name], tensor) for name, tensor in prior.state_dict().items())


def test_chunks_do_not_change_the_gradient(tmp_path: Path) -> None:
    rows = []
    for chunk in (None, 2):
        config = small_config(tmp_path / str(chunk), iterations=1, chunk=chunk, regularisation=0.0)
        rows.append(post_train(config, prior=tiny_prior()).history[0])
    assert rows[0]["policy_gradient_norm"] == pytest.approx(rows[1]["policy_gradient_norm"], rel=1e-3)


@pytest.mark.slow
def test_more_objects_after_training_on_their_number(tmp_path: Path) -> None:
    config = small_config(
        tmp_path,
        iterations=20,
        batch_size=16,
        gradient_steps=4,
        credit="object",
        regularisation=0.0,
        lr=3e-3,
    )
    history = post_train(config, prior=tiny_prior()).history
    first, last = ([row["reward"] for row in rows] for rows in (history[:5], history[-5:]))
    assert sum(last) / 5 > sum(first) / 5 + 1.0


def test_run_leaves_a_prior_a_log_and_metrics(tmp_path: Path) -> None:
    result = post_train(small_config(tmp_path), prior=tiny_prior())
    loaded = ScenePrior.load(tmp_path)
    assert torch.equal(loaded.sample(2, num_steps=2).tensor, result.prior.sample(2, num_steps=2).tensor)
    with (tmp_path / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["iteration"]) for row in rows] == [1, 2, 3, 4]
    assert {"policy_gradient_norm", "pretraining_gradient_norm", "guard_ratio"} <= rows[-1].keys()
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["iterations"] == 4
    assert metrics["guard"]["limit"] == 1.5
    assert len(metrics["guard"]["checks"]) == 2
    assert "reward: " in (tmp_path / "config.yaml").read_text()


def test_rows_go_to_the_logger_that_is_named(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = small_config(tmp_path, iterations=2, **{"logger.name": "tensorboard"})
    rewards = [row["reward"] for row in post_train(config, prior=tiny_prior()).history]
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [event.value for event in events.Scalars("reward")] == pytest.approx(rewards)


@pytest.mark.slow
@pytest.mark.parametrize("changes", [{}, {"credit": "scene"}, {"algorithm": "ddpo_is"}])
def test_stopped_and_resumed_run_equals_the_uninterrupted_one(tmp_path: Path, changes: dict) -> None:
    whole = post_train(small_config(tmp_path / "whole", iterations=3, **changes), prior=tiny_prior())
    post_train(small_config(tmp_path / "parts", iterations=2, **changes), prior=tiny_prior())
    torch.randn(7)  # the global generator has moved on
    parts = post_train(small_config(tmp_path / "parts", iterations=3, **changes), prior=tiny_prior())
    ours, theirs = weights(tmp_path / "parts"), weights(tmp_path / "whole")
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert without_seconds(parts.history) == without_seconds(whole.history)
    assert parts.metrics["guard"] == whole.metrics["guard"]


def killed_in_iteration_four(output: Path) -> None:
    torch.set_num_threads(1)
    calls = 0

    def deadly(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        nonlocal calls
        calls += 1
        if calls == 5:  # one probe, then iteration 4
            os.kill(os.getpid(), signal.SIGKILL)
        return count_objects(batch, context)

    deadly.__qualname__ = "count_objects"
    post_train(small_config(output, reward=deadly), prior=tiny_prior())


@pytest.mark.slow
def test_killed_run_resumes_bit_for_bit(tmp_path: Path) -> None:
    process = forked(killed_in_iteration_four, tmp_path / "killed")
    process.join(120)
    assert process.exitcode == -signal.SIGKILL
    assert torch.load(tmp_path / "killed" / "checkpoint.pt", weights_only=True)["iteration"] == 2
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # sums over threads are not associative
    try:
        for name in ("killed", "whole"):
            post_train(small_config(tmp_path / name), prior=tiny_prior())
    finally:
        torch.set_num_threads(threads)
    ours, theirs = weights(tmp_path / "killed"), weights(tmp_path / "whole")
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    final = [(tmp_path / name / "prior" / "model.safetensors").read_bytes() for name in ("killed", "whole")]
    assert final[0] == final[1]


def test_other_settings_do_not_continue_a_run(tmp_path: Path) -> None:
    post_train(small_config(tmp_path, iterations=2), prior=tiny_prior())
    with pytest.raises(InvalidInputError, match=r"lr was 0\.001, is 0\.5"):
        post_train(small_config(tmp_path, lr=0.5), prior=tiny_prior())


def test_truncated_checkpoint_is_named(tmp_path: Path) -> None:
    post_train(small_config(tmp_path, iterations=2), prior=tiny_prior())
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(CorruptFileError, match=r"checkpoint\.pt.*truncated"):
        post_train(small_config(tmp_path), prior=tiny_prior())


def test_a_run_that_another_prior_began_is_refused_in_plain_words(tmp_path: Path) -> None:
    post_train(small_config(tmp_path, iterations=2), prior=tiny_prior())
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    weights = state["learner"]["prior"]
    name = next(iter(weights))
    weights["its_old_name"] = weights.pop(name)
    torch.save(state, tmp_path / "checkpoint.pt")
    with pytest.raises(InvalidInputError, match=r"cannot be resumed: 2 .* another prior.* another output"):
        post_train(small_config(tmp_path), prior=tiny_prior())


@pytest.mark.slow
def test_full_disk_leaves_the_previous_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save = torch.save

    def full(state: dict, file: object) -> None:
        if state["iteration"] == 4:
            raise OSError(28, "No space left on device")
        save(state, file)

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(TrainingError, match="disk is full"):
        post_train(small_config(tmp_path), prior=tiny_prior())
    monkeypatch.undo()
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["iteration"] == 2
    assert post_train(small_config(tmp_path), prior=tiny_prior()).metrics["iterations"] == 4


def test_nan_gradient_stops_the_run_and_keeps_what_was_good(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    regularise = regularisation_module.add_regularisation_gradient
    calls = []

    def broken(prior: ScenePrior, *args: object, **kwargs: object) -> tuple[float, float]:
        calls.append(1)
        value, norm = regularise(prior, *args, **kwargs)
        if len(calls) == 4:
            next(p for p in prior.parameters() if p.grad is not None).grad.fill_(float("nan"))
        return value, norm

    monkeypatch.setattr(regularisation_module, "add_regularisation_gradient", broken)
    with pytest.raises(TrainingError, match=r"iteration 4 .*not finite.*checkpoint\.pt.*lr"):
        post_train(small_config(tmp_path), prior=tiny_prior())
    state = torch.load(tmp_path / "checkpoint.pt", weights_only=True)
    assert state["iteration"] == 2
    assert all(bool(torch.isfinite(tensor).all()) for tensor in state["learner"]["prior"].values())
    assert len(ScenePrior.load(tmp_path).sample(1, num_steps=2)) == 1


def test_broken_weights_are_said_to_be_broken(tmp_path: Path) -> None:
    prior = tiny_prior()
    next(prior.parameters()).data.fill_(float("nan"))
    with pytest.raises(TrainingError, match="weights are broken"):
        post_train(small_config(tmp_path), prior=prior)


@pytest.mark.parametrize(
    ("scored", "message"),
    [(0, "none of 2 real scenes, so that nothing was sampled"), (2, "no scene of the first batch")],
)
def test_a_reward_that_scores_nothing_ends_the_run_at_once(tmp_path: Path, scored: int, message: str) -> None:
    def raises(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        if len(batch) > scored:
            raise ZeroDivisionError("no")
        return count_objects(batch, context)

    with pytest.raises(TrainingError, match=message):
        post_train(small_config(tmp_path, reward=raises, **{"guard.samples": 0}), prior=tiny_prior())


@pytest.mark.slow
def test_batches_without_valid_reward_change_nothing_and_end_a_run_after_some(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agents.post_training.trainer.MAX_INVALID", 2)
    calls = []

    def fails(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        calls.extend([1] if len(batch) == 6 else [])  # batches, not the real scenes
        return (count_objects if len(calls) <= 1 else not_a_number)(batch, context)

    config = small_config(tmp_path, reward=fails, iterations=3, **{"guard.samples": 0})
    with pytest.raises(TrainingError, match="scored no scene in 2 batches in a row, the last at iteration 3"):
        post_train(config, prior=tiny_prior())
    calls.clear()
    once = post_train(changed(config, {"output": str(tmp_path / "once"), "iterations": 1}), prior=tiny_prior())
    calls.clear()
    twice = post_train(changed(config, {"output": str(tmp_path / "twice"), "iterations": 2}), prior=tiny_prior())
    assert [row["valid_fraction"] for row in twice.history] == [1.0, 0.0]
    assert once.history[0]["reward"] == twice.history[0]["reward"]
    for name, tensor in weights(tmp_path / "once").items():
        assert torch.equal(tensor, weights(tmp_path / "twice")[name])


def test_some_invalid_scenes_leave_the_statistics(tmp_path: Path) -> None:
    def picky(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        value = batch.counts.float()
        value[::2] = 1e6
        return RewardOutput(value, valid=torch.arange(len(batch)) % 2 == 1)

    row = post_train(small_config(tmp_path, reward=picky, iterations=1), prior=tiny_prior()).history[0]
    assert row["valid_fraction"] == 0.5
    assert row["reward"] <= 34


def test_guard_keeps_the_best_within_its_limit_and_stops(tmp_path: Path) -> None:
    config = small_config(
        tmp_path, iterations=40, regularisation=0.0, lr=3e-2, **{"guard.limit": 1.2, "guard.action": "stop"}
    )
    result = post_train(config, prior=tiny_prior())
    guard = result.metrics["guard"]
    assert guard["over_optimised_from"] is not None
    assert result.metrics["iterations"] == guard["over_optimised_from"] < 40
    assert guard["ratio"] <= 1.2 < guard["last_ratio"]
    trainer = PostTrainer(small_config(tmp_path / "again"), prior=tiny_prior())
    trainer.prepare()
    trainer.guard.start(trainer.prior)
    assert trainer.guard.loss(result.prior) / trainer.guard.base_loss == pytest.approx(guard["ratio"], rel=1e-5)


def test_more_slots_than_trained(tmp_path: Path) -> None:
    result = post_train(small_config(tmp_path, iterations=1, slots=40), prior=tiny_prior())
    assert result.history[0]["objects"] <= 40


@pytest.mark.slow
def test_credit_per_object_needs_such_a_reward(tmp_path: Path) -> None:
    def plain(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        return RewardOutput(count_objects(batch, context).value)

    with pytest.raises(InvalidInputError, match="per_object"):
        post_train(small_config(tmp_path, reward=plain, credit="object"), prior=tiny_prior())
    auto = post_train(small_config(tmp_path / "auto", reward=plain, iterations=1), prior=tiny_prior())
    scene = post_train(small_config(tmp_path / "scene", reward=plain, iterations=1, credit="scene"), prior=tiny_prior())
    assert without_seconds(auto.history) == without_seconds(scene.history)


@pytest.mark.parametrize(
    "changes",
    [
        {"batch_size": 1},
        {"lr": 0.0},
        {"credit": "slot"},
        {"bank_size": 8},
        {"regularisation": -1.0},
    ],
)
def test_wrong_settings_are_named(tmp_path: Path, changes: dict) -> None:
    with pytest.raises((InvalidInputError, UnknownNameError), match=next(iter(changes))):
        small_config(tmp_path, **changes)
