"""Division of a batch among processes: sizes of the shares, and rewards that need the whole batch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from agents.post_training.config import PostTrainConfig
from agents.utils.process_group import ProcessGroup, gather_rows
from rewards import RewardContext, RewardOutput, reward_name
from rewards.evaluation import evaluate_reward
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


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
    """A reward that depends on the other scenes of a batch: each process scores the scenes of all processes.

    Args:
        reward: resolved reward.
        processes: processes that all call this reward at the same time, each with the same number of scenes.
    """

    depends_on_batch = True

    def __init__(self, reward: Any, processes: ProcessGroup) -> None:
        self._reward, self._processes = reward, processes
        self.name = reward_name(reward)

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
