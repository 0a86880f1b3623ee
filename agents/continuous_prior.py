"""A continuous prior: Gaussian diffusion on whole slots, categories being numbers in [-1, 1] that end in an arg-max."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Generator, Tensor

from agents.denoiser import Denoiser, PriorConfig
from agents.diffusion import (
    GaussianProcess,
    GaussianStep,
    Preconditioning,
    ResidualVariance,
    StepTable,
    lognormal_timesteps,
    make_schedule,
)
from agents.inpainting import chain_with_noised
from agents.networks import FluxConfig, FluxDenoiser
from agents.prior import ScenePrior
from scene_envs.errors import InvalidInputError
from scene_envs.normalizer import Normalizer
from scene_envs.protocols import StepTableLike
from scene_envs.scene import POSE, SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type


class ContinuousPrior(ScenePrior):
    """A :class:`~agents.prior.ScenePrior` whose categories are diffused as numbers.

    Args:
        config: what it is made of.
        normalizer: of raw scenes.
        preconditioning: moments (D,) of normalised scenes.
        card: facts about its training.
        residual: (G, D) measured error of the denoised scene.

    >>> from agents.prior import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="continuous")
    >>> mean, std = prior.posterior(prior.initial(2, 34), 0, prior.step_table(4))
    >>> mean.shape, bool((std[0] == 0).all())  # the table is known
    (torch.Size([2, 34, 20]), True)
    """

    process_name = "continuous"

    def __init__(
        self,
        config: PriorConfig,
        normalizer: Normalizer,
        preconditioning: Preconditioning,
        card: dict[str, Any] | None = None,
        residual: ResidualVariance | None = None,
    ) -> None:
        super().__init__()
        scene_type = get_scene_type(config.scene_type)
        if config.network.features != scene_type.features:
            raise InvalidInputError(
                f"the network reads {config.network.features} features, {config.scene_type!r} has {scene_type.features}"
            )
        self._keep(config, normalizer, preconditioning, card, residual)
        schedule = make_schedule(config.schedule, config.num_timesteps)
        self.process = GaussianProcess(schedule, config.prediction, preconditioning)
        self.denoiser = Denoiser(FluxDenoiser(config.network), self.process)
        self._timestep_weights = lognormal_timesteps(schedule, config.noise_mean, config.noise_std)

    @classmethod
    def from_state(
        cls,
        fields: dict[str, Any],
        normalizer: Normalizer,
        preconditioning: Preconditioning,
        card: dict[str, Any] | None,
        residual: ResidualVariance | None,
    ) -> ContinuousPrior:
        """From the ``prior`` entry of a configuration file."""
        fields = {**fields, "network": FluxConfig(**fields["network"])}
        return cls(PriorConfig(**fields), normalizer, preconditioning, card, residual)

    @classmethod
    def tiny(cls, scene_type: SceneType, slots: int, normalizer: Normalizer, text: bool = False) -> ContinuousPrior:
        """A very small prior with fresh weights."""
        if text:
            raise InvalidInputError("text=True needs process='mixed': the continuous prior reads no prompts")
        features = scene_type.features
        config = PriorConfig(scene_type.name, slots, FluxConfig(features=features, hidden=32, depth=2, heads=2))
        return cls(config, normalizer, Preconditioning(torch.zeros(features), torch.full((features,), 0.5)))

    def transition(self, x_t: Tensor, step: int, table: StepTableLike) -> GaussianStep:
        """p(x_{t-1} | x_t) of scenes (B, N, D); differentiable in the network's parameters."""
        return GaussianStep(*self.posterior(x_t, step, table))

    def posterior(self, x_t: Tensor, step: int, table: StepTableLike) -> tuple[Tensor, Tensor]:
        """Mean (B, N, D) and std (N, D) of x_{t-1} given x_t; differentiable in the network's parameters.

        The std is 0 on known entries, and everywhere at the last step, which is deterministic.
        """
        t, previous = int(table.timesteps[step]), int(table.previous[step])
        x0 = self.denoiser(x_t, torch.full((x_t.shape[0],), t, device=x_t.device))
        residual = None if self.residual is None else self.residual.at(t)
        mean, std = self.process.posterior(x_t, x0, t, previous, residual)
        std_map = std * (~self.known(x_t.shape[1])).to(x_t.dtype)
        return self.clamp(mean), std_map

    def regenerate(
        self,
        batch: SceneBatch,
        mask: Tensor,
        table: StepTable,
        generators: Sequence[Generator],
        resample: int,
        prompts: Sequence[str] | None = None,
        guidance: float = 0.0,
    ) -> Tensor:
        """x_0 (B, N, D) in which poses and categories under ``mask`` (B, N, 2) are new; used by :meth:`inpaint`."""
        x0 = self.encode(batch)
        widths = torch.tensor([POSE.stop, x0.shape[-1] - POSE.stop], device=mask.device)
        keep = ~mask.repeat_interleave(widths, dim=-1)
        return chain_with_noised(self, x0, keep, table, generators, resample)

    def pretraining_loss(
        self, x0: Tensor, generator: Generator | None = None, reduction: str = "mean", t: Tensor | None = None
    ) -> Tensor:
        """Weighted mean square of the network's error, over entries that are not known.

        Args:
            x0: (B, N, D) normalised scenes.
            generator: source of timesteps and noise (CPU).
            reduction: ``"mean"`` over scenes, or ``"none"`` for (B,); always the mean over entries.
            t: (B,) timesteps, drawn when None.
        """
        if t is None:
            t = self.draw_timesteps(x0.shape[0], generator).to(x0.device)
        noise = torch.randn(x0.shape, generator=generator).to(x0.device)
        x_t = self.clamp(self.process.add_noise(x0, t, noise))
        error = self.denoiser.output(x_t, t) - self.process.target(x0, x_t, t, noise)
        weight = self.loss_weight(x0.shape[1])
        per_scene = (error.square() * weight).sum(dim=(1, 2)) / weight.sum()
        return per_scene.mean() if reduction == "mean" else per_scene

    @torch.no_grad()
    def fit_residual(self, x0: Tensor, levels: int = 40, seed: int = 0) -> ResidualVariance:
        """Measure the denoiser's error on normalised scenes ``x0`` (B, N, D) at ``levels`` timesteps, and keep it."""
        generator = Generator().manual_seed(seed)
        timesteps = StepTable.spaced(self.config.num_timesteps, levels).timesteps.flip(0)
        rows = []
        for t in timesteps:
            noise = torch.randn(x0.shape, generator=generator).to(x0.device)
            x_t = self.clamp(self.process.add_noise(x0, t, noise))
            error = self.denoiser(x_t, t.to(x0.device).expand(len(x0))) - x0
            rows.append(error[:, len(self.scene_type.fixed) :].square().mean(dim=(0, 1)).cpu())
        self.residual = ResidualVariance(timesteps, torch.stack(rows))
        return self.residual
