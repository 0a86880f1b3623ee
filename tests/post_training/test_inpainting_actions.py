"""Post-training inside inpainting: only masked entries are actions."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents.priors.prior import ScenePrior
from scipy.stats import norm
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.diffusion.reverse_steps import GaussianStep, MixedStep, concatenate_steps
from agents.post_training import AWMLoss, DDPOSFLoss, DenoisingPolicy, NFTLoss, PostTrainConfig, RewardWeightedLoss
from agents.post_training.inpaint_deck import InpaintDeck, real_parts, sampled_parts
from agents.post_training.inpaint_settings import InpaintSettings
from agents.post_training.rollouts import Rollout, collect
from agents.post_training.run_files import CHECKPOINT_NAME, load_resumable
from agents.post_training.trainer import PostTrainer
from agents.priors.testing import tiny_prior
from agents.utils.checkpoints import save_checkpoint
from agents.utils.seeds import derived_seed
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.envs.scoring import RewardScorer
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.scene import SceneBatch

STEPS = 4


@pytest.fixture(scope="module", params=["mixed", "continuous"])
def prior(request: pytest.FixtureRequest) -> ScenePrior:
    return tiny_prior("dimsum_table", process=request.param)


@pytest.fixture(scope="module")
def real() -> SceneBatch:
    return get_grammar("dimsum_table").sample(np.random.default_rng(0), 6)


def half(count: int, slots: int = 34) -> Tensor:
    """(count, slots, 2): poses and categories of a random half, drawn apart."""
    return torch.rand(count, slots, 2, generator=Generator().manual_seed(1)) < 0.5


def sampled(prior: ScenePrior, real: SceneBatch, mask: Tensor | None) -> Rollout:
    env = DenoisingTorchRLEnv(len(real), prior=prior, reward="object_count", num_steps=STEPS)
    observed = None if mask is None else prior.observe(real, mask)
    return collect(env, DenoisingPolicy(prior, STEPS), seed=3, observed=observed)


class TestSteps:
    """One step of a chain, some entries of which are observed."""

    def gaussian(self) -> tuple[GaussianStep, Tensor, Tensor]:
        mean = torch.tensor([[[0.0, 1.0, 2.0]], [[3.0, 4.0, 5.0]]], requires_grad=True)
        entries = torch.tensor([[[True, False, False]], [[False, False, True]]])
        x = torch.tensor([[[9.0, 1.5, 2.0]], [[3.0, 3.0, 7.0]]])
        return GaussianStep(mean, torch.tensor([[0.5, 2.0, 0.0]])).observing(entries, x), mean, x

    def test_the_gradient_of_log_p_is_zero_on_observed_entries_and_the_score_on_the_others(self) -> None:
        step, mean, x = self.gaussian()
        step.log_prob(x).sum().backward()
        # (x - mean) / std^2 where an entry is random and not observed
        assert mean.grad.tolist() == [[[0.0, 0.125, 0.0]], [[0.0, -0.25, 0.0]]]

    def test_log_p_is_that_of_the_other_entries(self) -> None:
        step, _, x = self.gaussian()
        expected = [norm.logpdf(1.5, 1.0, 2.0), norm.logpdf(3.0, 3.0, 0.5) + norm.logpdf(3.0, 4.0, 2.0)]
        assert step.log_prob(x)[:, 0].tolist() == pytest.approx(expected, rel=1e-6)
        assert step.entries.tolist() == [1, 2]

    def test_whatever_the_noise_observed_entries_stay(self) -> None:
        step, _, x = self.gaussian()
        drawn = step.from_noise(torch.full((2, 1, 3), 7.0))
        assert drawn[0, 0, 0] == x[0, 0, 0]
        assert drawn[1, 0, 2] == x[1, 0, 2]
        assert torch.equal(concatenate_steps([step, step]).std, torch.cat([step.std, step.std]))
        assert torch.equal(step.take(torch.tensor([1, 1])).std, step.std[[1, 1]])

    def test_observed_categories_carry_no_probability(self) -> None:
        probs = torch.tensor([[[0.2, 0.3, 0.5], [0.6, 0.1, 0.3]]], requires_grad=True)
        plain = MixedStep(torch.zeros(1, 2, 1), torch.ones(2, 1), probs, torch.ones(2, dtype=torch.bool))
        x = torch.tensor([[[0.0, 1.0, 0.0], [0.5, 0.0, 1.0]]])
        pose, category = torch.tensor([[True, False]]), torch.tensor([[False, True]])
        step = plain.observing(pose, category, x)
        assert step.log_prob(x)[0].tolist() == pytest.approx([np.log(0.2), norm.logpdf(0.5)], rel=1e-6)
        step.log_prob(x).sum().backward()
        assert probs.grad[0].tolist() == [[pytest.approx(5.0), 0.0, 0.0], [0.0, 0.0, 0.0]]
        assert step.from_noise(torch.full((1, 2, 3), -3.0))[0, 1, 1:].tolist() == [0.0, 1.0]
        assert step.entries.tolist() == [2]


def test_observed_entries_come_out_bit_equal(prior: ScenePrior, real: SceneBatch) -> None:
    slots = half(len(real))[..., 0]
    slots[:, 0] = True  # the table, which stays all the same
    rollout = sampled(prior, real, slots)
    kept = ~slots
    kept[:, 0] = True
    assert torch.equal(rollout.batch.tensor[kept], real.tensor[kept])
    assert not torch.equal(rollout.batch.tensor[~kept], real.tensor[~kept])
    assert torch.equal(rollout.observed, torch.stack([kept, kept], dim=-1))
    assert rollout.reward.tolist() == rollout.batch.counts.tolist()  # of the whole scenes


def test_poses_and_categories_are_observed_apart(prior: ScenePrior, real: SceneBatch) -> None:
    poses = torch.stack([real.is_free, torch.zeros_like(real.is_free)], dim=-1)
    batch = sampled(prior, real, poses).batch
    assert torch.equal(batch.categories, real.categories)
    assert not torch.equal(batch.translations[real.is_free], real.translations[real.is_free])


def test_states_of_a_continuous_prior_have_the_noise_of_their_level(real: SceneBatch) -> None:
    prior = tiny_prior("dimsum_table")
    many = SceneBatch(real.tensor[:1].expand(400, -1, -1).clone(), real.scene_type)
    observed = prior.observe(many, torch.zeros(400, 34, dtype=torch.bool))
    level = 300
    generator = Generator().manual_seed(0)
    x = observed.write(
        torch.zeros_like(observed.x0), level, lambda: torch.randn(observed.x0.shape, generator=generator)
    )
    free = ~prior.known(34)
    alpha, sigma = prior.process.alpha[level], prior.process.sigma[level]
    assert (x.mean(dim=0) - alpha * observed.x0[0])[free].abs().max() < 6 * sigma / 20
    assert x.std(dim=0)[free].mean() == pytest.approx(float(sigma), rel=0.01)
    assert torch.equal(observed.write(torch.zeros_like(x), 0), observed.x0)


def test_the_same_policy_scores_what_it_drew_with_a_log_ratio_of_zero(prior: ScenePrior, real: SceneBatch) -> None:
    rollout = sampled(prior, real, half(len(real)))
    loss = DDPOSFLoss(DenoisingPolicy(prior, STEPS), reduction="mean", clip_epsilon=0.2)
    for step in range(STEPS - 1):
        assert float(loss(rollout.transitions(step, torch.ones(len(real))))["log_ratio"]) == 0.0


@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_what_is_observed_has_no_part_in_ddpo(prior: ScenePrior, real: SceneBatch, reduction: str) -> None:
    rollout, loss = (
        sampled(prior, real, half(len(real))),
        DDPOSFLoss(DenoisingPolicy(prior, STEPS), reduction=reduction),
    )
    transitions = rollout.transitions(1, torch.linspace(-1, 1, len(real)))
    once = loss(transitions)["loss_objective"]
    widths = torch.tensor([prior.pose_width, prior.features - prior.pose_width])
    entries = rollout.observed.repeat_interleave(widths, dim=-1)
    other = transitions.clone()
    other["action"] = torch.where(entries, transitions["action"] + 5.0, transitions["action"])
    assert loss(other)["loss_objective"] == once
    assert loss(transitions.exclude("observed"))["loss_objective"] != once


def test_with_everything_masked_ddpo_is_the_plain_one(prior: ScenePrior, real: SceneBatch) -> None:
    prior = observing(prior)
    inside = sampled(prior, real, torch.ones(len(real), 34, dtype=torch.bool))
    plain = sampled(prior, real, None)
    assert torch.equal(inside.scenes[-1], plain.scenes[-1])
    for reduction in ("mean", "sum"):
        loss = DDPOSFLoss(DenoisingPolicy(prior, STEPS), reduction=reduction)
        advantage = torch.linspace(-1, 1, len(real))
        for step in range(STEPS - 1):
            transitions = plain.transitions(step, advantage)
            whole = transitions.clone()
            whole["observed"] = inside.observed
            assert loss(whole)["loss_objective"] == loss(transitions)["loss_objective"]


def observing(prior: ScenePrior) -> ScenePrior:
    """A prior that is told of its fixed objects in any case, as those that ship are."""
    copy = deepcopy(prior)
    if prior.process_name == "mixed":
        copy.config = replace(copy.config, observed_share=0.5)
    return copy


def losses(prior: ScenePrior) -> list[Any]:
    other = tiny_prior("dimsum_table", seed=5, process=prior.process_name)
    return [NFTLoss(prior, other), AWMLoss(prior, other), RewardWeightedLoss(prior, other)]


@pytest.mark.parametrize("kind", range(3))
def test_forward_losses_have_no_gradient_on_observed_entries(
    prior: ScenePrior, real: SceneBatch, kind: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    loss = losses(prior)[kind]
    x0, mask = prior.encode(real), half(len(real))
    observed = prior.observe(real, mask).entries
    made = []
    output = prior.output

    def noted(*arguments: Any) -> Any:
        result = output(*arguments)
        made.append(result)
        for tensor in (result.continuous, result.logits):
            if tensor is not None and tensor.requires_grad:
                tensor.retain_grad()
        return result

    monkeypatch.setattr(prior, "output", noted)
    ones = torch.ones(len(real))
    scenes = TensorDict({"scene": x0, "advantage": ones, "category_advantage": ones, "observed": observed}, [len(real)])
    scenes["timestep"] = torch.full((len(real),), 400)
    loss(scenes)["loss_objective"].backward()
    gradient = made[0].continuous.grad
    width = prior.pose_width
    assert not gradient[..., :width][observed[..., 0]].any()
    assert gradient[..., :width][~observed[..., 0]].any()
    categories = gradient[..., width:] if made[0].logits is None else made[0].logits.grad
    assert not categories[observed[..., 1]].any()
    assert categories[~observed[..., 1]].any()


@pytest.mark.parametrize("kind", range(3))
def test_with_everything_masked_forward_losses_are_the_plain_ones(
    prior: ScenePrior, real: SceneBatch, kind: int
) -> None:
    loss = losses(prior)[kind]
    x0 = prior.encode(real)
    everything = prior.observe(real, torch.ones(len(real), 34, dtype=torch.bool)).entries
    scenes = TensorDict({"scene": x0, "advantage": torch.linspace(-1, 1, len(real))}, [len(real)])
    told = prior.observed_entries(x0) if prior.process_name == "mixed" else None
    noised = prior.noised(x0, Generator().manual_seed(2), observed=prior.observed_by_mask(x0, everything))
    plain = prior.noised(x0, Generator().manual_seed(2), observed=told)
    if told is None and prior.process_name == "mixed":
        noised = replace(noised, observed=None)  # a network that is told nothing of its fixed objects
    inside, whole = (loss.of_noised(each, scenes)["loss_objective"].item() for each in (noised, plain))
    assert inside == pytest.approx(whole, rel=1e-6)


class TestDeck:
    """Observed parts, dealt to the episodes of a batch."""

    def deck(self, source: Any, share: int = 3, **settings: Any) -> InpaintDeck:
        return InpaintDeck(InpaintSettings(**settings), source, RewardScorer("object_count"), share)

    def test_neighbours_share_a_part_and_another_seed_deals_others(self, real: SceneBatch) -> None:
        deck = self.deck(real_parts(real, 34), mask="random")
        parts = deck.deal(6, None, seed=1)
        assert parts.groups.tolist() == [0, 0, 0, 1, 1, 1]
        assert torch.equal(parts.scenes.tensor[0], parts.scenes.tensor[2])
        assert torch.equal(parts.mask[3], parts.mask[5])
        assert not torch.equal(parts.scenes.tensor[0], parts.scenes.tensor[3])
        again, other = deck.deal(6, None, seed=1), deck.deal(6, None, seed=2)
        assert torch.equal(again.mask, parts.mask)
        assert not torch.equal(other.mask, parts.mask)
        free = parts.scenes.is_free & parts.mask[..., 0]
        assert free.sum(dim=1).tolist() == [(n + 1) // 2 for n in parts.scenes.is_free.sum(dim=1).tolist()]

    def test_poses_alone_leave_categories_and_empty_slots(self, real: SceneBatch) -> None:
        parts = self.deck(real_parts(real, 34), mask="random", entries="poses").deal(4, None, seed=0)
        assert not parts.mask[..., 1].any()
        assert not (parts.mask[..., 0] & ~parts.scenes.is_free).any()

    def test_a_mask_that_leaves_nothing_is_refused(self, real: SceneBatch) -> None:
        with pytest.raises(
            InvalidInputError, match=r"leaves nothing to regenerate in 8 scenes of inpaint\.scenes=real"
        ):
            self.deck(real_parts(real, 34), mask={"name": "region", "low": [5, 5, 5], "empty": 0}).deal(6, None, 0)

    def test_real_scenes_that_do_not_fit_are_refused(self, real: SceneBatch) -> None:
        with pytest.raises(InvalidInputError, match="none of 6 real scenes fits into slots=2"):
            real_parts(real, 2)

    def test_samples_come_from_the_prior_with_its_prompts(self) -> None:
        prior = tiny_prior("dimsum_table", process="mixed", text=True)
        texts = ["A scene with 5 objects."] * 3 + ["A scene with 9 objects."] * 3
        parts = self.deck(sampled_parts(prior, 2, 34), mask="random").deal(6, texts, seed=4)
        assert parts.prompts == texts
        expected = prior.sample(2, prompt=[texts[0], texts[3]], num_steps=2, slots=34, seed=derived_seed(4, 0))
        assert torch.equal(parts.scenes.tensor[[0, 3]], expected.tensor)


def config(output: Path, **keys: Any) -> PostTrainConfig:
    small: dict[str, Any] = {
        "output": str(output), "iterations": 2, "batch_size": 6, "num_steps": STEPS, "reward": "object_count",
        "regularisation": {"bank_size": 20, "batch_size": 6}, "guard": {"scenes": 8, "samples": 0},
        "logger": {"progress": "none", "report_scenes": 0}, "inpaint": {"mask": "random"},
    }  # fmt: skip
    return PostTrainConfig(**{**small, **keys})


def algorithm(name: str) -> dict[str, Any]:
    few = {"guidance_distillation": {"updates": 1, "draws": 1}}.get(name, {})
    return {"name": name, "scenes_per_prompt": 3, **few, **({"gradient_steps": 2} if name.startswith("ddpo") else {})}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["ddpo_sf", "ddpo_is", "nft", "awm", "guidance_distillation", "neon", "reward_weighted"]
)
def test_every_algorithm_trains_inside_inpainting(tmp_path: Path, prior: ScenePrior, name: str) -> None:
    source = "samples" if name in ("ddpo_is", "awm") else "real"
    keys: dict[str, Any] = {"algorithm": algorithm(name), "inpaint": {"mask": "random", "scenes": source}}
    if name in ("ddpo_sf", "nft"):
        keys["regularisation"] = {"bank_size": 20, "batch_size": 4, "kl": 0.1}
    trainer = PostTrainer(config(tmp_path, **keys), prior=prior)
    result = trainer.run()
    assert len(result.history) == 2
    assert all(np.isfinite(row["gradient_norm"]) and row["gradient_norm"] > 0 for row in result.history)
    if name.startswith("ddpo"):
        assert result.history[0]["log_ratio"] == 0.0
    first = trainer.learner.rollout(0)
    assert first.groups is not None
    assert first.groups.tolist() == [0, 0, 0, 1, 1, 1]
    trainer.close()


def test_objects_that_are_observed_have_no_credit(tmp_path: Path, prior: ScenePrior) -> None:
    trainer = PostTrainer(config(tmp_path, algorithm=algorithm("ddpo_sf")), prior=prior)
    trainer.prepare()
    rollout = trainer.learner.rollout(0)
    advantage = trainer.learner.algorithm.advantage(rollout)
    assert advantage.shape == (6, 34)  # object_count gives credit per object
    assert not advantage[rollout.observed.all(dim=-1)].any()
    trainer.close()


def test_unknown_masks_are_refused_before_anything_is_written(tmp_path: Path, prior: ScenePrior) -> None:
    with pytest.raises(UnknownNameError, match="random"):
        PostTrainer(config(tmp_path / "run", inpaint={"mask": "randm"}), prior=prior)
    assert not (tmp_path / "run").exists()
    with pytest.raises(InvalidInputError, match="register_mask"):
        config(tmp_path, inpaint={"mask": 3})
    with pytest.raises(UnknownNameError, match="samples"):
        config(tmp_path, inpaint={"mask": "random", "scenes": "sampled"})


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ({"name": "random", "share": 0.3}, None),
        ({"name": "random", "share": 0.3}, "random"),
        ({"name": "random", "share": 0.3}, {"name": "random"}),
        (None, {"name": "random", "share": 0.3}),
    ],
)
def test_a_run_is_not_resumed_with_another_mask(tmp_path: Path, before: Any, now: Any) -> None:
    save_checkpoint(tmp_path / CHECKPOINT_NAME, {"config": config(tmp_path, inpaint={"mask": before}).plain()})
    assert load_resumable(tmp_path, config(tmp_path, inpaint={"mask": before})) is not None
    with pytest.raises(InvalidInputError, match=r"inpaint\.mask was"):
        load_resumable(tmp_path, config(tmp_path, inpaint={"mask": now}))


def test_entries_are_counted_without_a_whole_chain(prior: ScenePrior, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, calls = DenoisingPolicy(prior, 5), []
    transition = type(prior).transition

    def counted(self: ScenePrior, *arguments: Any, **keys: Any) -> Any:
        calls.append(1)
        return transition(self, *arguments, **keys)

    monkeypatch.setattr(type(prior), "transition", counted)
    observed = torch.zeros(2, 34, 2, dtype=torch.bool)
    entries = [policy.unobserved_entries(observed) for _ in range(3)]
    assert len(calls) == 1
    assert entries[0].tolist() == entries[2].tolist() == [policy.random_entries(34)] * 2
