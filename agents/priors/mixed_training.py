"""Training of a mixed prior: loss, observed entries for inpainting, and the residual error of the denoiser."""

from __future__ import annotations

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.diffusion import ResidualVariance, StepTable
from agents.diffusion.reverse_steps import state_of
from agents.diffusion.weighting import loss_weights
from agents.networks.mixed_denoiser import Observed
from agents.networks.text import Text
from agents.priors.forward import DenoiserOutput, NoisedScenes
from agents.priors.mixed_states import MixedStates
from scene_envs.scene import POSE_FEATURES

_EMPTY_WEIGHT = 0.1
"""Weight of the pose of an empty slot in the loss. The pose has no meaning, but chains should not drift on it."""

_COUNT_WEIGHT = 0.5
"""Weight of the count loss of networks with count conditioning, which read numbers of objects from the text alone."""

_AT_ONCE = 32
"""Scenes whose residual is measured in one batch: features of all pairs of slots of 512 rooms would be gigabytes."""


class TrainableMixedPrior(MixedStates):
    """The part of :class:`~agents.priors.mixed.MixedPrior` that is needed to train it."""

    def noised_loss(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) mean squared pose error plus ``category_weight`` times the category loss, over unobserved entries."""
        config = self.config
        text = self.unconditional(len(noised.t)) if text is None else text
        output = self.output(noised, text)
        logits, drawn, weight = output.logits, noised.drawn, noised.weight
        assert logits is not None
        assert drawn is not None
        error = output.continuous - noised.target
        pose_loss = (error.square() * weight).sum(dim=(1, 2)) / weight.sum(dim=(1, 2)).clamp(min=1.0)
        pose_loss = pose_loss * noised.scale
        if config.category_loss == "bound":
            states = state_of(noised.x_t[..., POSE_FEATURES:])
            losses = self.categories.loss(noised.category, states, noised.t, logits, config.auxiliary)
        else:
            losses = F.cross_entropy(logits.flatten(0, 1), noised.category.flatten(), reduction="none").view_as(drawn)
        category_loss = (losses * drawn).sum(dim=1) / drawn.sum(dim=1).clamp(min=1.0)
        loss = pose_loss + config.category_weight * category_loss
        conditioning = self.count_conditioning
        if conditioning is not None and text is not None:
            loss = loss + _COUNT_WEIGHT * conditioning.count_loss(text[0][:, : conditioning.things], noised.category)
        return loss

    def noised(self, x0: Tensor, generator: Generator | None = None, t: Tensor | None = None) -> NoisedScenes:
        """Noised scenes, their targets and weights; see :meth:`ScenePrior.noised`."""
        config, device = self.config, x0.device
        if t is None:
            t = self.draw_timesteps(x0.shape[0], generator).to(device)
        noise = torch.randn(x0.shape, generator=generator).to(device)
        observed = self.draw_observed(x0, generator) if config.observed_share > 0 else None
        x_t = self.add_noise(x0, t, noise)
        x_t = x_t if observed is None else observed.write(x_t)
        pose0, category = x0[..., :POSE_FEATURES], x0[..., POSE_FEATURES:].argmax(dim=-1)
        states = state_of(x_t[..., POSE_FEATURES:])
        moments = self.denoiser.moments(states, t)
        target = self.process.target(pose0, x_t[..., :POSE_FEATURES], t, noise[..., :POSE_FEATURES], moments)
        weight = self.loss_weight(x0.shape[1])[None, :, :POSE_FEATURES].to(device).expand(len(x0), -1, -1)
        empty = (category == self.num_categories - 1)[..., None]
        weight = torch.where(empty, _EMPTY_WEIGHT * weight, weight)
        drawn = torch.ones(x0.shape[:2], device=device)
        drawn[:, : len(self.scene_type.fixed)] = 0.0
        if observed is not None:
            weight = weight * (~observed.pose)[..., None]
            drawn = drawn * (~observed.category)
        if self.denoiser.drops_empty:  # an unmasked category is certain
            drawn = drawn * (states == self.num_categories)
        scale = loss_weights(self.process.schedule, t, config.prediction, config.loss_weighting).to(device)
        return NoisedScenes(x_t, t, target, weight, scale, category, drawn, observed)

    def output(self, noised: NoisedScenes, text: Text | None = None) -> DenoiserOutput:
        """The pose output (B, N, 12) and logits (B, N, K) of noised scenes."""
        text = self.unconditional(len(noised.t)) if text is None else text
        return DenoiserOutput(*self.denoiser.output(noised.x_t, noised.t, noised.observed, text))

    def denoised(self, noised: NoisedScenes, output: DenoiserOutput) -> Tensor:
        """(B, N, 12) estimate of the clean poses from the pose output of noised scenes."""
        poses, states = noised.x_t[..., :POSE_FEATURES], state_of(noised.x_t[..., POSE_FEATURES:])
        moments = self.denoiser.moments(states, noised.t)
        return self.process.x0_from_output(poses, noised.t, output.continuous, moments)

    def draw_observed(self, x0: Tensor, generator: Generator | None) -> Observed:
        """Random observed entries: slots (completion), all categories (rearrangement), or any attribute of any slot.

        In ``open_empty_share`` of the completions, only objects are observed and all empty slots are open. A search
        masks slots because they are empty. Under random masks alone, many open slots beside many observed objects are
        a sign of a full scene.
        """
        batch, slots = x0.shape[:2]
        kind, share = torch.rand(2, batch, 1, generator=generator)
        kind = kind / max(self.config.observed_share, 1e-9)  # above 1: nothing is observed
        picks = torch.rand(2, batch, slots, generator=generator) < share
        whole, rearrange, free = kind < 0.5, (kind >= 0.5) & (kind < 0.75), (kind >= 0.75) & (kind < 1.0)
        if self.config.open_empty_share > 0:
            empty = (x0[..., POSE_FEATURES:].argmax(dim=-1) == self.num_categories - 1).cpu()
            opened = torch.rand(batch, 1, generator=generator) < self.config.open_empty_share
            picks[0] &= ~(whole & opened & empty)
        pose = (whole & picks[0]) | (rearrange & picks[0] & (share < 0.5)) | (free & picks[0])
        category = (whole & picks[0]) | rearrange.expand(-1, slots) | (free & picks[1])
        fixed = torch.zeros(slots, dtype=torch.bool)
        fixed[: len(self.scene_type.fixed)] = True
        return Observed(x0, (pose | fixed).to(x0.device), (category | fixed).to(x0.device))

    @torch.no_grad()
    def fit_residual(self, x0: Tensor, levels: int = 40, seed: int = 0) -> ResidualVariance:
        """Measure the error of the denoised pose on scenes ``x0`` (B, N, D) at ``levels`` timesteps, and keep it."""
        generator = Generator().manual_seed(seed)
        timesteps = StepTable.spaced(self.config.num_timesteps, levels).timesteps.flip(0)
        present = (x0[..., POSE_FEATURES:].argmax(dim=-1) != self.num_categories - 1).float()
        present[:, : len(self.scene_type.fixed)] = 0.0
        rows = []
        for t in timesteps:
            noise = torch.randn(x0.shape, generator=generator).to(x0.device)
            level = t.to(x0.device).expand(len(x0))
            poses = [
                self.denoiser(part, level[: len(part)], self.observed_entries(part), self.unconditional(len(part)))[0]
                for part in self.add_noise(x0, level, noise).split(_AT_ONCE)
            ]
            error = (torch.cat(poses) - x0[..., :POSE_FEATURES]).square() * present[..., None]
            rows.append((error.sum(dim=(0, 1)) / present.sum()).cpu())
        self.residual = ResidualVariance(timesteps, torch.stack(rows))
        return self.residual
