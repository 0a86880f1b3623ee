"""Batches of whole denoising episodes under a policy, with the log-probabilities of their steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from gymnasium.utils import seeding
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.networks.text import Text
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.prompts import prompt_groups
from agents.utils.process_group import ProcessGroup, gather_rows
from agents.utils.seeds import derived_seed
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.errors import TrainingError
from scene_envs.scene import SceneBatch

STREAMS = {
    "start": 0,
    "noise": 1,
    "steps": 2,
    "real": 3,
    "bank": 4,
    "guard": 5,
    "prompts": 6,
    "samples": 7,
    "base": 10,
    "base_prompts": 11,
    "base_samples": 12,
    "discriminator": 13,
}
"""Purposes of random draws, and the number of each, which seeds depend on."""


@dataclass(frozen=True)
class Rollout:
    """B episodes of S steps.

    Attributes:
        scenes: (S + 1, B, N, D) normalised, x_T to x_0.
        actions: (S, B, N, D).
        slot_log_prob: (S, B, N) nats at sampling.
        timesteps: (S,) int64.
        reward: (B,); 0 where not valid.
        valid: (B,) bool.
        per_object: (B, N) credit per slot, or None.
        averages: whether the reward is a mean over the objects, so that an empty slot has no credit.
        counts: whether the reward depends on which objects there are, wherever they are.
        judged: (B, N) bool, slots that such a reward gives credit to; None for the free objects.
        terms: named (B,) parts of the reward.
        batch: the finished scenes.
        prompts: one per scene, or None without prompts.
        text: what the network attended to, tokens (B, L, W) and mask (B, L); None when the prior reads no prompts.
    """

    scenes: Tensor
    actions: Tensor
    slot_log_prob: Tensor
    timesteps: Tensor
    reward: Tensor
    valid: Tensor
    per_object: Tensor | None
    terms: Mapping[str, Tensor]
    batch: SceneBatch
    prompts: tuple[str, ...] | None = None
    text: Text | None = None
    averages: bool = False
    counts: bool = False
    judged: Tensor | None = None

    def transitions(self, step: int, advantage: Tensor, rows: slice = slice(None)) -> TensorDict:
        """The transitions of one step as ``DDPOSFLoss`` reads them."""
        scene = self.scenes[step][rows]
        fields = {
            "scene": scene,
            "timestep": self.timesteps[step].expand(scene.shape[0], 1),
            "action": self.actions[step][rows],
            "slot_log_prob": self.slot_log_prob[step][rows],
            "advantage": advantage[rows],
            "valid": self.valid[rows],
        }
        if self.text is not None:
            fields |= {"text": self.text[0][rows], "text_mask": self.text[1][rows]}
        return TensorDict(fields, [scene.shape[0]])


def rollout_groups(rollout: Rollout) -> Tensor | None:
    """(B,) int64 groups of scenes with equal prompts, within which scenes are compared; None without prompts."""
    return None if rollout.prompts is None else prompt_groups(rollout.prompts).to(rollout.reward.device)


def stream_seed(seed: int, stream: str, iteration: int = 0) -> int:
    """A seed below 2^31 for one purpose in one iteration, so that a resumed run needs no generator's state."""
    return derived_seed(seed, STREAMS[stream], iteration)


def collect(
    env: DenoisingTorchRLEnv,
    policy: DenoisingPolicy,
    *,
    seed: int,
    iteration: int = 0,
    prompts: Sequence[str] | None = None,
) -> Rollout:
    """Run ``policy`` to the end of one episode in each of the environment's rows.

    With several processes, the rows of all processes form one batch, in the order of the processes. An episode starts
    from the same x_T and gets the same noise, whichever process runs it.

    Args:
        env: the torchrl adapter, in ``next_sample`` mode.
        policy: draws x_{t-1}; must have the environment's number of steps.
        seed: seed of the run; x_T and the chain's noise depend only on it and on ``iteration``.
        iteration: which batch of the run this is.
        prompts: one per row; None lets the environment draw them. Text is encoded once, at the start.
    """
    start = stream_seed(seed, "start", iteration)
    processes, device = ProcessGroup.current(), env.core.device
    first_row = processes.rank * env.core.num_envs
    rngs = [seeding.np_random(start + first_row + row)[0] for row in range(env.core.num_envs)]
    generator = Generator(device).manual_seed(stream_seed(seed, "noise", iteration))
    hook = policy.claim_hook(prompts, env.core.slots)
    log_probs: list[Tensor] = []
    texts: list[Text] = []

    def noise(x_t: Tensor) -> Tensor:
        count = processes.size * len(x_t)
        return torch.randn(count, *x_t.shape[1:], generator=generator, device=device)[processes.rows(count)]

    def act(x_t: Tensor, step: int) -> Tensor:
        if step == 0 and env.core.prompting.reader is not None:
            texts.append(policy.read(env.core.observation()["prompt"]))
        text = texts[0] if texts else None
        action, log_prob = policy.draw(x_t, step, text=text, noise=noise(x_t), hook=hook)
        if not bool(torch.isfinite(log_prob).all()):
            raise TrainingError(
                f"the prior gave values that are not finite at step {step} of iteration {iteration + 1}; "
                "its weights are broken: go back to an earlier checkpoint or load the prior anew"
            )
        log_probs.append(log_prob)
        return action

    result = env.core.collect(act, rngs, prompts)
    rollout = Rollout(
        scenes=result.scenes,
        actions=result.actions,
        slot_log_prob=torch.stack(log_probs),
        timesteps=result.timesteps.to(device),
        reward=result.reward,
        valid=result.valid,
        per_object=result.score.per_object,
        judged=result.score.object_flags.get("judged"),
        terms=result.score.terms,
        batch=result.batch,
        prompts=result.prompts,
        text=texts[0] if texts else None,
    )
    return _with_equal_parts(rollout, processes)


def _with_equal_parts(rollout: Rollout, processes: ProcessGroup) -> Rollout:
    """The rollout with the credit and terms that any process has; zeros where the reward of this process gave none."""
    found = processes.gather((rollout.per_object is not None, list(rollout.terms)))
    per_object, reward = rollout.per_object, rollout.reward
    if per_object is None and any(has for has, _ in found):
        per_object = torch.zeros(rollout.slot_log_prob.shape[1:], device=reward.device)
    names = dict.fromkeys(name for _, names in found for name in names)
    terms = {name: rollout.terms.get(name, torch.zeros_like(reward)) for name in names}
    return replace(rollout, per_object=per_object, terms=terms)


def gathered(rollout: Rollout) -> tuple[Tensor, Tensor, dict[str, Tensor], SceneBatch]:
    """Rewards (B,), their validity (B,), terms (B,) and scenes of all processes."""
    terms = {name: gather_rows(term) for name, term in rollout.terms.items()}
    scenes = SceneBatch(gather_rows(rollout.batch.tensor), rollout.batch.scene_type)
    return gather_rows(rollout.reward), gather_rows(rollout.valid), terms, scenes


def reward_figures(rollout: Rollout) -> dict[str, float]:
    """Figures of the rewards of all processes, for a row of the log; means are over valid scenes, NaN without one."""
    reward, valid, terms, scenes = gathered(rollout)
    reward = reward[valid]
    some = len(reward) > 0
    figures = {
        "reward": float(reward.mean()) if some else float("nan"),
        "reward_std": float(reward.std(unbiased=False)) if some else float("nan"),
        "valid_fraction": float(valid.float().mean()),
        "objects": float(scenes.counts.float().mean()),
    }
    return figures | {f"term_{name}": float(term[valid].mean()) for name, term in terms.items() if some}
