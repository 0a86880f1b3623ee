"""Checks before the first sample that a post-training run can learn."""

from __future__ import annotations

import torch
from torch import Generator

from agents.post_training.advantages import no_credit_per_object
from agents.post_training.config import PostTrainConfig
from agents.post_training.learner import Learner
from agents.post_training.prompts import PromptSets
from scene_envs.errors import InvalidInputError, TrainingError
from scene_envs.scene import SceneBatch

_PROBED = 2
"""Real scenes on which the reward of a run is tried."""
_PROBED_WITH_PROMPTS = 8
"""The same number in a run that uses the prompts of its real scenes."""


def check_it_can_learn(learner: Learner, real: SceneBatch, prompts: PromptSets | None) -> None:
    """Score real scenes as the scenes of the run will be scored.

    Real scenes are scored with their own prompts if the run uses the prompts of real scenes, and with the prompts of
    the run otherwise. With prompts that are not their own, it may be that no real scene can be scored. A run with such
    prompts is therefore not refused if no real scene is scored.

    Args:
        learner: learner of the run, which can already deal prompts.
        real: real scenes.
        prompts: prompts of each real scene; None for a prior that reads no prompts.

    Raises:
        InvalidInputError: credit per object is asked of a reward that gives none, or the guard has a limit of
            stacks for assets without geometry.
        TrainingError: the reward scores none of the real scenes.
    """
    config, scene_type = learner.config, learner.prior.scene_type
    if config.guard.limits.stack is not None and not scene_type.has_geometry:
        raise InvalidInputError(
            f"guard.limits.stack={config.guard.limits.stack} needs the geometry of the assets, and those of "
            f"{scene_type.name!r} have none here; leave it out"
        )
    scenes, texts = _tried(learner, real, prompts)
    score = learner.scorer(scenes, texts)
    valid = bool(score.valid.any())
    if valid and score.per_object is None and getattr(config.algorithm, "credit", "") == "object":
        raise no_credit_per_object()
    if config.prompt in (None, "data") and not learner.processes.any(valid):
        pairs = "" if texts is None else " with a prompt"
        raise nothing_scored(config, f"none of {len(scenes)} real scenes{pairs}, so that nothing was sampled")


def nothing_scored(config: PostTrainConfig, what: str) -> TrainingError:
    """The error for a run whose reward scored ``what``."""
    return TrainingError(
        f"the reward {config.plain()['reward']!r} scored {what}; the warnings above say why, and "
        "`scene-envs check-reward` tries a reward on its own"
    )


def _tried(learner: Learner, real: SceneBatch, prompts: PromptSets | None) -> tuple[SceneBatch, list[str] | None]:
    """The first real scenes and a prompt for each, None in a run without prompts.

    If the run uses the prompts of real scenes, more scenes are tried, each with all of its prompts, because a reward
    may read only one kind of prompt.
    """
    if learner.config.prompt == "data" and prompts is not None:
        pairs = [(row, text) for row in range(min(_PROBED_WITH_PROMPTS, len(real))) for text in prompts(row)]
        return real[torch.tensor([row for row, _ in pairs])], [text for _, text in pairs]
    scenes = real[:_PROBED]
    if learner.deck is None:
        return scenes, None
    return scenes, learner.deck.deal(len(scenes), Generator().manual_seed(learner.config.seed))
