"""What learns: the prior as a policy, its environment, its two gradients, its optimiser."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from torch import Generator, Tensor, nn

from agents.averaging import WeightAverage
from agents.post_training.advantages import compute_advantages
from agents.post_training.config import PostTrainConfig
from agents.post_training.gradients import (
    accumulate_policy_gradient,
    add_regularisation_gradient,
    credited_reward,
    draw_steps,
)
from agents.post_training.losses import DDPOSFLoss
from agents.post_training.policy import DenoisingPolicy, gradient_weights
from agents.post_training.real_scenes import RealScenes
from agents.post_training.rollouts import Rollout, collect, stream_seed
from agents.prior import ScenePrior
from scene_envs.denoising_torchrl import DenoisingTorchRLEnv


class NonFiniteGradient(Exception):
    """An update was refused; ``figures`` says what it would have been."""

    def __init__(self, figures: dict[str, float]) -> None:
        super().__init__(str(figures))
        self.figures = figures


class Learner:
    """Samples scenes under the current policy and updates it. All randomness hangs on (seed, purpose, iteration).

    Args:
        config: the run.
        prior: where to start; a copy is trained.
    """

    def __init__(self, config: PostTrainConfig, prior: ScenePrior) -> None:
        self.config = config
        self.prior = deepcopy(prior).to(config.device).eval()
        self.slots = self.prior.config.slots if config.slots is None else config.slots
        self.policy = DenoisingPolicy(self.prior, config.num_steps, chunk=config.chunk)
        self.stds = self.policy.stds(self.slots).cpu()
        weights = gradient_weights(
            self.stds, min_std=config.min_std, skip_first=config.skip_first, weighting=config.step_weighting
        )
        self.loss = DDPOSFLoss(
            self.policy, step_weights=weights, reduction=config.log_prob_reduction, clip_epsilon=config.clip_epsilon
        ).to(config.device)
        self.env = DenoisingTorchRLEnv(
            config.batch_size,
            scene=self.prior.scene_type,
            reward=config.reward,
            num_steps=config.num_steps,
            prior=self.prior,
            slots=self.slots,
            workers=config.workers,
        )
        self.parameters = [p for p in self.prior.parameters() if p.requires_grad]
        self.optimizer = torch.optim.AdamW(
            self.parameters, lr=config.learning_rate, weight_decay=config.weight_decay, betas=(0.9, 0.999)
        )
        self.average = WeightAverage(self.prior, config.ema) if config.ema else None

    def close(self) -> None:
        """Stop physics workers, if any."""
        self.env.close()

    def rollout(self, iteration: int) -> Rollout:
        """A batch of fresh scenes."""
        return collect(self.env, self.policy, seed=self.config.seed, iteration=iteration)

    def advantage(self, rollout: Rollout) -> Tensor:
        """(B,) or (B, N), as ``credit`` says."""
        config = self.config
        reward, valid = credited_reward(rollout, config.credit)
        return compute_advantages(reward, valid, baseline=config.baseline, clip=config.advantage_clip)

    def accumulate(self, rollout: Rollout, advantage: Tensor, scenes: RealScenes, index: int) -> dict[str, float]:
        """Put both gradients into ``.grad`` and measure them apart.

        Args:
            rollout: the batch.
            advantage: its advantages.
            scenes: real scenes for the regularisation.
            index: number of the update in the run; steps and real scenes are drawn by it.
        """
        config = self.config
        weights = self.loss.step_weights.cpu()
        steps, scale = draw_steps(weights, config.gradient_steps, self._generator("steps", index))
        self.optimizer.zero_grad(set_to_none=True)
        policy = accumulate_policy_gradient(self.loss, rollout, advantage, steps, scale=scale)
        generator = self._generator("real", index)
        x0 = scenes.batch(config.regularisation_batch, generator)
        real_loss, real_norm = add_regularisation_gradient(
            self.prior, x0, config.regularisation, generator, chunk=config.chunk
        )
        return {
            "policy_loss": policy.loss,
            "policy_gradient_norm": policy.norm,
            "pretraining_loss": real_loss,
            "pretraining_gradient_norm": real_norm,
            "log_ratio": policy.log_ratio,
            "clip_fraction": policy.clip_fraction,
        }

    def update(self, rollout: Rollout, advantage: Tensor, scenes: RealScenes, index: int) -> dict[str, float]:
        """One optimiser step.

        Raises:
            NonFiniteGradient: the gradient is not finite; nothing was changed.
        """
        config = self.config
        row = self.accumulate(rollout, advantage, scenes, index)
        row["gradient_norm"] = float(nn.utils.clip_grad_norm_(self.parameters, config.clip))
        if not all(is_finite(row[name]) for name in ("gradient_norm", "policy_loss", "pretraining_loss")):
            self.optimizer.zero_grad(set_to_none=True)
            raise NonFiniteGradient(row)
        row["learning_rate"] = config.learning_rate * min(1.0, (index + 1) / max(1, config.warmup))
        for group in self.optimizer.param_groups:
            group["lr"] = row["learning_rate"]
        self.optimizer.step()
        if self.average is not None:
            self.average.update(self.prior)
        return row

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "prior": self.prior.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "average": None if self.average is None else self.average.tensors,
            "average_updates": 0 if self.average is None else self.average.updates,
            "random": torch.get_rng_state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        self.prior.load_state_dict(state["prior"])
        self.optimizer.load_state_dict(state["optimizer"])
        if self.average is not None:
            self.average.tensors, self.average.updates = state["average"], state["average_updates"]
        torch.set_rng_state(state["random"])

    def judged(self) -> JudgedWeights:
        """Context in which the prior holds the weights that are judged and saved: the average, when there is one."""
        return JudgedWeights(self.prior, self.average)

    def _generator(self, stream: str, index: int) -> Generator:
        return Generator().manual_seed(stream_seed(self.config.seed, stream, index))


class JudgedWeights:
    """Swaps averaged weights in, and the training weights back in afterwards."""

    def __init__(self, prior: ScenePrior, average: WeightAverage | None) -> None:
        self.prior, self.average = prior, average
        self._own: dict[str, Tensor] = {}

    def __enter__(self) -> ScenePrior:
        if self.average is not None:
            self._own = {name: p.detach().clone() for name, p in self.prior.named_parameters()}
            self.average.copy_to(self.prior)
        return self.prior

    def __exit__(self, *_: object) -> None:
        with torch.no_grad():
            for name, parameter in self.prior.named_parameters():
                if name in self._own:
                    parameter.copy_(self._own[name])


def is_finite(value: float) -> bool:
    """Neither NaN nor infinite."""
    return value == value and abs(value) != float("inf")
