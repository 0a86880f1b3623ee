"""Rewards that a run trains, or whose statistics it fixes: before the run and in every iteration, and their state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agents.post_training.config import PostTrainConfig
from agents.post_training.rollouts import Rollout, gathered, stream_seed
from agents.priors.prior import ScenePrior
from agents.utils.process_group import ProcessGroup
from rewards import RewardContext, learned_parts
from rewards.statistics import fit_statistics, has_open_statistics, load_statistics, statistics_of
from scene_envs.scene import SceneBatch

FIRST_SAMPLES = 128
"""Samples of the base prior that a reward learns from before the first iteration."""
FIRST_STEPS = 150
"""Optimiser steps on these samples."""


class LearnedRewards:
    """The parts of a run's reward that learn (:class:`rewards.LearnedReward`), and those that are normalised.

    All processes have the same models. The mean and the standard deviation of a normalised part, if they are not given,
    are fixed at those of samples of the base prior, so that values of different batches can be compared.

    Args:
        reward: resolved reward of the run.
        config: of the run.
    """

    def __init__(self, reward: Any, config: PostTrainConfig) -> None:
        self.parts = learned_parts(reward)
        self._reward = reward
        self._config = config
        self._seed = stream_seed(config.seed, "discriminator")

    def __bool__(self) -> bool:
        return bool(self.parts)

    @property
    def needs_samples(self) -> bool:
        """Whether :meth:`learn_from_prior` does anything."""
        return bool(self.parts) or has_open_statistics(self._reward)

    def begin(self, real: SceneBatch) -> None:
        """Give the parts the real scenes that training may see; normalised parts have their given statistics."""
        self.end()
        for part in self.parts:
            part.begin(real, self._seed)

    def learn_from_prior(self, prior: ScenePrior, slots: int, prompts: Sequence[str] | None) -> None:
        """Train the parts on samples of the base prior, before they score the first batch, and fix statistics.

        Args:
            prior: the base prior.
            slots: per sample.
            prompts: one for each of the ``FIRST_SAMPLES``; None without prompts.
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
        fit_statistics(self._reward, batch, RewardContext(None if prompts is None else tuple(prompts)))

    def learn(self, rollout: Rollout) -> None:
        """Train the parts on the scenes of a batch, after these were scored."""
        if self.parts:
            scenes = gathered(rollout)[-1]
            for part in self.parts:
                part.learn(scenes)

    def end(self) -> None:
        """Normalised parts have their given statistics again."""
        load_statistics(self._reward, None)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {
            "learned_rewards": [part.state_dict() for part in self.parts],
            "reward_statistics": statistics_of(self._reward),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Inverse of :meth:`state`, after :meth:`begin`; a checkpoint of an earlier version has no statistics."""
        for part, own in zip(self.parts, state.get("learned_rewards", ()), strict=True):
            part.load_state_dict(own)
        load_statistics(self._reward, state.get("reward_statistics") or None)
