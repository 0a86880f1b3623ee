"""Runs: exact at the start and when resumed, safe when something breaks; with prompts, guidance and bad rewards."""

from __future__ import annotations

import csv
import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Generator

from agents.configuration.composition import changed
from agents.diffusion.reverse_steps import concatenate_steps
from agents.post_training import (
    DDPOSFLoss,
    DenoisingPolicy,
    PostTrainer,
    compute_advantages,
    post_train,
    post_train_and_compare,
)
from agents.post_training import learner as learner_module
from agents.post_training import regularisation as regularisation_module
from agents.post_training.doctor import diagnose
from agents.post_training.rollouts import PromptDeck, collect, text_of
from agents.post_training.run_files import SCENES_NAME
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards import allow_local_rewards
from rewards.base import RewardContext, RewardOutput
from scene_envs.datasets import SceneDataset, generate
from scene_envs.datasets.prompts import parse_prompt, scene_facts
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import CorruptFileError, InvalidInputError, TrainingError, UnknownNameError
from scene_envs.scene import SceneBatch
from tests.helpers import hostile_rewards
from tests.helpers.batch_reward import AboveTheMean
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
    whole = post_train(small_config(tmp_path / "whole", guard_every=1, iterations=2, **changes), prior=tiny_prior())
    post_train(small_config(tmp_path / "parts", guard_every=1, iterations=1, **changes), prior=tiny_prior())
    torch.randn(7)  # the global generator has moved on
    parts = post_train(small_config(tmp_path / "parts", guard_every=1, iterations=2, **changes), prior=tiny_prior())
    ours, theirs = weights(tmp_path / "parts"), weights(tmp_path / "whole")
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)
    assert without_seconds(parts.history) == without_seconds(whole.history)
    assert parts.metrics["guard"] == whole.metrics["guard"]


def test_one_step_of_importance_weights_is_the_score_function_and_the_default_is_four(tmp_path: Path) -> None:
    """Before the first step the ratio is 1, so a single step of DDPO-IS is that of DDPO-SF; the next ones are not."""
    trained = {}
    for name, algorithm in {
        "sf": {"name": "ddpo_sf"}, "one": {"name": "ddpo_is", "updates": 1},
        "four": {"name": "ddpo_is", "updates": 4}, "default": {"name": "ddpo_is"},
    }.items():  # fmt: skip
        post_train(small_config(tmp_path / name, iterations=1, algorithm=algorithm), prior=tiny_prior())
        trained[name] = torch.cat([tensor.flatten() for tensor in weights(tmp_path / name).values()])
    assert torch.equal(trained["sf"], trained["one"])
    assert torch.equal(trained["default"], trained["four"])
    assert not torch.equal(trained["default"], trained["one"])


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


def test_prompt_match_without_a_prompt_ends_before_anything_is_sampled(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="prompt_match has no prompt to compare with: give prompt="):
        post_train(small_config(tmp_path, reward="prompt_match"), prior=tiny_prior())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"reward": AboveTheMean(), "algorithm.credit": "object"}, r"take algorithm\.credit=scene, or auto"),
        (
            {"reward": AboveTheMean(), "algorithm.credit": "object", "prompt": "A scene with two cups."},
            r"take algorithm\.credit=scene, or auto",
        ),
    ],
)
def test_what_a_run_lacks_is_told_before_anything_is_sampled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], message: str
) -> None:
    prior = tiny_prior(process="mixed", text=True)
    monkeypatch.setattr(type(prior), "sample", None)
    monkeypatch.setattr(learner_module, "collect", None)
    config = changed(small_config(tmp_path), changes)
    with pytest.raises(InvalidInputError, match=message):
        post_train(config, prior=prior)
    assert not (tmp_path / "prior").exists()


