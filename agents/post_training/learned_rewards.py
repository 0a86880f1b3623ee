"""Rewards that a run trains: before the run and in every iteration, and their state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from agents.post_training.config import PostTrainConfig
from agents.post_training.rollouts import Rollout, gathered, stream_seed
from agents.priors.base import ScenePrior
from agents.utils.process_group import ProcessGroup
from rewards import learned_parts
from scene_envs.scene import SceneBatch

FIRST_SAMPLES = 128
"""Samples of the base prior that a reward learns from before the first iteration."""
FIRST_STEPS = 150
"""Optimiser steps on these samples."""


class LearnedRewards:
    """The parts of a run's reward that learn (:class:`rewards.LearnedReward`).

    All processes have the same models.

    Args:
        reward: resolved reward of the run.
        config: of the run.
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

    def learn(self, rollout: Rollout) -> None:
        """Train the parts on the scenes of a batch, after these were scored."""
        if self.parts:
            scenes = gathered(rollout)[-1]
            for part in self.parts:
                part.learn(scenes)

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"learned_rewards": [part.state_dict() for part in self.parts]}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Inverse of :meth:`state`, after :meth:`begin`."""
        for part, own in zip(self.parts, state["learned_rewards"], strict=True):
            part.load_state_dict(own)
