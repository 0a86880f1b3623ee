"""Runs of priors that read prompts: which scene follows which, what is compared, and what is exact."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Generator

from agents.post_training import (
    DDPOSFLoss,
    DenoisingPolicy,
    PostTrainer,
    compute_advantages,
    post_train,
    post_train_and_compare,
)
from agents.post_training.doctor import diagnose
from agents.post_training.rollouts import PromptDeck, collect, text_of
from agents.priors.mixed import MixedPrior
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from rewards.base import RewardContext, RewardOutput
from scene_envs.datasets import SceneDataset, generate
from scene_envs.datasets.prompts import parse_prompt, scene_facts
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from tests.helpers.small_runs import count_objects, small_config

TWO = ["A scene with two cups.", "A scene with 20 objects."]
SLOTS = 12


def reader() -> ScenePrior:
    return tiny_prior(process="mixed", text=True)


def weights(path: Path) -> dict[str, torch.Tensor]:
    tensors: dict[str, torch.Tensor] = torch.load(path / "checkpoint.pt", weights_only=True)["learner"]["prior"]
    return tensors


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
def test_log_ratio_is_exactly_zero_before_the_first_update(tmp_path: Path, guidance: float, chunk: int | None) -> None:
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
def test_stopped_and_resumed_run_equals_the_uninterrupted_one(tmp_path: Path) -> None:
    changes = {"prompt": "data", "scenes_per_prompt": 2, "reward": count_objects}
    post_train(small_config(tmp_path / "whole", iterations=3, **changes), prior=reader())
    post_train(small_config(tmp_path / "parts", iterations=2, **changes), prior=reader())
    torch.randn(7)
    post_train(small_config(tmp_path / "parts", iterations=3, **changes), prior=reader())
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
