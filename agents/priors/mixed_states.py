"""States of a mixed prior: pose and discrete category of each slot, their known entries, and their noise."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import TypeVar

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.diffusion import CategoricalProcess, MixedStep, StepTable
from agents.networks.mixed_denoiser import MixedDenoiser, Observed
from agents.priors.base import ScenePrior
from agents.priors.config import MixedPriorConfig
from agents.priors.text import PromptReader
from scene_envs.scene import POSE_FEATURES, SceneBatch
from scene_envs.scene_types import members_of

Prior = TypeVar("Prior", bound="MixedStates")


class MixedStates(PromptReader, ScenePrior):
    """The part of :class:`~agents.priors.mixed.MixedPrior` that defines its scenes x (B, N, 12 + K)."""

    config: MixedPriorConfig
    denoiser: MixedDenoiser
    categories: CategoricalProcess
    """The process of the categories."""

    def observed_entries(self, x: Tensor, observed: Observed | None = None) -> Observed | None:
        """Observed entries of scenes ``x`` (B, N, D) for the network: ``observed``, or else the fixed objects.

        A prior trained with observed entries was always told of its fixed objects. A prior trained without them is not
        told of any.
        """
        if observed is not None or self.config.observed_share <= 0:
            return observed
        fixed = torch.zeros(x.shape[:2], dtype=torch.bool, device=x.device)
        fixed[:, : len(self.scene_type.fixed)] = True
        return Observed(x, fixed, fixed)

    def with_union(self: Prior, union: str) -> Prior:
        """Restrict the scenes of a union, as :meth:`ScenePrior.with_union` does."""
        super().with_union(union)
        self.config = replace(self.config, union=union)
        return self

    def with_open_empty(self: Prior, share: float) -> Prior:
        """Set the share of training masks that open every empty slot, as :meth:`ScenePrior.with_open_empty` does."""
        self.config = replace(self.config, open_empty_share=share)
        return self

    @property
    def num_categories(self) -> int:
        """K = C + 1."""
        return self.config.network.categories

    @property
    def is_constant(self) -> Tensor:
        """(D,) bool: features of the pose that never vary."""
        constant = self.normalizer.is_constant.clone()
        constant[POSE_FEATURES:] = False
        return constant

    def normalised(self, batch: SceneBatch) -> Tensor:
        """(B, N, D): normalised pose, one-hot category as it is.

        The pose of an empty slot has no meaning. It is set to the mean of poses, so that it asks nothing of the
        network.
        """
        pose = batch.to_tensor(normalised=self.normalizer)[..., :POSE_FEATURES]
        pose = torch.where(batch.is_empty[..., None], self.preconditioning.mean.to(pose), pose)
        return torch.cat([pose, batch.tensor[..., POSE_FEATURES:]], dim=-1)

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        """x_T (count, slots, D): normal poses, categories from their distribution at T, known entries clamped."""
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

    def barred_categories(self, state: Tensor, closed: Tensor | None = None) -> Tensor:
        """(B, N, K) bool: categories of x_0 with probability 0, given states (B, N) of x_t.

        These are the categories of fixed objects, in all slots but theirs, and ``closed`` (B, K). With
        ``union="one_type"``, they are also the assets that no member has together with all assets that the scene holds
        already. If the chain only absorbs, the category that a slot holds already is not barred in this slot.
        """
        barred = torch.zeros(*state.shape, self.num_categories, dtype=torch.bool, device=state.device)
        barred[:, len(self.scene_type.fixed) :, list(self.scene_type.fixed_categories)] = True
        if closed is not None:
            barred |= closed[:, None]
        if self.categories.only_absorbs:
            held = F.one_hot(state, self.num_categories + 1)[..., :-1] > 0
            if self._separates_members:
                barred[..., :-1] |= ~self._fitting_assets(held[..., :-1].any(dim=1))[:, None]
            barred &= ~held
        return barred

    def step_table(self, num_steps: int) -> StepTable:
        """The reverse steps of a chain of ``num_steps``, any number in 1..T.

        If a scene holds the assets of one member of a union only, each of the first steps unmasks about one slot.
        """
        if self._separates_members:
            return StepTable.gradual(self.categories.schedule.mask, self.config.slots, num_steps)
        return super().step_table(num_steps)

    @property
    def _separates_members(self) -> bool:
        """Whether a scene holds the assets of one member of a union only."""
        return self.config.union == "one_type" and len(self._members) > 1 and self.categories.only_absorbs

    @cached_property
    def _members(self) -> Tensor:
        """(M, C) bool: assets of each member of a union of scene types; one row for any other type."""
        assets = self.scene_type.assets
        return torch.tensor([[asset in member.assets for asset in assets] for member in members_of(self.scene_type)])

    def _fitting_assets(self, present: Tensor) -> Tensor:
        """(B, C) bool: assets of the members that have all of ``present`` (B, C) bool; all if no member has them."""
        members = self._members.to(present.device)
        fits = ~(present[:, None] & ~members).any(dim=-1)  # (B, M)
        allowed = (fits[..., None] & members).any(dim=1)
        return allowed | ~fits.any(dim=-1, keepdim=True)