def test_real_scenes_are_scored_with_their_own_prompts_before_anything_is_sampled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def no_scene(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        asked.append(context.prompts)
        return RewardOutput(batch.counts.float(), valid=torch.zeros(len(batch), dtype=torch.bool))

    monkeypatch.setattr(learner_module.Learner, "rollout", None)  # nothing is sampled
    config = changed(small_config(tmp_path, reward=no_scene), {"prompt": "data", "guard.samples": 0})
    with pytest.raises(TrainingError, match=r"scored none of \d+ real scenes with a prompt, so that nothing"):
        post_train(config, prior=tiny_prior(process="mixed", text=True))
    texts = asked[-1]
    batch = SceneBatch.load(tmp_path / SCENES_NAME)[:8]
    own = np.repeat(np.arange(8), len(texts) // 8)
    for text, facts in zip(texts, scene_facts(batch[torch.from_numpy(own)]), strict=True):
        assert all(check.holds for check in parse_prompt(text, batch.scene_type).check(facts))


def test_a_reward_that_reads_one_kind_of_prompts_alone_is_not_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def relations_alone(batch: SceneBatch, context: RewardContext) -> RewardOutput:
        valid = [text.startswith("A scene where") for text in context.prompts or [""] * len(batch)]
        return RewardOutput(batch.counts.float(), valid=torch.tensor(valid))

    monkeypatch.setattr(learner_module.Learner, "rollout", None)
    config = changed(small_config(tmp_path, reward=relations_alone), {"prompt": "data", "guard.samples": 0})
    with pytest.raises(TypeError, match="'NoneType' object is not callable"):  # sampling would begin
        post_train(config, prior=tiny_prior(process="mixed", text=True))


def test_steps_of_chunks_keep_the_scenes_that_the_network_expects() -> None:
    prior = tiny_prior(process="mixed", text=True, kernel="squared_absorbing")
    step = prior.transition(prior.initial(3, 34), 5, prior.step_table(20))
    joined = concatenate_steps([step, step])
    assert joined.denoised is not None
    assert step.denoised is not None
    torch.testing.assert_close(joined.denoised, torch.cat([step.denoised, step.denoised]))
    assert concatenate_steps([step, step.take(torch.arange(3))]).denoised is None


TWO = ["A scene with two cups.", "A scene with 20 objects."]
SLOTS = 12


def reader() -> ScenePrior:
    return tiny_prior(process="mixed", text=True)


def longest_prompt(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """A reward of the prompt alone."""
    assert context.prompts is not None
    return RewardOutput(torch.tensor([float(len(prompt)) for prompt in context.prompts]))


def test_prompts_are_dealt_in_groups_without_repetition() -> None:
    texts = [f"A scene with {n} objects." for n in range(6)]
    dealt = PromptDeck(texts, share=3).deal(13, Generator().manual_seed(0))
    runs = [dealt[:4], dealt[4:7], dealt[7:10], dealt[10:]]
    assert [len(set(run)) for run in runs] == [1, 1, 1, 1]
    assert len(set(dealt)) == 4
    assert dealt == PromptDeck(texts, share=3).deal(13, Generator().manual_seed(0))
    assert len(set(PromptDeck(texts[:2], share=2).deal(8, Generator().manual_seed(0)))) == 2


def test_scenes_are_compared_with_those_of_the_same_prompt(tmp_path: Path) -> None:
    """A reward of the prompt alone teaches nothing: within a prompt all are equal."""
    config = small_config(tmp_path, prompt=TWO, scenes_per_prompt=3, reward=longest_prompt)
    trainer = PostTrainer(config, prior=reader())
    trainer.prepare()
    batch = trainer.learner.write_advantage(trainer.learner.rollout(0))
    reward = batch["next", "reward"][:, -1, 0]
    assert sorted(set(trainer.learner.env.core.prompts or ())) == sorted(TWO)
    assert len(set(reward.tolist())) == 2
    assert (batch["advantage"] == 0).all()
    assert (compute_advantages(reward) != 0).all()
    trainer.close()


@pytest.mark.slow
@pytest.mark.parametrize(("guidance", "chunk"), [(0.0, None), (1.0, 4)])
def test_log_ratio_of_a_prompted_run_is_exactly_zero_before_the_first_update(
    tmp_path: Path, guidance: float, chunk: int | None
) -> None:
    config = small_config(tmp_path, iterations=1, gradient_steps=4, chunk=chunk, prompt=TWO, guidance=guidance)
    trainer = PostTrainer(config, prior=reader())
    trainer.prepare()
    assert trainer.step()[1]["log_ratio"] == 0.0
    trainer.close()


def test_the_policy_depends_on_the_prompt_in_rollout_and_gradient() -> None:
    prior = reader()
    env = DenoisingTorchRLEnv(4, prior=prior, num_steps=3, prompt=TWO)
    policy = DenoisingPolicy(prior, 3)
    transitions = collect(env, policy, seed=0, prompts=[TWO[0]] * 4)[:, 0]
    assert env.core.prompts == (TWO[0],) * 4
    scene, action, text = transitions["scene"], transitions["action"], text_of(transitions)
    assert text is not None
    other = policy.read(env.core.prompting.read([TWO[1]] * 4))
    log_prob = policy.log_prob(scene, 0, action, text)
    torch.testing.assert_close(log_prob, transitions["slot_log_prob"], atol=0, rtol=0)
    assert not torch.equal(log_prob, policy.log_prob(scene, 0, action, other))
    transitions["advantage"] = torch.tensor([1.0, -1.0, 0.5, 2.0])
    from_tokens = transitions.exclude("text", "text_mask")
    losses = [DDPOSFLoss(policy)(kind)["loss_objective"] for kind in (transitions, from_tokens)]
    torch.testing.assert_close(losses[0], losses[1])


def test_the_torchrl_policy_reads_the_prompt_of_the_environment() -> None:
    prior = reader()
    env = DenoisingTorchRLEnv(2, prior=prior, num_steps=3, prompt=TWO[1])
    env.set_seed(0)
    assert DenoisingPolicy(prior, 3).in_keys == ["scene", "timestep", "prompt"]
    rollout = env.rollout(3, DenoisingPolicy(prior, 3))
    transitions = rollout[:, 0].exclude("next").set("advantage", torch.tensor([1.0, -1.0]))
    policy = DenoisingPolicy(prior, 3)
    log_prob = policy.log_prob(transitions["scene"], 0, transitions["action"], policy.read(transitions["prompt"]))
    torch.testing.assert_close(log_prob.sum(dim=1), transitions["action_log_prob"], atol=1e-4, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("prompt", [None, "data"])
def test_the_text_encoder_stays_as_it_is(tmp_path: Path, prompt: str | None) -> None:
    prior = reader()
    result = post_train(small_config(tmp_path, iterations=2, prompt=prompt, scenes_per_prompt=3), prior=prior)
    assert isinstance(prior, MixedPrior)
    assert isinstance(result.prior, MixedPrior)
    before, after = prior.weights(), result.prior.weights()
    trained = weights(tmp_path)
    assert all(torch.equal(before[name], after[name]) for name in before if name.startswith("text_encoder."))
    prefix = "denoiser.network."
    assert any(not torch.equal(before[name], trained[prefix + name]) for name in before if "text" not in name)
    assert all(p.requires_grad for p in prior.parameters())  # the base prior is left as it was


@pytest.mark.slow
def test_stopped_and_resumed_prompted_run_equals_the_uninterrupted_one(tmp_path: Path) -> None:
    changes = {"prompt": "data", "scenes_per_prompt": 2, "reward": count_objects}
    post_train(small_config(tmp_path / "whole", guard_every=1, iterations=2, **changes), prior=reader())
    post_train(small_config(tmp_path / "parts", guard_every=1, iterations=1, **changes), prior=reader())
    torch.randn(7)
    post_train(small_config(tmp_path / "parts", guard_every=1, iterations=2, **changes), prior=reader())
    ours, theirs = weights(tmp_path / "parts"), weights(tmp_path / "whole")
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_prompts_of_real_scenes_that_do_not_fit_are_refused_at_the_start(tmp_path: Path) -> None:
    trainer = PostTrainer(small_config(tmp_path, slots=4, prompt="data"), prior=reader())
    with pytest.raises(InvalidInputError, match=r"asks for \d+ objects, a scene has 4 slots; give slots=\d+ or more"):
        trainer.prepare()
    trainer.close()


@pytest.mark.slow
def test_real_scenes_bring_their_own_prompts(tmp_path: Path) -> None:
    generate("dimsum_table", 24, tmp_path / "data", seed=0, workers=0)
    dataset = SceneDataset.load(tmp_path / "data")
    config = small_config(
        tmp_path / "run", **{"regularisation.scenes": str(tmp_path / "data")}, bank_size=20, prompt="data"
    )
    trainer = PostTrainer(config, prior=reader())
    trainer.prepare()
    scenes = trainer.scenes
    assert scenes.prompts is not None
    known = {bytes(scene.numpy()): set(texts) for scene, texts in zip(dataset.tensor, dataset.prompt_sets, strict=True)}
    every = SceneBatch.load(tmp_path / "run" / "real_scenes.safetensors").tensor
    for i in range(20):
        assert set(scenes.prompts(i)) == known[bytes(every[i, : dataset.tensor.shape[1]].numpy())]
    batch = scenes.batch(200, Generator().manual_seed(0))
    x0, texts = batch.scenes, batch.prompts
    assert texts is not None
    assert 5 <= sum(text == "" for text in texts) <= 40
    for scene, text in zip(x0, texts, strict=True):
        row = int((scenes.train == scene).all(dim=(1, 2)).nonzero()[0])
        assert text == "" or text in scenes.prompts(row)
    trainer.learner.rollout(0)
    prompts = trainer.learner.env.core.prompts
    assert prompts is not None
    assert set(prompts) <= {text for i in range(12) for text in scenes.prompts(i)}
    trainer.close()


@pytest.mark.slow
def test_prompts_of_a_run_that_never_saved_are_not_taken_for_those_of_other_scenes(tmp_path: Path) -> None:
    generate("dimsum_table", 24, tmp_path / "data", seed=0, workers=0)
    trainer = PostTrainer(
        small_config(
            tmp_path / "run", **{"regularisation.scenes": str(tmp_path / "data")}, bank_size=20, prompt="data"
        ),
        prior=reader(),
    )
    trainer.prepare()
    trainer.close()
    known = [set(trainer.scenes.prompts(i)) for i in range(20)]  # type: ignore[misc]
    other = PostTrainer(small_config(tmp_path / "run", prompt="data"), prior=reader())
    other.prepare()
    other.close()
    assert other.scenes.prompts is not None
    assert any(not set(other.scenes.prompts(i)) <= known[i] for i in range(20))
    batch = SceneBatch.load(tmp_path / "run" / "real_scenes.safetensors")
    for i in range(20):
        facts = scene_facts(batch[i])
        for text in other.scenes.prompts(i):
            assert all(check.holds for check in parse_prompt(text, "dimsum_table").check(facts[0])), text


@pytest.mark.slow
def test_the_doctor_examines_a_prompted_run(tmp_path: Path) -> None:
    report = diagnose(small_config(tmp_path, prompt=TWO, scenes_per_prompt=3), prior=reader())
    assert report.log_ratio == 0.0
    assert report.policy_gradient_norm > 0
    alike = small_config(tmp_path, prompt=TWO, scenes_per_prompt=3, reward=longest_prompt)
    assert any("not within any" in line for line in diagnose(alike, prior=reader()).advice)


@pytest.mark.slow
def test_the_report_compares_samples_with_their_prompts(tmp_path: Path) -> None:
    pytest.importorskip("pybullet")
    prior = tiny_prior(process="mixed", text=True, slots=4)
    metrics = post_train_and_compare(
        small_config(tmp_path, iterations=1, prompt="A scene with 5 objects.", slots=5),
        scenes=2,
        num_steps=2,
        prior=prior,
    )
    assert 0.0 <= metrics["before"]["prompt_match"] <= 1.0
    assert "match of prompt and scene" in (tmp_path / "report.html").read_text()


def test_prompts_that_cannot_be_followed_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="trained without text"):
        post_train(small_config(tmp_path, prompt=TWO), prior=tiny_prior())
    with pytest.raises(InvalidInputError, match="guidance=1 strengthens a prompt"):
        small_config(tmp_path, guidance=1.0)
    with pytest.raises(InvalidInputError, match=r"prompt=\[\] must be"):
        small_config(tmp_path, prompt=[])
    with pytest.raises(InvalidInputError, match="scenes_per_prompt=1"):
        small_config(tmp_path, scenes_per_prompt=1)
    with pytest.raises(InvalidInputError, match="asks for 200 objects"):
        post_train(small_config(tmp_path, prompt="A scene with 200 objects."), prior=reader())


def test_the_guard_asks_for_no_more_objects_than_there_are_slots(tmp_path: Path) -> None:
    keys = {"prompt": "A scene with 3 objects.", "slots": 8, "guard.scenes": 20, "guard.samples": 20, "bank_size": 40}
    trainer = PostTrainer(small_config(tmp_path, **keys), prior=reader())
    trainer.prepare()
    assert trainer.guard.samples is not None
    prompts = trainer.guard.samples.prompts
    assert prompts is not None
    assert len(prompts) == 20
    assert "" in prompts  # in place of those of fuller scenes
    assert any(prompts)
    trainer.guard.start(trainer.prior)
    trainer.close()


FILE = Path(hostile_rewards.__file__)


def rewards_of(output: Path, seed: int) -> list[float]:
    config = small_config(output, reward=hostile_rewards.noisy, iterations=2, seed=seed)
    return [row["reward"] for row in post_train(config, prior=tiny_prior()).history]


@pytest.mark.slow
def test_a_reward_that_draws_from_global_generators_gives_the_same_run_for_the_same_seed(tmp_path):
    torch.manual_seed(1)
    first = rewards_of(tmp_path / "a", 0)
    torch.manual_seed(2)
    assert rewards_of(tmp_path / "b", 0) == first
    assert rewards_of(tmp_path / "c", 1) != first


@pytest.mark.slow
@pytest.mark.usefixtures("copied_workers")
def test_a_reward_that_ends_its_process_ends_a_run_with_an_error_and_never_with_success(tmp_path, caplog):
    allow_local_rewards(FILE)
    config = small_config(tmp_path, reward=f"{FILE}:quits")
    with pytest.raises(TrainingError, match="scored none of 2 real scenes"):
        post_train(config, prior=tiny_prior())
    assert "ended its process (exit status 0)" in caplog.text


@pytest.mark.slow
@pytest.mark.usefixtures("copied_workers")
def test_a_reward_of_a_file_gives_the_run_of_the_same_function(tmp_path):
    allow_local_rewards(FILE)
    runs = [
        post_train(small_config(tmp_path / name, reward=reward, iterations=2), prior=tiny_prior()).history
        for name, reward in (("file", f"{FILE}:noisy"), ("function", hostile_rewards.noisy))
    ]
    assert [row["reward"] for row in runs[0]] == [row["reward"] for row in runs[1]]
    assert [row["gradient_norm"] for row in runs[0]] == [row["gradient_norm"] for row in runs[1]]
