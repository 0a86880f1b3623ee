"""States of a mixed prior: a pose beside a discrete category per slot, what of them is known, and their noise."""

from __future__ import annotations

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.diffusion import CategoricalProcess, MixedStep
from agents.networks.mixed_denoiser import MixedDenoiser, Observed
from agents.priors.base import ScenePrior
from agents.priors.config import MixedPriorConfig
from agents.priors.text import PromptReader
from scene_envs.scene import POSE_FEATURES, SceneBatch


class MixedStates(PromptReader, ScenePrior):
    """The part of :class:`~agents.priors.mixed.MixedPrior` that says what its scenes x (B, N, 12 + K) are."""

    mixed: MixedPriorConfig
    denoiser: MixedDenoiser
    categories: CategoricalProcess
    """The process of the categories."""

    def observed_entries(self, x: Tensor, observed: Observed | None = None) -> Observed | None:
        """Observed entries of scenes ``x`` (B, N, D) for the network: ``observed``, or else the fixed objects.

        A prior trained with observed entries has always been told of its fixed objects; one trained without is not.
        """
        if observed is not None or self.mixed.observed_share <= 0:
            return observed
        fixed = torch.zeros(x.shape[:2], dtype=torch.bool, device=x.device)
        fixed[:, : len(self.scene_type.fixed)] = True
        return Observed(x, fixed, fixed)

    @property
    def num_categories(self) -> int:
        """K = C + 1."""
        return self.mixed.network.categories

    @property
    def is_constant(self) -> Tensor:
        """(D,) bool: features of the pose that never vary."""
        constant = self.normalizer.is_constant.clone()
        constant[POSE_FEATURES:] = False
        return constant

    def normalised(self, batch: SceneBatch) -> Tensor:
        """(B, N, D): normalised pose, one-hot category as it is.

        The pose of an empty slot means nothing; it takes the mean of poses, where it asks nothing of the network.
        """
        pose = batch.to_tensor(normalised=self.normalizer)[..., :POSE_FEATURES]
        pose = torch.where(batch.is_empty[..., None], self.preconditioning.mean.to(pose), pose)
        return torch.cat([pose, batch.tensor[..., POSE_FEATURES:]], dim=-1)

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        """x_T (count, slots, D): normal poses, categories from the end of their chain, known entries clamped."""
        noise = torch.randn(count, slots, self.scene_type.features, generator=generator, device=self._fixed.device)
        probs = self.categories.prior().to(noise).expand(count, slots, -1)
        return self.clamp(self.with_states(noise[..., :POSE_FEATURES], probs, noise))

    def add_noise(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """A sample of q(x_t | x_0) from standard normal noise (B, N, D)."""
        pose = self.process.add_noise(x0[..., :POSE_FEATURES], t, noise[..., :POSE_FEATURES])
        category = x0[..., POSE_FEATURES:].argmax(dim=-1)
        return self.clamp(self.with_states(pose, self.categories.marginal(category, t.expand(len(x0))), noise))

    @staticmethod
    def with_states(pose: Tensor, probs: Tensor, noise: Tensor) -> Tensor:
        """``pose`` (B, N, 12) beside states drawn from ``probs`` (B, N, K + 1) by ``noise`` (B, N, D)."""
        random = torch.ones(pose.shape[1], dtype=torch.bool, device=pose.device)
        return MixedStep(pose, torch.zeros_like(pose[0]), probs, random).from_noise(noise)

    def barred_categories(self, state: Tensor) -> Tensor:
        """(B, N, K) bool: categories of x_0 with probability 0, given states (B, N) of x_t.

        These are the categories of fixed objects, in all slots but theirs. A slot that holds one as an observed entry
        keeps it where the chain only absorbs.
        """
        barred = torch.zeros(*state.shape, self.num_categories, dtype=torch.bool, device=state.device)
        barred[:, len(self.scene_type.fixed) :, list(self.scene_type.fixed_categories)] = True
        if self.categories.only_absorbs:
            barred &= F.one_hot(state, self.num_categories + 1)[..., :-1] == 0
        return barred
