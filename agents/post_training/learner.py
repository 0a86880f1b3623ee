"""Learner: the prior as a policy, its environment, its two gradients and its optimiser."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, nn

from agents.configuration.composition import MAX_GRADIENT_NORM
from agents.post_training.algorithms.base import Algorithm, gradient_norm
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.real_scenes import SceneBank
from agents.post_training.regularisation import Regularisation
from agents.post_training.rollouts import PromptDeck, collect, gathered_scenes, stream_seed
from agents.post_training.run_files import CHECKPOINT_NAME
from agents.post_training.settings import PostTrainConfig, make_algorithm
from agents.priors.prior import ScenePrior, no_text
from agents.utils.checkpoints import check_tensors
from agents.utils.process_group import ProcessGroup, gather_rows
from agents.utils.weight_average import AveragedWeights
from rewards import (
    RewardContext,
    RewardOutput,
    averages_objects,
    counts_objects,
    depends_on_batch,
    learned_parts,
    reward_name,
)
from rewards.evaluation import evaluate_reward
from rewards.process import close_reward, run_reward
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.envs.scoring import RewardScorer
from scene_envs.errors import InvalidInputError, RewardError
from scene_envs.scene import SceneBatch

FIRST_SAMPLES = 128
"""Number of samples of the base prior from which a reward learns before the first iteration."""
FIRST_STEPS = 150
"""Number of optimiser steps on these samples."""


class LearnedRewards:
    """The parts of a run's reward that learn (:class:`rewards.LearnedReward`).

    All processes have the same models.

    Args:
        reward: resolved reward of the run.
        config: configuration of the run.
    """

    def __init__(self, reward: Any, config: PostTrainConfig) -> None:
        self.parts = learned_parts(reward)
        self._config = config
        self._seed = stream_seed(config.seed, "discriminator")

    def __bool__(self) -> bool:
        return bool(self.parts)

    def begin(self, real: SceneBatch) -> None:
        """Give the parts the real scenes that training may see."""
        for part in self.parts:
            part.begin(real, self._seed)

    def learn_from_prior(self, prior: ScenePrior, slots: int, prompts: Sequence[str] | None) -> None:
        """Train the parts on samples of the base prior, before they score the first batch.

        Args:
            prior: base prior.
            slots: slots per sample.
            prompts: one prompt for each of the ``FIRST_SAMPLES``; None without prompts.
        """
        samples = ProcessGroup.current().from_first(
            lambda: prior.sample(
                FIRST_SAMPLES,
                prompt=prompts,
                guidance=self._config.guidance if prompts else 0.0,
                claim_guidance=self._config.claim_guidance if prompts else 0.0,
                physics_guidance=0.0,
                num_steps=self._config.num_steps,
                slots=slots,
                seed=self._seed,
                batch_size=self._config.batch_size,
            ).tensor.cpu()
        )
        batch = SceneBatch(samples, prior.scene_type)
        for part in self.parts:
            part.learn(batch, FIRST_STEPS)

    def learn(self, batch: TensorDictBase) -> None:
        """Train the parts on the scenes of a batch, after these were scored."""
        if self.parts:
            scenes = gathered_scenes(batch)
            for part in self.parts:
                part.learn(scenes)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"learned_rewards": [part.state_dict() for part in self.parts]}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Inverse of :meth:`state`, after :meth:`begin`."""
        for part, own in zip(self.parts, state["learned_rewards"], strict=True):
            part.load_state_dict(own)


def check_shares(config: PostTrainConfig, processes: int) -> None:
    """Refuse a batch that cannot be split among ``processes``.

    Raises:
        InvalidInputError: the processes do not divide the batch.
    """
    if config.batch_size % processes:
        lower = config.batch_size // processes * processes
        nearest = f"{lower} or {lower + processes}" if lower else str(processes)
        raise InvalidInputError(
            f"batch_size={config.batch_size} is not a multiple of {processes}, the number of processes; give "
            f"batch_size={nearest}, or another number of processes"
        )


