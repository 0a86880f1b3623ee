"""Forward-process algorithms: their sampling policy, their advantages, and their gradient of a batch."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from agents.post_training.advantages import compute_advantages
from agents.post_training.algorithm_settings import AWMSettings, NFTSettings
from agents.post_training.expectation import Expectation
from agents.post_training.forward_losses import AWMLoss, NFTLoss
from agents.post_training.forward_process_loss import ForwardProcessLoss
from agents.post_training.gradients import BatchGradient, credited_reward, judged_slots
from agents.post_training.own_samples import OwnSampleAlgorithm
from agents.post_training.policy import DenoisingPolicy
from agents.post_training.rollouts import Rollout, rollout_groups
from agents.priors.base import ScenePrior


class ForwardProcess(OwnSampleAlgorithm):
    """Algorithm of NFT and AWM, which differ in their loss; see :class:`ForwardProcessLoss`.

    A slower copy of the prior in training, an average of its weights, samples the scenes. This copy is also evaluated
    and saved.

    Args:
        settings: settings of the algorithm.
        policy: policy that is optimised.
        stds: sigmas of the reverse steps; not used.
    """

    loss: ForwardProcessLoss

    def __init__(self, settings: NFTSettings | AWMSettings, policy: DenoisingPolicy, stds: Tensor) -> None:
        super().__init__(policy, draws=settings.draws, sampler_decay=settings.sampler_decay)
        self.settings = settings
        rate = settings.expectation_lr
        self.copy = Expectation(self.sampler, rate) if rate else None
        self.loss = self.make_loss()

    def make_loss(self) -> ForwardProcessLoss:
        """The loss that the settings name."""
        settings = self.settings
        kind = NFTLoss if isinstance(settings, NFTSettings) else AWMLoss
        return kind(self.prior, self.sampler, beta=settings.beta, clip=settings.advantage_clip, expectation=self.copy)

    def advantage(self, rollout: Rollout) -> TensorDict:
        """``advantage`` (B, 1) or (B, N) for poses and ``category_advantage`` (B, 1), as the credit settings say."""
        settings = self.settings
        reward, valid = credited_reward(rollout, settings.credit)
        per_object = reward.ndim == 2
        if per_object:  # a table that is not judged has credit 0; with an advantage it would be repelled
            valid = valid & judged_slots(rollout).to(valid.device)
            poses = compute_advantages(reward, valid, clip=math.inf, groups=rollout_groups(rollout))
        else:
            poses = self._scene_advantages(rollout)
        poses_alone = per_object and not rollout.counts
        if settings.category_credit == "none" or (settings.category_credit == "auto" and poses_alone):
            categories = torch.zeros_like(poses[:, :1])
        else:
            categories = self._scene_advantages(rollout)
        return TensorDict({"advantage": poses, "category_advantage": categories}, [len(reward)])

    def _scene_advantages(self, rollout: Rollout) -> Tensor:
        """(B, 1) advantages of whole scenes."""
        groups = rollout_groups(rollout)
        return compute_advantages(rollout.reward, rollout.valid, clip=math.inf, groups=groups)[:, None]

    def measure(self, result: TensorDict) -> dict[str, float]:
        """Mean square of the trained denoiser's output minus the sampling policy's."""
        return {"distance": float(result["distance"]) ** 2}

    def accumulate(self, rollout: Rollout, advantage: TensorDict, generator: Generator) -> BatchGradient:
        """See :class:`OwnSampleAlgorithm`; ``distance`` is a root mean square."""
        gradient = super().accumulate(rollout, advantage, generator)
        return replace(gradient, columns={**gradient.columns, "distance": gradient.columns["distance"] ** 0.5})

    def return_to(self, prior: ScenePrior) -> None:
        """Sample with the weights of ``prior``; the expectation begins with them as well."""
        super().return_to(prior)
        if self.copy is not None:
            self.copy.return_to(prior)

    def state(self) -> dict[str, Any]:
        """The state of the sampling policy, and that of the expectation."""
        return {**super().state(), "expectation": None if self.copy is None else self.copy.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`state`."""
        super().restore(state)
        if self.copy is not None:
            self.copy.restore(state["expectation"])
