"""Base class of algorithms that train on their own finished samples, noised anew for every update."""

from __future__ import annotations

from abc import abstractmethod
from collections import defaultdict
from typing import Any

from tensordict import TensorDict
from torch import Generator

from agents.post_training.averaged_sampler import AveragedSampler
from agents.post_training.expectation import Expectation
from agents.post_training.gradients import BatchGradient, GradientSum
from agents.post_training.own_sample_loss import OwnSampleLoss
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import Rollout
from agents.utils.process_group import ProcessGroup, gather_rows


class OwnSampleAlgorithm(AveragedSampler):
    """An algorithm that trains on the finished scenes of an averaged sampler.

    Args:
        policy: policy that is optimised.
        draws: number of timesteps and noises of every scene per update.
        sampler_decay: decay, per :meth:`WeightAverage.update`, of the weight average that samples.

    Attributes:
        copy: a copy of the denoiser that is trained on the samples, with ``loss_expectation``; None for none.
    """

    loss: OwnSampleLoss
    copy: Expectation | None

    def __init__(self, policy: DenoisingPolicy, *, draws: int, sampler_decay: float) -> None:
        super().__init__(policy, sampler_decay=sampler_decay)
        self.draws = draws

    @abstractmethod
    def advantage(self, rollout: Rollout) -> TensorDict:
        """The tensors that the loss reads in addition to the scenes, by key."""

    def measure(self, result: TensorDict) -> dict[str, float]:
        """Figures of a part of the batch, from ``result``, the loss of this part."""
        return {}

    def accumulate(self, rollout: Rollout, advantage: TensorDict, generator: Generator) -> BatchGradient:
        """Add the gradient of a batch to ``.grad``: ``draws`` timesteps and noises of every scene.

        With several processes, ``.grad`` gets the part of this process's scenes in the mean over all scenes.
        """
        x0 = self.prior.encode(rollout.batch.to(self.prior.device))
        fields: dict[str, Any] = {"scene": x0, "valid": rollout.valid, **advantage}
        if rollout.text is not None:
            fields |= {"text": rollout.text[0], "text_mask": rollout.text[1]}
        scenes = TensorDict(fields, [len(x0)])
        size, processes = self.policy.chunk or len(x0), ProcessGroup.current()
        valid = max(1.0, processes.sum_numbers(int(rollout.valid.sum()))[0])
        everything, own = gather_rows(x0), processes.rows(processes.size * len(x0))
        draws = [self.prior.noised(everything, generator).rows(own) for _ in range(self.draws)]
        total, sums = 0.0, defaultdict[str, float](float)
        learned = [] if self.copy is None else self.copy.trained
        gradient = GradientSum([*self.prior.parameters(), *learned])
        for start in range(0, len(x0), size):
            rows = slice(start, start + size)
            part = scenes[rows]
            share = int(part["valid"].sum()) / valid / self.draws
            for noised in draws:
                result = self.loss.of_noised(noised.rows(rows), part)
                objective = result["loss_objective"] * share
                (objective + result["loss_expectation"] * share).backward()
                total += float(objective.detach())
                for name, value in self.measure(result).items():
                    sums[name] += share * value
            gradient.add_part()
        gradient.write()
        if self.copy is not None:
            self.copy.step()
        total, *means = processes.sum_numbers(total, *sums.values())
        return BatchGradient(total, dict(zip(sums, means, strict=True)))
