"""Forward-process algorithms: sampling policy, advantages, and gradient of a batch."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Generator, Tensor

from agents.post_training.advantages import Advantage, at_all_steps, compute_advantages, final_reward, prompt_groups
from agents.post_training.algorithm_settings import AWMSettings, NFTSettings
from agents.post_training.expectation import Expectation
from agents.post_training.forward_losses import AWMLoss, NFTLoss
from agents.post_training.forward_process_loss import ForwardProcessLoss
from agents.post_training.gradients import BatchGradient
from agents.post_training.own_samples import OwnSampleAlgorithm
from agents.post_training.policy import DenoisingPolicy
from agents.priors.prior import ScenePrior


class ForwardAdvantage(Advantage):
    """Writes advantages that are not clipped, of poses and of categories.

    Reads, in addition to the keys of :class:`Advantage`:
        judged: (B, S, N) bool, optional. Slots that the reward does not judge have no advantage of their own: a table
            of credit 0 would otherwise be repelled like an object that is not feasible.
        counts_objects: (B, S, 1) bool, optional, whether the reward depends on which objects there are.

    Writes, in addition:
        category_advantage: (B, S, 1), the scene's advantage, or zeros for no credit.

    Args:
        credit: ``"scene"``, ``"object"`` or ``"auto"``, for poses.
        category_credit: ``"scene"``, ``"none"``, or ``"auto"``: none where poses have credit per object and the reward
            does not count objects.
    """

    out_keys = ["advantage", "category_advantage", "valid"]  # noqa: RUF012

    def __init__(self, *, credit: str = "auto", category_credit: str = "auto") -> None:
        super().__init__(credit=credit, clip=math.inf)
        self.category_credit = category_credit

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``out_keys``."""
        final = super().forward(tensordict)[:, -1]
        per_object = self.credited(final)[0].ndim == 2
        poses_alone = per_object and not bool(final.get("counts_objects", torch.zeros(1)).any())
        if self.category_credit == "none" or (self.category_credit == "auto" and poses_alone):
            categories = torch.zeros_like(final["advantage"][:, 0])
        else:
            categories = compute_advantages(*final_reward(final), clip=math.inf, groups=prompt_groups(final))
        return tensordict.set("category_advantage", at_all_steps(categories, tensordict))

    def credited(self, final: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Rewards of slots that are judged, or of scenes."""
        reward, valid = super().credited(final)
        judged = final.get("judged", None)
        return reward, valid if reward.ndim == 1 or judged is None else valid & judged


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
        self.advantage = ForwardAdvantage(credit=settings.credit, category_credit=settings.category_credit)
        rate = settings.expectation_lr
        self.copy = Expectation(self.sampler, rate) if rate else None
        self.loss = self.make_loss()

    def make_loss(self) -> ForwardProcessLoss:
        """The loss that the settings name."""
        settings = self.settings
        kind = NFTLoss if isinstance(settings, NFTSettings) else AWMLoss
        return kind(self.prior, self.sampler, beta=settings.beta, clip=settings.advantage_clip, expectation=self.copy)

    def measure(self, result: TensorDict) -> dict[str, float]:
        """Mean square of the trained denoiser's output minus the sampling policy's."""
        return {"distance": float(result["distance"]) ** 2}

    def accumulate(self, batch: TensorDictBase, generator: Generator) -> BatchGradient:
        """See :class:`OwnSampleAlgorithm`; ``distance`` is a root mean square."""
        gradient = super().accumulate(batch, generator)
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