class WholeBatchReward:
    """A reward that depends on the other scenes of a batch, for which each process scores the scenes of all processes.

    Args:
        reward: resolved reward.
        processes: processes that call this reward together, each with the same number of scenes.
    """

    depends_on_batch = True

    def __init__(self, reward: Any, processes: ProcessGroup) -> None:
        self._reward, self._processes = reward, processes
        self.name = reward_name(reward)
        self.averages_objects, self.counts_objects = averages_objects(reward), counts_objects(reward)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Scores of ``batch``."""
        everything = SceneBatch(gather_rows(batch.tensor), batch.scene_type)
        prompts = context.prompts
        if prompts is not None:
            prompts = tuple(text for texts in self._processes.gather(tuple(prompts)) for text in texts)
        output = evaluate_reward(self._reward, everything, replace(context, prompts=prompts))
        rows = self._processes.rows(len(everything))
        return replace(
            output,
            value=output.value[rows],
            valid=None if output.valid is None else output.valid[rows],
            per_object=None if output.per_object is None else output.per_object[rows],
            terms={name: term[rows] for name, term in output.terms.items()},
            object_flags={name: flags[rows] for name, flags in output.object_flags.items()},
        )


class NonFiniteGradient(Exception):
    """An update was refused; ``figures`` describes the refused update."""

    def __init__(self, figures: dict[str, float]) -> None:
        super().__init__(str(figures))
        self.figures = figures


class Learner:
    """Samples scenes under the current policy and updates it. All randomness depends on (seed, purpose, iteration).

    Args:
        config: the run.
        prior: where to start; a copy is trained.
    """

    def __init__(self, config: PostTrainConfig, prior: ScenePrior) -> None:
        self.config = config
        self.prior = deepcopy(prior).to(config.device).eval()
        if config.prompt is not None and not self.prior.conditional:
            raise no_text(self.prior.scene_type, str(config.prompt))
        self.prior.freeze_text()
        self.processes = ProcessGroup.current()
        self.processes.share(self.prior.parameters())
        self.regularisation = Regularisation(config.regularisation, self.prior)
        self.slots = self.prior.config.slots if config.slots is None else config.slots
        self.policy = DenoisingPolicy(
            self.prior, config.num_steps, chunk=config.optimizer.chunk, guidance=config.guidance,
            claim_guidance=config.claim_guidance,
        )  # fmt: skip
        self.stds = self.policy.stds(self.slots).cpu()
        self.algorithm: Algorithm = make_algorithm(config.algorithm, self.policy, self.stds)
        self.reward = run_reward(
            config.reward,
            seed=config.seed,
            timeout=config.reward_timeout,
            memory=config.reward_memory,
            workers=0 if config.workers == "ray" else config.workers,
        )
        self.learned = LearnedRewards(self.reward, config)
        shared = self.processes.size > 1 and depends_on_batch(self.reward)
        self.env = DenoisingTorchRLEnv(
            config.batch_size // self.processes.size,
            scene=self.prior.scene_type,
            reward=WholeBatchReward(self.reward, self.processes) if shared else self.reward,
            num_steps=config.num_steps,
            prior=self.prior,
            slots=self.slots,
            workers=config.workers,
            prompt=config.prompt,
        )
        self.scorer = RewardScorer(self.reward, config.workers) if shared else self.env.core.scorer
        self.deck: PromptDeck | None = None
        self.parameters = [p for p in self.prior.parameters() if p.requires_grad]
        self.lr = config.optimizer.lr or config.algorithm.learning_rate
        self.optimizer = torch.optim.AdamW(self.parameters, lr=self.lr, weight_decay=0.0, betas=(0.9, 0.999))

    def close(self) -> None:
        """Stop the workers of physics and of the reward, if any."""
        self.env.close()
        self.scorer.close()
        close_reward(self.reward)

    def deal_prompts(self, scenes: SceneBank) -> None:
        """Make the deck that deals the prompts of batches; does nothing in a run without prompts."""
        config = self.config
        if config.prompt is not None and scenes.prompts is not None:
            together = config.algorithm.scenes_per_prompt
            self.deck = PromptDeck.of(
                self.prior, config.prompt, together, self.slots, scenes.prompts, len(scenes.train)
            )

    def rollout(self, iteration: int) -> TensorDict:
        """A batch [B, S] of fresh scenes, or this process's share of it; see :func:`collect`."""
        prompts: Sequence[str] | None = None
        if self.deck is not None:
            batch = self.config.batch_size
            prompts = self.deck.deal(batch, self._generator("prompts", iteration))[self.processes.rows(batch)]
        policy = self.algorithm.sampling_policy
        return collect(self.env, policy, seed=self.config.seed, iteration=iteration, prompts=prompts)

    def write_advantage(self, batch: TensorDict) -> TensorDict:
        """The batch with the advantages that the algorithm's loss reads, if it reads any."""
        return batch if self.algorithm.advantage is None else self.algorithm.advantage(batch)

    def begin_rewards(self, real: SceneBatch, *, first: bool) -> None:
        """Give real scenes to the rewards that learn; does nothing if no reward learns.

        Args:
            real: real scenes that training may see.
            first: also train them on samples of the base prior; False for a run whose state is restored.
        """
        self.learned.begin(real)
        if self.learned and first:
            prompts = None if self.deck is None else self.deck.deal(FIRST_SAMPLES, self._generator("discriminator", 0))
            self.learned.learn_from_prior(self.prior, self.slots, prompts)

    def largest_reward(self) -> float | None:
        """The largest value that the reward declares for scenes of this run, None where it declares none."""
        try:
            return self.scorer.maximum(self.slots, self.slots - len(self.prior.scene_type.fixed))
        except RewardError:  # its process cannot be asked any more
            return None

    def accumulate(self, batch: TensorDictBase, scenes: SceneBank, index: int) -> dict[str, float]:
        """Put the policy and regularisation gradients, summed over all processes, into ``.grad``; measure each one.

        Args:
            batch: whole episodes [B, S], with the advantages that the algorithm writes.
            scenes: real scenes for the regularisation.
            index: number of the update in the run, from which the draws of steps and real scenes follow.
        """
        config = self.config
        self.optimizer.zero_grad(set_to_none=True)
        policy = self.algorithm.accumulate(batch, self._generator("steps", index))
        self.processes.sum_gradients(self.parameters)
        policy_norm = gradient_norm(self.parameters)
        generator = self._generator("real", index)
        count = config.regularisation.batch_size
        real = scenes.batch(count, generator)
        samples = None if scenes.base is None else scenes.base.batch(count, self._generator("base", index))
        row = self.regularisation.accumulate(self.prior, real, samples, generator, config.optimizer.chunk)
        return {
            "policy_loss": policy.loss,
            "policy_gradient_norm": policy_norm,
            **row,
            **policy.figures(),
        }

    def update(self, batch: TensorDictBase, scenes: SceneBank, index: int) -> dict[str, float]:
        """One optimiser step.

        Raises:
            NonFiniteGradient: the gradient is not finite; the weights in training are unchanged.
        """
        rate = self.lr
        row = self.accumulate(batch, scenes, index)
        row["gradient_norm"] = float(nn.utils.clip_grad_norm_(self.parameters, MAX_GRADIENT_NORM))
        if not all(math.isfinite(row[name]) for name in ("gradient_norm", "policy_loss", "pretraining_loss")):
            self.optimizer.zero_grad(set_to_none=True)
            raise NonFiniteGradient(row)
        row["learning_rate"] = rate
        for group in self.optimizer.param_groups:
            group["lr"] = row["learning_rate"]
        self.optimizer.step()
        return row

    def return_to(self, prior: ScenePrior) -> None:
        """Take the weights of an earlier checkpoint, forget the optimiser's state, and halve the learning rate."""
        self.prior.load_state_dict(prior.state_dict())
        self.algorithm.return_to(self.prior)
        self.lr *= 0.5
        self.optimizer.state.clear()

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "learning_rate": self.lr,
            "prior": self.prior.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "algorithm": self.algorithm.state(),
            "regularisation": self.regularisation.state_dict(),
            **self.learned.state(),
            "random": torch.get_rng_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`.

        Raises:
            InvalidInputError: the weights are of another network.
        """
        check_tensors(self.prior, state["prior"], self.config.directory / CHECKPOINT_NAME)
        self.prior.load_state_dict(state["prior"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.lr = state["learning_rate"]
        self.algorithm.restore(state["algorithm"])
        self.regularisation.load_state_dict(state["regularisation"])
        self.learned.restore(state)
        torch.set_rng_state(state["random"])

    def averaged(self) -> AveragedWeights[ScenePrior]:
        """Context in which the prior holds the weights that are evaluated and saved: the average, when there is one."""
        return AveragedWeights(self.prior, self.algorithm.average)

    def _generator(self, stream: str, index: int) -> Generator:
        return Generator().manual_seed(stream_seed(self.config.seed, stream, index))
