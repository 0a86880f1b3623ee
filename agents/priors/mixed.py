"""A mixed discrete-continuous prior: D3PM on categories and DDPM on poses, each conditioned on the other.

A scene x is (B, N, 12 + K): the normalised pose and the one-hot category of each slot, K = C + 1 with *empty* last.
While a category is masked its K entries are zeros. (Pfaff et al., CoRL 2025; Hu et al. 2024)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Generator, Tensor, nn
from torch.nn import functional as F

from agents.configuration import check_types
from agents.diffusion import (
    CategoricalProcess,
    GaussianProcess,
    MixedStep,
    Preconditioning,
    ResidualVariance,
    StepTable,
)
from agents.diffusion.categorical import make_categorical_schedule
from agents.diffusion.gaussian import timestep_weights
from agents.diffusion.reverse_steps import ReverseStep, state_of
from agents.diffusion.schedules import make_schedule
from agents.diffusion.unmasking import UNMASKINGS
from agents.diffusion.weighting import check_weighting
from agents.networks.mixed_denoiser import MixedDenoiser, Observed
from agents.networks.registry import build_network, config_from_state
from agents.networks.text import Text
from agents.networks.text_encoders import text_config_from_state, text_encoder
from agents.priors.base import UNIONS
from agents.priors.config import MixedPriorConfig, current_names
from agents.priors.hooks import Hook, Start
from agents.priors.inpainting import draw_noise
from agents.priors.mixed_training import TrainableMixedPrior
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.protocols import StepTableLike
from scene_envs.scene import POSE_FEATURES, SceneBatch
from scene_envs.scene_types import get_scene_type

CATEGORY_LOSSES = ("cross_entropy", "bound")
_TEXT = "text_encoder."


class MixedPrior(TrainableMixedPrior):
    """A :class:`~agents.priors.base.ScenePrior` whose categories are discrete.

    Args:
        config: its configuration.
        normalizer: of raw scenes; only its pose features are used.
        preconditioning: moments (12,) of normalised poses.
        card: facts about its training.
        residual: (G, 12) measured error of the denoised pose.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> x, table = prior.initial(2, 34), prior.step_table(4)
    >>> step = prior.transition(x, 0, table)
    >>> step.from_noise(torch.randn_like(x)).shape, step.log_prob(x).shape
    (torch.Size([2, 34, 20]), torch.Size([2, 34]))
    """

    process_name = "mixed"

    def __init__(
        self,
        config: MixedPriorConfig,
        normalizer: Normalizer,
        preconditioning: Preconditioning,
        card: dict[str, Any] | None = None,
        residual: ResidualVariance | None = None,
    ) -> None:
        nn.Module.__init__(self)
        scene_type = get_scene_type(config.scene_type)
        if config.network.categories != scene_type.num_assets + 1:
            raise InvalidInputError(
                f"the network knows {config.network.categories} categories, {config.scene_type!r} has "
                f"{scene_type.num_assets + 1} with empty"
            )
        if config.category_loss not in CATEGORY_LOSSES:
            raise unknown_name("category loss", config.category_loss, CATEGORY_LOSSES)
        if config.unmasking not in UNMASKINGS:
            raise unknown_name("unmasking", config.unmasking, UNMASKINGS)
        if config.union not in UNIONS:
            raise unknown_name("union", config.union, UNIONS)
        check_weighting(config.loss_weighting, config.prediction)
        if config.empty_slots == "dropped" and not getattr(config.network, "reads_slot_mask", False):
            raise InvalidInputError("empty_slots='dropped' needs network='flux'; others take empty_slots='attended'")
        self._keep(config, normalizer, preconditioning, card, residual)
        schedule = make_schedule(config.schedule, config.num_timesteps, config.noise_floor, config.noise_ceiling)
        self.process = GaussianProcess(schedule, config.prediction, preconditioning)
        self.categories = CategoricalProcess(
            make_categorical_schedule(config.kernel, config.num_timesteps), config.network.categories
        )
        self._together = config.unmasking != "independent" and self.categories.only_absorbs
        self._systematic = config.unmasking == "systematic" and self._together
        encoder = None if config.text is None else text_encoder(config.text)
        self.denoiser = MixedDenoiser(
            build_network(config.network), self.process, self.categories, encoder, config.empty_slots
        )
        self._timestep_weights = timestep_weights(config.timesteps, schedule, config.noise_mean, config.noise_std)

    @classmethod
    def from_state(
        cls,
        fields: dict[str, Any],
        normalizer: Normalizer,
        preconditioning: Preconditioning,
        card: dict[str, Any] | None,
        residual: ResidualVariance | None,
    ) -> MixedPrior:
        """From the ``prior`` entry of a configuration file."""
        text = text_config_from_state(fields.get("text"))
        fields = {**current_names(fields), "network": config_from_state(fields["network"], "mixed"), "text": text}
        check_types(MixedPriorConfig, fields)
        return cls(MixedPriorConfig(**fields), normalizer, preconditioning, card, residual)

    def weights(self) -> dict[str, Tensor]:
        """Tensors of the network, and those of the text encoder under ``text_encoder.``."""
        tensors = super().weights()
        if self.denoiser.text_encoder is not None:
            tensors |= {f"{_TEXT}{name}": value for name, value in self.denoiser.text_encoder.state_dict().items()}
        return tensors

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of :meth:`weights`; raises RuntimeError when names or shapes differ."""
        text = {name.removeprefix(_TEXT): value for name, value in tensors.items() if name.startswith(_TEXT)}
        self.denoiser.network.load_state_dict(
            {name: value for name, value in tensors.items() if not name.startswith(_TEXT)}
        )
        if self.denoiser.text_encoder is not None:
            self.denoiser.text_encoder.load_state_dict(text)

    # -- the reverse chain ----------------------------------------------------------------------

    def transition(
        self,
        x_t: Tensor,
        step: int,
        table: StepTableLike,
        *,
        observed: Observed | None = None,
        text: Text | None = None,
        guidance: float = 0.0,
        free: Text | None = None,
        eta: float = 1.0,
        closed: Tensor | None = None,
    ) -> MixedStep:
        """p(x_{t-1} | x_t) of scenes (B, N, D); differentiable in the network's parameters.

        The assets of fixed objects have probability 0 in all other slots.

        Args:
            x_t: scenes at ``table.timesteps[step]``.
            step: index in the table.
            table: the chain.
            observed: entries that carry no noise; None for the fixed objects alone.
            text: tokens (B, L, W) and their mask (B, L); None for no prompt.
            guidance: w of classifier-free guidance, (1 + w) conditional - w unconditional, on poses and logits.
            free: text of the empty prompt, as :meth:`unconditional` gives it; encoded anew when None.
            eta: noise of the pose, 1 for the ancestral step and 0 for none; categories are drawn in either case.
            closed: (B, K) bool, further categories with probability 0 in slots that are not observed.
        """
        t, previous = int(table.timesteps[step]), int(table.previous[step])
        self.process.check_stride(t, previous)
        levels = torch.full((x_t.shape[0],), t, device=x_t.device)
        observed = self.observed_entries(x_t, observed)
        if free is None and (text is None or guidance):
            free = self.unconditional(x_t.shape[0])
        pose, logits = self.denoiser(x_t, levels, observed, free if text is None else text)
        if text is not None and guidance:
            free_pose, free_logits = self.denoiser(x_t, levels, observed, free)
            pose = (1 + guidance) * pose - guidance * free_pose
            logits = (1 + guidance) * logits.log_softmax(-1) - guidance * free_logits.log_softmax(-1)
        if self.config.clip:
            pose = pose.clamp(-self.config.clip, self.config.clip)
        residual = None if self.residual is None else self.residual.at(t)
        mean, std = self.process.posterior(x_t[..., :POSE_FEATURES], pose, t, previous, residual, eta)
        states = x_t[..., POSE_FEATURES:]
        state = state_of(states)
        logits = logits.masked_fill(self.barred_categories(state, closed), -torch.inf)
        probs = self.categories.posterior(state, logits.softmax(dim=-1), t, previous)
        slots, fixed = x_t.shape[1], len(self.scene_type.fixed)
        random = torch.full((slots,), previous > 0, device=x_t.device)
        random[:fixed] = False
        known = self.known(slots)[:, :POSE_FEATURES]
        zeros = torch.zeros(*mean.shape[:2], self.num_categories, device=mean.device)
        clamped = self.clamp(torch.cat([mean, zeros], dim=-1))
        if fixed:
            certain = F.one_hot(self._fixed[:fixed, POSE_FEATURES:].argmax(dim=-1), self.num_categories + 1).to(probs)
            probs = torch.cat([certain.expand(len(probs), -1, -1), probs[:, fixed:]], dim=1)
        masked = (state == self.num_categories) & random if self._together else None
        groups = self.denoiser.groups_by_number(text) if self._systematic and text is not None else None
        category = logits.argmax(dim=-1)
        if self.categories.only_absorbs:
            category = torch.where(state < self.num_categories, state, category)
        estimate = torch.cat([pose, F.one_hot(category, self.num_categories).to(pose)], dim=-1).detach()
        return MixedStep(
            clamped[..., :POSE_FEATURES], std * (~known).to(mean.dtype), probs, random, masked, estimate, groups
        )

    def regenerate(
        self, batch: SceneBatch, mask: Tensor, table: StepTable, generators: Sequence[Generator], resample: int,
        prompts: Sequence[str] | None = None, guidance: float = 0.0, hook: Hook | None = None,
        start: Start | None = None,
    ) -> Tensor:  # fmt: skip
        """x_0 (B, N, D) in which poses and categories under ``mask`` (B, N, 2) are new; the rest is observed."""
        text = None if prompts is None else self.encode_prompts(prompts)
        observed = Observed(self.encode(batch), ~mask[..., 0], ~mask[..., 1])
        noise = draw_noise(observed.x, generators)
        probs = self.categories.prior().to(noise).expand(*noise.shape[:2], -1)
        x = self.clamp(self.with_states(noise[..., :POSE_FEATURES], probs, noise))
        first, x = (0, x) if start is None else (start[0], start[1].to(x))
        closed = self.closed_categories(batch, mask)
        return self.run_chain(
            x, table, generators, observed, text, guidance, resample, hook=hook, first=first, closed=closed
        )

    @torch.no_grad()
    def run_chain(
        self, x: Tensor, table: StepTable, noises: Sequence[Generator] | Generator | None,
        observed: Observed | None = None, text: Text | None = None, guidance: float = 0.0, resample: int = 1,
        eta: float = 1.0, hook: Hook | None = None, first: int = 0, closed: Tensor | None = None,
    ) -> Tensor:  # fmt: skip
        """x_0 (B, N, D) from x_T, with observed entries kept.

        Args:
            x: x_T (B, N, D), or the scenes at step ``first``.
            table: the chain.
            noises: one generator for all scenes, or one per scene; None for torch's own.
            observed: entries that carry no noise.
            text, guidance, eta, closed: as in :meth:`transition`.
            resample: number of times that each step is taken, with noise added again in between.
            hook: called at the last time that each step is taken.
            first: step that the chain begins at.
        """
        free = self.unconditional(len(x)) if text is None or guidance else None
        x = x if observed is None else observed.write(x)
        for step in range(first, len(table)):
            level, after = int(table.timesteps[step]), int(table.previous[step])
            rounds = resample if after > 0 else 1
            for again in range(rounds):
                if again:
                    x = self._renoise(x, after, level, draw_noise(x, noises))
                    x = x if observed is None else observed.write(x)
                reverse: ReverseStep = self.transition(
                    x, step, table, observed=observed, text=text, guidance=guidance, free=free, eta=eta, closed=closed
                )
                if hook is not None and again == rounds - 1:
                    reverse = hook(step, x, reverse)
                x = reverse.from_noise(draw_noise(x, noises))
                x = x if observed is None else observed.write(x)
        return x

    def _renoise(self, x_s: Tensor, s: int, t: int, noise: Tensor) -> Tensor:
        """A sample of q(x_t | x_s), s < t."""
        pose = self.process.renoise(x_s[..., :POSE_FEATURES], s, t, noise[..., :POSE_FEATURES])
        rows = self.categories.transition(s, t).to(x_s)[state_of(x_s[..., POSE_FEATURES:])]
        return self.clamp(self.with_states(pose, rows, noise))

    @torch.no_grad()
    def sample_tensor(
        self,
        count: int,
        *,
        prompts: Sequence[str] | None = None,
        guidance: float = 0.0,
        num_steps: int = 50,
        slots: int | None = None,
        generator: Generator | None = None,
        eta: float = 1.0,
        hook: Hook | None = None,
    ) -> Tensor:
        """``count`` denoised scenes x_0 (count, slots, D), as :meth:`ScenePrior.sample_tensor` describes."""
        text = None if prompts is None else self.encode_prompts(prompts)
        start = self.initial(count, self.config.slots if slots is None else slots, generator)
        table = self.step_table(num_steps)
        return self.run_chain(start, table, generator, text=text, guidance=guidance, eta=eta, hook=hook)
