"""A training loop of torchrl's own parts: collector, policy, and the public advantage and loss."""

from __future__ import annotations

import torch
from torchrl.collectors import Collector

from agents.post_training import Advantage, DDPOSFLoss, DenoisingPolicy
from agents.priors.testing import tiny_prior
from rewards.base import RewardContext, RewardOutput
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.scene import SceneBatch

SCENES, STEPS = 16, 4


def to_the_front(batch: SceneBatch, context: RewardContext) -> RewardOutput:
    """Mean of the objects' x; scenes with an odd number of objects have no score."""
    return RewardOutput(batch.translations[..., 0].mean(dim=1), valid=batch.counts % 2 == 0)


def test_every_step_of_the_loop_improves_its_batch_and_the_next_is_sampled_with_it() -> None:
    prior = tiny_prior(slots=12)
    policy = DenoisingPolicy(prior, STEPS)
    env = DenoisingTorchRLEnv(SCENES, prior=prior, reward=to_the_front, num_steps=STEPS, slots=12)
    env.set_seed(0)
    torch.manual_seed(0)
    collector = Collector(env, policy, frames_per_batch=SCENES * STEPS, total_frames=3 * SCENES * STEPS)
    advantage, loss = Advantage(), DDPOSFLoss(policy, reduction="mean", clip_epsilon=0.2)
    optimizer = torch.optim.SGD(policy.parameters(), lr=1e-3)
    iterations = 0
    for batch in collector:
        before = loss(advantage(batch))
        optimizer.zero_grad()
        before["loss_objective"].backward()
        optimizer.step()
        assert float(before["log_ratio"]) == 0.0  # the collector samples with the weights of now
        after = loss(batch)
        assert float(after["loss_objective"].detach()) < float(before["loss_objective"].detach())
        assert float(after["log_ratio"]) > 0.0
        iterations += 1
    collector.shutdown()
    assert iterations == 3


def test_episodes_without_a_score_are_left_out_whole() -> None:
    prior = tiny_prior(slots=12)
    policy = DenoisingPolicy(prior, STEPS)
    env = DenoisingTorchRLEnv(SCENES, prior=prior, reward=to_the_front, num_steps=STEPS, slots=12)
    env.set_seed(1)
    (batch,) = Collector(env, policy, frames_per_batch=2 * SCENES * STEPS, total_frames=2 * SCENES * STEPS)
    batch["advantage"] = torch.ones(batch.shape)
    scored = batch["next", "valid"][..., 0].unflatten(1, (2, STEPS)).all(dim=-1)  # (B, 2), two episodes in a row
    assert 0 < int(scored.sum()) < scored.numel()
    loss = DDPOSFLoss(policy)
    kept = batch.unflatten(1, (2, STEPS))[scored].flatten(0, 1).exclude("next")
    expected = loss(kept)["loss_objective"]
    torch.testing.assert_close(loss(batch)["loss_objective"], expected, rtol=1e-4, atol=1e-3)
    last = batch[:, -1]
    torch.testing.assert_close(loss(last), loss(last.set("valid", scored[:, 1:]).exclude("next")))


def test_figures_are_there_without_old_log_probabilities() -> None:
    prior = tiny_prior(slots=12)
    policy = DenoisingPolicy(prior, STEPS)
    found = policy(DenoisingTorchRLEnv(2, prior=prior, num_steps=STEPS, slots=12).reset())
    assert set(policy.out_keys) <= set(found.keys())
    torch.testing.assert_close(found["slot_log_prob"].sum(dim=1), found["action_log_prob"])
    bare = found.set("advantage", torch.ones(2)).exclude("slot_log_prob", "action_log_prob")
    loss = DDPOSFLoss(policy)
    result = loss(bare)
    assert set(result.keys()) == set(loss.out_keys)
    assert (float(result["log_ratio"]), float(result["clip_fraction"])) == (0.0, 0.0)
