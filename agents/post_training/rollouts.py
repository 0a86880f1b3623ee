"""Batches of whole episodes of the torchrl environment, as TensorDicts [B, S]."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Generator, Tensor

from agents.networks.text import Text
from agents.post_training.algorithms.base import at_all_steps, final_reward
from agents.post_training.policy import DenoisingPolicy
from agents.priors.prior import ScenePrior
from agents.utils.checkpoints import derived_seed
from agents.utils.process_group import ProcessGroup, gather_rows
from scene_envs.datasets.prompts import describe_all
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.envs.scoring import grammar_prompts
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


def stream_seed(seed: int, stream: str, iteration: int = 0) -> int:
    """A seed below 2^31 for one purpose in one iteration, so that a resumed run needs no generator's state."""
    return derived_seed(seed, STREAMS[stream], iteration)


class SeededPolicy(TensorDictModuleBase):
    """A policy for one batch, whose noise follows from a seed: an episode gets the same, whichever process runs it.

    It reads and writes the keys of ``policy``, but for ``action_log_prob``. All episodes start at its first call. The
    prompts are encoded once, at the first step; ``text`` has their tokens (B, L, W) and mask (B, L), None for a prior
    that reads none. ``seed`` is that of the run, and ``iteration`` the number of the batch in it, from 0.
    """

    def __init__(self, policy: DenoisingPolicy, seed: int, iteration: int = 0) -> None:
        super().__init__()
        self.in_keys, self.out_keys = policy.in_keys, ["action", "slot_log_prob"]
        self.policy, self.iteration = policy, iteration
        self.text: Text | None = None
        self._seed, self._step = stream_seed(seed, "noise", iteration), 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write an action and its log-probability.

        Raises:
            TrainingError: the prior gave values that are not finite.
        """
        scene, processes = tensordict["scene"], ProcessGroup.current()
        step, self._step = self._step, self._step + 1
        if step == 0:
            self._generator = Generator(scene.device).manual_seed(self._seed)
            self.text = self.policy.read(tensordict["prompt"]) if "prompt" in self.in_keys else None
        count = processes.size * len(scene)
        noise = torch.randn(count, *scene.shape[1:], generator=self._generator, device=scene.device)
        action, log_prob = self.policy.draw(scene, step, text=self.text, noise=noise[processes.rows(count)])
        if not bool(torch.isfinite(log_prob).all()):
            raise TrainingError(
                f"the prior gave values that are not finite at step {step} of iteration {self.iteration + 1}; "
                "its weights are broken: go back to an earlier checkpoint or load the prior anew"
            )
        return tensordict.update({"action": action, "slot_log_prob": log_prob})


def collect(
    env: DenoisingTorchRLEnv,
    policy: DenoisingPolicy,
    *,
    seed: int,
    iteration: int = 0,
    prompts: Sequence[str] | None = None,
) -> TensorDict:
    """One whole episode in each of the environment's rows: ``env.rollout`` with seeds, and with the reward's verdict.

    With several processes, the rows of all processes form one batch, in the order of the processes. An episode starts
    from the same x_T and gets the same noise, whichever process runs it.

    The TensorDict [B, S] has the environment's keys, those that :class:`SeededPolicy` writes, and in addition the
    following, which are equal at all steps and share the memory of one:

    - ``finished`` (B, S, N, F): the finished scenes, and ``scene_type``, their type.
    - ``per_object`` (B, S, N): credit per slot, if the reward of any process gives it.
    - ``judged``, ``credited`` (B, S, N) bool: slots that the reward judges, and slots with credit. Fixed slots have no
      credit; if the reward is a mean over the objects, only the slots that it judges have credit.
    - ``counts_objects`` (B, S, 1) bool: whether the reward depends on which objects there are, wherever they are.
    - ``terms``: named (B, S, 1) parts of the reward.
    - ``text`` (B, S, L, W), ``text_mask`` (B, S, L): what the network attended to, if the prior reads prompts.

    Args:
        env: the torchrl adapter, in ``next_sample`` mode.
        policy: policy that draws x_{t-1}; it must have the environment's number of steps.
        seed: seed of the run; x_T and the chain's noise depend only on it and on ``iteration``.
        iteration: number of the batch in the run, from 0.
        prompts: one prompt per row; None lets the environment draw them.
    """
    core, rank = env.core, ProcessGroup.current().rank
    for timestep in core.table.timesteps.tolist():
        policy.step_of(timestep)  # raises where environment and policy have other steps
    env.set_seed(stream_seed(seed, "start", iteration) + rank * core.num_envs)
    seeded = SeededPolicy(policy, seed, iteration)
    start = env.reset(prompts=prompts)
    batch: TensorDict = env.rollout(core.num_steps, seeded, auto_reset=False, tensordict=start)
    entries = _verdict(env)
    if seeded.text is not None:
        entries["text"], entries["text_mask"] = seeded.text
    for name, values in entries.items():
        batch[name] = at_all_steps(values, batch)
    return batch.set_non_tensor("scene_type", core.scene_type)


def _verdict(env: DenoisingTorchRLEnv) -> dict[str | tuple[str, str], Tensor]:
    """Entries (B, ...) of the finished scenes; zeros for credit and terms that only other processes have."""
    result, device = env.result, env.core.device
    assert result is not None
    assert result.batch is not None
    assert result.score is not None
    scenes, score, scorer = result.batch, result.score, env.core.scorer
    judged = score.object_flags.get("judged", scenes.is_free)
    credited = judged.clone() if scorer.averages_objects else torch.ones_like(judged)
    credited[:, : len(scenes.scene_type.fixed)] = False  # fixed slots are not drawn
    entries: dict[str | tuple[str, str], Tensor] = {
        "finished": scenes.tensor,
        "judged": judged,
        "credited": credited,
        "counts_objects": torch.full_like(result.valid, scorer.counts_objects),
    }
    found = ProcessGroup.current().gather((score.per_object is not None, list(score.terms)))
    if any(has for has, _ in found):
        none = torch.zeros(judged.shape, device=device)
        entries["per_object"] = none if score.per_object is None else score.per_object
    for name in dict.fromkeys(name for _, names in found for name in names):
        entries["terms", name] = score.terms.get(name, torch.zeros_like(result.reward))
    return entries


def finished_scenes(batch: TensorDictBase) -> SceneBatch:
    """The finished scenes of a batch, on its device."""
    return SceneBatch(batch["finished"][:, -1], batch["scene_type"])


def text_of(states: TensorDictBase) -> Text | None:
    """What the network attends to in ``states`` [...]; None when the prior reads no prompts."""
    tokens = states.get("text", None)
    return None if tokens is None else (tokens, states["text_mask"])


def gathered_scenes(batch: TensorDictBase) -> SceneBatch:
    """The finished scenes of all processes, on the CPU."""
    scenes = finished_scenes(batch).to("cpu")
    return SceneBatch(gather_rows(scenes.tensor), scenes.scene_type)


def reward_figures(batch: TensorDictBase) -> dict[str, float]:
    """Figures of the rewards of all processes, for a row of the log; means are over valid scenes, NaN without one."""
    final = batch[:, -1]
    reward, valid = (gather_rows(values) for values in final_reward(final))
    terms = {name: gather_rows(term[:, 0]) for name, term in final.get("terms", {}).items()}
    reward = reward[valid]
    some = len(reward) > 0
    figures = {
        "reward": float(reward.mean()) if some else float("nan"),
        "reward_std": float(reward.std(unbiased=False)) if some else float("nan"),
        "valid_fraction": float(valid.float().mean()),
        "objects": float(gathered_scenes(batch).counts.float().mean()),
    }
    return figures | {f"term_{name}": float(term[valid].mean()) for name, term in terms.items() if some}


PROMPTS_NAME = "real_prompts.json"
_PER_SCENE = 3
"""Number of descriptions of a scene without prompts."""

PromptSets = Callable[[int], Sequence[str]]
"""All prompts of a real scene, by its index."""


class PromptDeck:
    """Deck that deals the prompts of batches: one text, a list, ``"data"`` (those of ``count`` real scenes, in ``real``
    by index) or ``"grammar"``. ``share`` scenes of a batch have the same prompt, so that they can be compared.

    >>> deck = PromptDeck(["A scene with two cups.", "A scene with a teapot."], share=2)
    >>> dealt = deck.deal(4, Generator().manual_seed(0))
    >>> dealt[0] == dealt[1] != dealt[2] == dealt[3]
    True
    """

    def __init__(self, prompt: Any, share: int, real: PromptSets | None = None, count: int = 0) -> None:
        self.share = share
        self._real, self._count = real, count
        self._texts: tuple[str, ...] = (
            () if prompt == "data" else (prompt,) if isinstance(prompt, str) else tuple(prompt)
        )

    @classmethod
    def of(cls, prior: ScenePrior, prompt: Any, share: int, slots: int, real: PromptSets, count: int) -> PromptDeck:
        """The deck of a run; ``"grammar"`` is replaced by descriptions of grammar scenes that fit into ``slots``."""
        if prompt == "grammar":
            prompt = grammar_prompts(prior.scene_type, slots)
        return cls(prompt, share, real, count)

    def deal(self, count: int, generator: Generator) -> list[str]:
        """``count`` prompts; neighbours share a prompt, in groups of ``share`` or a few more."""
        groups, size = max(1, count // self.share), len(self._texts) or self._count
        rounds = [torch.randperm(size, generator=generator) for _ in range(-(-groups // size))]
        indices = torch.cat(rounds)[:groups].tolist()  # without repetition while there are enough
        different = [self._text(index, generator) for index in indices]
        return [different[row * groups // count] for row in range(count)]

    def _text(self, index: int, generator: Generator) -> str:
        if self._texts or self._real is None:
            return self._texts[index]
        texts = self._real(index)
        return texts[int(torch.randint(len(texts), (), generator=generator))]


def run_prompts(directory: Path, batch: SceneBatch, seed: int) -> PromptSets:
    """The prompts of a run's real scenes: those kept in the run's folder, or else descriptions of the scenes, written
    on first use. Those of scene i depend only on ``seed`` and on i.
    """
    path = directory / PROMPTS_NAME
    if path.exists():
        kept: list[list[str]] = json.loads(path.read_text(encoding="utf-8"))
        return kept.__getitem__

    @cache
    def described(index: int) -> Sequence[str]:
        (texts,) = describe_all(batch[index], np.random.default_rng([seed, index]), count=_PER_SCENE)
        return texts

    return described
