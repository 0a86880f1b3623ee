"""Learner: the prior as a policy, its environment, its two gradients and its optimiser."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, nn

from agents.post_training.algorithms import make_algorithm
from agents.post_training.base import Algorithm
from agents.post_training.config import PostTrainConfig
from agents.post_training.gradients import gradient_norm
from agents.post_training.learned_rewards import FIRST_SAMPLES, LearnedRewards
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.processes import WholeBatchReward
from agents.post_training.prompts import PromptDeck
from agents.post_training.regularisation import Regularisation
from agents.post_training.rollouts import collect, stream_seed
from agents.post_training.run_files import CHECKPOINT_NAME
from agents.post_training.scene_bank import SceneBank
from agents.priors.base import ScenePrior
from agents.priors.prompt_validation import no_text
from agents.utils.checkpoints import check_tensors
from agents.utils.process_group import ProcessGroup
from agents.utils.weight_average import AveragedWeights, WeightAverage
from rewards import depends_on_batch
from rewards.isolation import close_reward, run_reward
from scene_envs.envs import DenoisingTorchRLEnv
from scene_envs.envs.scoring import RewardScorer
from scene_envs.errors import InvalidInputError, RewardError
from scene_envs.scene import SceneBatch


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
        self.optimizer = torch.optim.AdamW(
            self.parameters, lr=self.lr, weight_decay=config.optimizer.weight_decay, betas=(0.9, 0.999)
        )
        self.average = WeightAverage(self.prior, config.optimizer.ema) if config.optimizer.ema else None
        if self.average is not None and self.algorithm.average is not None:
            raise InvalidInputError(
                f"optimizer.ema={config.optimizer.ema}: algorithm={config.algorithm.name} evaluates and saves its "
                "sampling policy, which is an average already; leave optimizer.ema=0"
            )

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
        config = self.config.optimizer
        rate = self.lr * min(1.0, (index + 1) / max(1, config.warmup))
        row = self.accumulate(batch, scenes, index)
        row["gradient_norm"] = float(nn.utils.clip_grad_norm_(self.parameters, config.clip))
        if not all(math.isfinite(row[name]) for name in ("gradient_norm", "policy_loss", "pretraining_loss")):
            self.optimizer.zero_grad(set_to_none=True)
            raise NonFiniteGradient(row)
        row["learning_rate"] = rate
        for group in self.optimizer.param_groups:
            group["lr"] = row["learning_rate"]
        self.optimizer.step()
        if self.average is not None:
            self.average.update(self.prior)
        return row

    def return_to(self, prior: ScenePrior) -> None:
        """Take the weights of an earlier checkpoint, forget the optimiser's state, and halve the learning rate."""
        self.prior.load_state_dict(prior.state_dict())
        self.algorithm.return_to(self.prior)
        if self.average is not None:
            self.average = WeightAverage(self.prior, self.average.decay)
        self.lr *= 0.5
        self.optimizer.state.clear()

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "learning_rate": self.lr,
            "prior": self.prior.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "average": None if self.average is None else self.average.tensors,
            "average_updates": 0 if self.average is None else self.average.updates,
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
        if self.average is not None:
            self.average.restore(state["average"], state["average_updates"])
        self.algorithm.restore(state["algorithm"])
        self.regularisation.load_state_dict(state["regularisation"])
        self.learned.restore(state)
        torch.set_rng_state(state["random"])

    def averaged(self) -> AveragedWeights[ScenePrior]:
        """Context in which the prior holds the weights that are evaluated and saved: the average, when there is one."""
        return AveragedWeights(self.prior, self.algorithm.average or self.average)

    def _generator(self, stream: str, index: int) -> Generator:
        return Generator().manual_seed(stream_seed(self.config.seed, stream, index))
