"""Learner: the prior as a policy, its environment, its two gradients and its optimiser."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor, nn

from agents.configuration.composition import MAX_GRADIENT_NORM
from agents.post_training.algorithms.base import Algorithm, gradient_norm
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.real_scenes import SceneBank
from agents.post_training.regularisation import Regularisation
from agents.post_training.rollouts import PromptDeck, collect, gathered_scenes, stream_seed
from agents.post_training.settings import (
    AlgorithmSettings,
    PostTrainOptimizerSettings,
    RegularisationSettings,
    make_algorithm,
)
from agents.priors.prior import ScenePrior
from agents.utils.process_group import ProcessGroup, gather_rows
from rewards import RewardContext, RewardOutput, facts_of, learned_parts, reward_name
from rewards.evaluation import evaluate_reward
from rewards.process import close_reward, mapped
from scene_envs.arrays import Result, within_memory
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.envs.scoring import RewardScorer
from scene_envs.errors import RewardError
from scene_envs.scene import SceneBatch

FIRST_SAMPLES = 128
"""Number of samples of the base prior from which a reward learns before the first iteration."""
FIRST_STEPS = 150
"""Number of optimiser steps on these samples."""


class Learner:
    """Samples scenes under the current policy and updates it. All randomness depends on (seed, purpose, iteration).
    ``reward`` is resolved by :func:`rewards.process.run_reward`; ``batch_size`` counts the scenes of all processes;
    ``slots`` None takes as many as the prior was trained on; ``prompt`` is that of a
    :class:`~agents.post_training.rollouts.PromptDeck`; ``workers`` may be ``"ray"``; ``physics`` names the engine.
    """

    def __init__(
        self,
        policy: DenoisingPolicy,
        reward: Any,
        algorithm: AlgorithmSettings,
        optimizer: PostTrainOptimizerSettings,
        regularisation: RegularisationSettings,
        *,
        batch_size: int,
        slots: int | None = None,
        prompt: Any = None,
        workers: int | str = 0,
        physics: str = "auto",
        seed: int = 0,
    ) -> None:
        self.policy, self.reward = policy, reward
        self.prior = cast(ScenePrior, policy.prior)
        self.batch_size, self.prompt, self.seed = batch_size, prompt, seed
        self.slots = self.prior.config.slots if slots is None else slots
        self.prior.freeze_text()
        self.processes = ProcessGroup.current()
        self.processes.share(self.prior.parameters())
        self.regularisation = Regularisation(regularisation, self.prior)
        self.stds = policy.stds(self.slots).cpu()
        self.algorithm: Algorithm = make_algorithm(algorithm, policy, self.stds)
        self.learned = learned_parts(reward)
        shared = self.processes.size > 1 and facts_of(reward)["depends_on_batch"]
        self.env = DenoisingTorchRLEnv(
            batch_size // self.processes.size,
            scene=self.prior.scene_type,
            reward=WholeBatchReward(reward, self.processes) if shared else reward,
            num_steps=len(policy),
            prior=self.prior,
            slots=self.slots,
            workers=workers,
            physics=physics,
            prompt=prompt,
        )
        self.scorer = RewardScorer(reward, workers, physics) if shared else self.env.core.scorer
        self.deck: PromptDeck | None = None
        self.scenes_per_prompt = algorithm.scenes_per_prompt
        self.parameters = [p for p in self.prior.parameters() if p.requires_grad]
        self.lr = optimizer.lr or algorithm.learning_rate
        self.optimizer = torch.optim.AdamW(self.parameters, lr=self.lr, weight_decay=0.0, betas=(0.9, 0.999))

    def close(self) -> None:
        """Stop the workers of physics and of the reward, if any."""
        self.env.close()
        self.scorer.close()
        close_reward(self.reward)

    def deal_prompts(self, scenes: SceneBank) -> None:
        """Make the deck that deals the prompts of batches; does nothing in a run without prompts."""
        if self.prompt is not None and scenes.prompts is not None:
            self.deck = PromptDeck.of(
                self.prior, self.prompt, self.scenes_per_prompt, self.slots, scenes.prompts, len(scenes.train)
            )

    def rollout(self, iteration: int) -> TensorDict:
        """A batch [B, S] of fresh scenes, or this process's share of it; see :func:`collect`."""
        prompts: Sequence[str] | None = None
        if self.deck is not None:
            rows = self.processes.rows(self.batch_size)
            prompts = self.deck.deal(self.batch_size, self._generator("prompts", iteration))[rows]
        policy = self.algorithm.sampling_policy
        return collect(self.env, policy, seed=self.seed, iteration=iteration, prompts=prompts)

    def in_memory(self, work: Callable[[], Result]) -> Result:
        """``work()``; where the memory is too small for it, an InvalidInputError gives an ``optimizer.chunk`` that
        fits. With several processes, which work together, nothing is tried.
        """
        size = self.policy.chunk or self.batch_size

        def tried(chunk: int) -> Result:
            if chunk < size:
                self.policy.chunk = self.algorithm.sampling_policy.chunk = chunk
            return work()

        return work() if self.processes.size > 1 else within_memory(tried, size, "optimizer.chunk")

    def write_advantage(self, batch: TensorDict) -> TensorDict:
        """The batch with the advantages that the algorithm's loss reads, if it reads any."""
        return batch if self.algorithm.advantage is None else self.algorithm.advantage(batch)

    def begin_rewards(self, real: SceneBatch, *, first: bool) -> None:
        """Give real scenes to the parts of the reward that learn (:class:`rewards.LearnedReward`), the same parts in
        all processes. ``first`` also trains them on samples of the base prior; it is False if the run's state is
        restored.
        """
        seed = stream_seed(self.seed, "discriminator")
        for part in self.learned:
            part.begin(real, seed)
        if not (self.learned and first):
            return
        prompts = None if self.deck is None else self.deck.deal(FIRST_SAMPLES, self._generator("discriminator", 0))
        samples = self.processes.from_first(
            lambda: self.prior.sample(
                FIRST_SAMPLES,
                prompt=prompts,
                guidance=self.policy.guidance if prompts else 0.0,
                physics_guidance=0.0,
                num_steps=len(self.policy),
                slots=self.slots,
                seed=seed,
                batch_size=self.batch_size,
            ).tensor.cpu()
        )
        for part in self.learned:
            part.learn(SceneBatch(samples, self.prior.scene_type), FIRST_STEPS)

    def learn_rewards(self, batch: TensorDictBase) -> None:
        """Train the parts of the reward that learn on the scenes of a batch, after these were scored."""
        if self.learned:
            scenes = gathered_scenes(batch)
            for part in self.learned:
                part.learn(scenes)

    def largest_reward(self) -> float | None:
        """The largest value that the reward declares for scenes of this run, None where it declares none."""
        try:
            return self.scorer.maximum(self.slots, self.slots - len(self.prior.scene_type.fixed))
        except RewardError:  # its process cannot be asked any more
            return None

    def accumulate(self, batch: TensorDictBase, scenes: SceneBank, index: int) -> dict[str, float]:
        """Put the policy and regularisation gradients, summed over all processes, into ``.grad``; measure each one.
        ``batch`` has whole episodes [B, S] with advantages; the draws of steps and real scenes follow from ``index``,
        the number of the update.
        """
        self.optimizer.zero_grad(set_to_none=True)
        policy = self.algorithm.accumulate(batch, self._generator("steps", index))
        self.processes.sum_gradients(self.parameters)
        policy_norm = gradient_norm(self.parameters)
        generator = self._generator("real", index)
        count = self.regularisation.settings.batch_size
        real = scenes.batch(count, generator)
        samples = None if scenes.base is None else scenes.base.batch(count, self._generator("base", index))
        row = self.regularisation.accumulate(self.prior, real, samples, generator, self.policy.chunk)
        return {"policy_loss": policy.loss, "policy_gradient_norm": policy_norm, **row, **policy.columns}

    def update(self, batch: TensorDictBase, scenes: SceneBank, index: int) -> dict[str, float]:
        """One optimiser step; a NonFiniteGradient leaves the weights in training unchanged."""
        row = self.accumulate(batch, scenes, index)
        row["gradient_norm"] = float(nn.utils.clip_grad_norm_(self.parameters, MAX_GRADIENT_NORM))
        if not all(math.isfinite(row[name]) for name in ("gradient_norm", "policy_loss", "pretraining_loss")):
            self.optimizer.zero_grad(set_to_none=True)
            raise NonFiniteGradient(row)
        row["learning_rate"] = self.lr
        for group in self.optimizer.param_groups:
            group["lr"] = self.lr
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
            "learned_rewards": [part.state_dict() for part in self.learned],
            "random": torch.get_rng_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`, after :meth:`begin_rewards`."""
        self.prior.load_state_dict(state["prior"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.lr = state["learning_rate"]
        self.algorithm.restore(state["algorithm"])
        self.regularisation.load_state_dict(state["regularisation"])
        for part, own in zip(self.learned, state["learned_rewards"], strict=True):
            part.load_state_dict(own)
        torch.set_rng_state(state["random"])

    def _generator(self, stream: str, index: int) -> Generator:
        return Generator().manual_seed(stream_seed(self.seed, stream, index))


class WholeBatchReward:
    """A resolved reward that depends on the other scenes of a batch: each of ``processes``, which call it together with
    equally many scenes, scores the scenes of all.
    """

    def __init__(self, reward: Any, processes: ProcessGroup) -> None:
        self._reward, self._processes = reward, processes
        self.name = reward_name(reward)
        vars(self).update(facts_of(reward), depends_on_batch=True)

    def __call__(self, batch: SceneBatch, context: RewardContext) -> RewardOutput:
        """Scores of ``batch``."""
        everything = SceneBatch(gather_rows(batch.tensor), batch.scene_type)
        prompts = context.prompts
        if prompts is not None:
            prompts = tuple(text for texts in self._processes.gather(tuple(prompts)) for text in texts)
        output = evaluate_reward(self._reward, everything, replace(context, prompts=prompts))
        rows = self._processes.rows(len(everything))
        return RewardOutput(**mapped(lambda column: column[rows], Tensor, vars(output)))


class NonFiniteGradient(Exception):
    """An update was refused; ``figures`` describes the refused update."""

    def __init__(self, figures: dict[str, float]) -> None:
        super().__init__(str(figures))
        self.figures = figures
