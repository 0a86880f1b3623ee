"""A mixed discrete-continuous prior: D3PM on categories and DDPM on poses, each conditioned on the other.

A scene x is (B, N, 12 + K): the normalised pose and the one-hot category of each slot, K = C + 1 with *empty* last.
While a category is masked its K entries are zeros. (Pfaff et al., CoRL 2025; Hu et al. 2024)
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from agents.diffusion import CategoricalProcess, MixedStep, StepTable
from agents.diffusion.categorical import make_categorical_schedule, one_hot
from agents.diffusion.gaussian import loss_weights
from agents.diffusion.reverse_steps import ReverseStep, state_of
from agents.networks.denoisers import MixedDenoiser, Observed
from agents.networks.flux import MixedFlux
from agents.networks.flux_modules import CountConditioning, CountLogitsConfig, ModuleConfig
from agents.networks.geometry import RefinementConfig
from agents.networks.registry import build_network
from agents.networks.text import PADDING, Text, TextEncoder, vocabulary, warn_unknown
from agents.networks.text_encoders import text_encoder
from agents.priors.config import MixedPriorConfig
from agents.priors.guidance import Hook
from agents.priors.prior import DenoiserOutput, NoisedScenes, ScenePrior, check_object_count, draw_noise, no_text
from scene_envs.arrays import constant_on
from scene_envs.datasets.prompts.facts import SIDES
from scene_envs.datasets.prompts.parser import NUMBERS, ORDINALS, SIDE_PHRASES, Nouns
from scene_envs.errors import InvalidInputError
from scene_envs.protocols import StepTableLike
from scene_envs.scene import POSE_FEATURES, SceneBatch
from scene_envs.scene_types import SceneType, members_of

_TEXT = "text_encoder."

_EMPTY_WEIGHT = 0.1
"""Weight of the pose of an empty slot in the loss. The pose has no meaning, but chains should not drift on it."""

_COUNT_WEIGHT = 0.5
"""Weight of the count loss of networks with count conditioning, which read numbers of objects from the text alone."""

_AT_ONCE = 32
"""Scenes whose residual is measured in one batch: features of all pairs of slots of 512 rooms would be gigabytes."""


class MixedPrior(ScenePrior):
    """A :class:`~agents.priors.prior.ScenePrior` whose categories are discrete.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table", process="mixed")
    >>> x, table = prior.initial(2, 34), prior.step_table(4)
    >>> step = prior.transition(x, 0, table)
    >>> step.from_noise(torch.randn_like(x)).shape, step.log_prob(x).shape
    (torch.Size([2, 34, 20]), torch.Size([2, 34]))
    """

    process_name = "mixed"
    config_type = MixedPriorConfig
    config: MixedPriorConfig
    denoiser: MixedDenoiser
    categories: CategoricalProcess
    """The process of the categories."""

    def _denoiser(self) -> MixedDenoiser:
        config, count = self.config, self.scene_type.num_assets + 1
        if config.network.categories != count:
            raise InvalidInputError(
                f"the network knows {config.network.categories} categories, {config.scene_type!r} has {count} with "
                "empty"
            )
        if config.empty_slots == "dropped" and not getattr(config.network, "reads_slot_mask", False):
            raise InvalidInputError("empty_slots='dropped' needs network='flux'; others take empty_slots='attended'")
        self.categories = CategoricalProcess(make_categorical_schedule(config.kernel, config.num_timesteps), count)
        self._together = config.unmasking != "independent" and self.categories.only_absorbs
        self._systematic = config.unmasking == "systematic" and self._together
        encoder = None if config.text is None else text_encoder(config.text)
        return MixedDenoiser(build_network(config.network), self.process, self.categories, encoder, config.empty_slots)

    def weights(self) -> dict[str, Tensor]:
        """Tensors of the network, and those of the text encoder under ``text_encoder.``."""
        tensors = super().weights()
        if self.denoiser.text_encoder is not None:
            tensors |= {f"{_TEXT}{name}": value for name, value in self.denoiser.text_encoder.state_dict().items()}
        return tensors

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of :meth:`weights`; raises RuntimeError when names or shapes differ."""
        text = {name.removeprefix(_TEXT): value for name, value in tensors.items() if name.startswith(_TEXT)}
        super().load_weights({name: value for name, value in tensors.items() if not name.startswith(_TEXT)})
        if self.denoiser.text_encoder is not None:
            self.denoiser.text_encoder.load_state_dict(text)

    # -- text -------------------------------------------------------------------------------------

    @property
    def conditional(self) -> bool:
        """Whether the prior reads prompts."""
        return self.denoiser.text_encoder is not None

    @property
    def prompt_space(self) -> tuple[int, int]:
        """Largest number of tokens of a prompt, and size of the vocabulary; 0 is padding."""
        return self._encoder("").token_space

    def read_prompts(self, prompts: Sequence[str], slots: int) -> Tensor:
        """Token indices (B, L) int64 on the CPU, padded to the length of the longest possible prompt.

        Unknown words are listed in a warning.

        Raises:
            InvalidInputError: the prior reads no prompts, a prompt is too long, or one asks for more objects than
                ``slots``.
        """
        encoder = self._encoder(prompts[0])
        check_object_count(prompts, self.scene_type, slots)
        indices, unknown = encoder.tokenize(prompts)
        warn_unknown(unknown)
        longest = encoder.token_space[0]
        return F.pad(indices, (0, longest - indices.shape[1]), value=PADDING)

    def encode_tokens(self, indices: Tensor) -> Text:
        """Tokens (B, L', W) and mask (B, L') of token indices (B, L); equal rows are encoded once."""
        used = (indices != PADDING).any(dim=0)
        rows, place = torch.unique(indices[:, used].cpu(), dim=0, return_inverse=True)
        tokens, mask = self._encoder("").encode(rows)
        place = place.to(tokens.device)
        return tokens[place], mask[place]

    def encode_prompts(self, prompts: Sequence[str]) -> Text:
        """Tokens (B, L, W) and mask (B, L) of prompts; equal prompts are encoded once.

        Raises:
            InvalidInputError: the prior reads no prompts, or one is too long.
        """
        different = list(dict.fromkeys(prompts))
        tokens, mask = self._encoder(different[0])(different)
        place = torch.tensor([different.index(prompt) for prompt in prompts], device=tokens.device)
        return tokens[place], mask[place]

    def unconditional(self, count: int) -> Text | None:
        """Text of the empty prompt; None for a prior without text."""
        if not self.conditional:
            return None
        tokens, mask = self.encode_prompts([""])
        return tokens.expand(count, -1, -1), mask.expand(count, -1)

    def warn_unknown_words(self, prompts: Iterable[str]) -> None:
        """Warn of words in ``prompts`` that the vocabulary of the prior lacks."""
        if isinstance(self.denoiser.text_encoder, TextEncoder):
            warn_unknown(self.denoiser.text_encoder.unknown_words(prompts))

    @property
    def count_conditioning(self) -> CountConditioning | None:
        """The part of the network that reads how many objects a prompt asks for; None if there is none."""
        return getattr(self.denoiser.network, "count_conditioning", None) if self.conditional else None

    def freeze_text(self) -> None:
        """Freeze the text encoder, if there is one: training does not change it from then on."""
        if self.denoiser.text_encoder is not None:
            self.denoiser.text_encoder.requires_grad_(False)

    def _encoder(self, prompt: str) -> Any:
        if self.denoiser.text_encoder is None:
            raise no_text(self.scene_type, prompt)
        return self.denoiser.text_encoder

    # -- scenes and numbers -----------------------------------------------------------------------

    @property
    def num_categories(self) -> int:
        """K = C + 1."""
        return self.config.network.categories

    @cached_property
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

    def observed_entries(self, x: Tensor, observed: Observed | None = None) -> Observed | None:
        """Observed entries of scenes ``x`` (B, N, D) for the network: ``observed``, or else the fixed objects.

        In training with observed entries, fixed objects are always observed; without them, nothing is.
        """
        if observed is not None or self.config.observed_share <= 0:
            return observed
        fixed = ~self.frame(x).free.expand(x.shape[:2])
        return Observed(x, fixed, fixed)

    def initial_from_noise(self, noise: Tensor) -> Tensor:
        """x_T (B, N, D) from ``noise``: normal poses, and categories drawn from their distribution at T."""
        probs = self.categories.prior().to(noise).expand(*noise.shape[:2], -1)
        return self.clamp(self.with_states(noise[..., :POSE_FEATURES], probs, noise))

    def add_noise(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """A sample of q(x_t | x_0) from standard normal noise (B, N, D)."""
        pose = self.process.add_noise(x0[..., :POSE_FEATURES], t, noise[..., :POSE_FEATURES])
        category = x0[..., POSE_FEATURES:].argmax(dim=-1)
        return self.clamp(self.with_states(pose, self.categories.marginal(category, t.expand(len(x0))), noise))

    @staticmethod
    def with_states(pose: Tensor, probs: Tensor, noise: Tensor) -> Tensor:
        """``pose`` (B, N, 12) with states drawn from ``probs`` (B, N, K + 1) by ``noise`` (B, N, D)."""
        random = torch.ones(pose.shape[1], dtype=torch.bool, device=pose.device)
        return MixedStep(pose, torch.zeros_like(pose[0]), probs, random).from_noise(noise)

    def barred_categories(self, state: Tensor, closed: Tensor | None = None) -> Tensor:
        """(B, N, K) bool: categories of x_0 with probability 0, given states (B, N) of x_t.

        These are the categories of fixed objects, in all slots but theirs, and ``closed`` (B, K). With
        ``union="one_type"``, they are also the assets that no member has together with all assets that the scene holds
        already. If the chain only absorbs, the category that a slot holds already is not barred in this slot.
        """
        barred = torch.zeros(*state.shape, self.num_categories, dtype=torch.bool, device=state.device)
        barred[:, len(self.scene_type.fixed) :] = constant_on(self._fixed_kinds, state.device)
        if closed is not None:
            barred |= closed[:, None]
        if self.categories.only_absorbs:
            held = one_hot(state, self.num_categories, torch.bool)
            if self._separates_members:
                barred[..., :-1] |= ~self._fitting_assets(held[..., :-1].any(dim=1))[:, None]
            barred &= ~held
        return barred

    @property
    def _separates_members(self) -> bool:
        """Whether a scene holds the assets of one member of a union only."""
        return self.config.union == "one_type" and len(self._members) > 1 and self.categories.only_absorbs

    @cached_property
    def _fixed_kinds(self) -> Tensor:
        """(K,) bool: categories of fixed objects."""
        return torch.isin(torch.arange(self.num_categories), torch.tensor(self.scene_type.fixed_categories))

    @cached_property
    def _members(self) -> Tensor:
        """(M, C) bool: assets of each member of a union of scene types; one row for any other type."""
        assets = self.scene_type.assets
        return torch.tensor([[asset in member.assets for asset in assets] for member in members_of(self.scene_type)])

    def _fitting_assets(self, present: Tensor) -> Tensor:
        """(B, C) bool: assets of the members that have all of ``present`` (B, C) bool; all if no member has them."""
        members = constant_on(self._members, present.device)
        fits = ~(present[:, None] & ~members).any(dim=-1)  # (B, M)
        allowed = (fits[..., None] & members).any(dim=1)
        return allowed | ~fits.any(dim=-1, keepdim=True)

    def with_union(self, union: str) -> MixedPrior:
        """This prior, whose scenes of a union hold the assets of ``"one_type"``, or ``"any"``; an UnknownNameError."""
        self.config = replace(self.config, union=union)
        return self

    def with_open_empty(self, share: float) -> MixedPrior:
        """This prior; in its training, ``share`` of the masks of whole slots include every empty slot."""
        self.config = replace(self.config, open_empty_share=share)
        return self

    def with_module(self, name: str) -> MixedPrior:
        """This prior with the module ``name``, see :meth:`ScenePrior.with_module`."""
        network = self.denoiser.network
        if hasattr(network, name):
            return self
        added: ModuleConfig = CountLogitsConfig()
        if name == RefinementConfig.name and hasattr(network, "relations") and self.scene_type.has_geometry:
            boxes = [self.scene_type.library[asset].bounds for asset in self.scene_type.assets]  # (2, 3) each
            added = RefinementConfig(tuple((*(low + high) / 2, *(high - low) / 2) for low, high in boxes))
        if not isinstance(network, MixedFlux) or added.name != name:
            return super().with_module(name)  # raises
        self.denoiser.network = network.extended(added).train(network.training)
        self.config = replace(self.config, network=self.denoiser.network.config)
        return self

    # -- the reverse chain ------------------------------------------------------------------------

    def step_table(self, num_steps: int) -> StepTable:
        """The reverse steps of a chain of ``num_steps``, any number in 1..T.

        If a scene holds the assets of one member of a union only, each of the first steps unmasks about one slot.
        """
        if self._separates_members:
            return StepTable.gradual(self.categories.schedule.mask, self.config.slots, num_steps)
        return super().step_table(num_steps)

    def transition(
        self, x_t: Tensor, step: int, table: StepTableLike, *, observed: Observed | None = None,
        text: Text | None = None, guidance: float = 0.0, free: Text | None = None, eta: float = 1.0,
        closed: Tensor | None = None, refined: bool = True,
    ) -> MixedStep:  # fmt: skip
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
            refined: False leaves the refinement of the network out, if it has one.
        """
        t, previous = int(table.timesteps[step]), int(table.previous[step])
        self.process.check_stride(t, previous)
        left_out = [] if refined else [RefinementConfig.name]
        if observed is not None or (text is not None and guidance):  # not trained on completions; guidance amplifies it
            left_out.append(CountLogitsConfig.name)
        observed = self.observed_entries(x_t, observed)
        if free is None and (text is None or guidance):
            free = self.unconditional(x_t.shape[0])
        pose, logits = self.denoiser(x_t, t, observed, free if text is None else text, left_out)
        if text is not None and guidance:
            free_pose, free_logits = self.denoiser(x_t, t, observed, free, left_out)
            pose = (1 + guidance) * pose - guidance * free_pose
            logits = (1 + guidance) * logits.log_softmax(-1) - guidance * free_logits.log_softmax(-1)
        if self.config.clip:
            pose = pose.clamp(-self.config.clip, self.config.clip)
        x0_weight, xt_weight, std = self.stride(t, previous, eta, x_t)
        mean = x0_weight * pose + xt_weight * x_t[..., :POSE_FEATURES]
        state, frame = state_of(x_t[..., POSE_FEATURES:]), self.frame(x_t)
        known, values, moving = (part[:, :POSE_FEATURES] for part in (frame.known, frame.values, frame.moving))
        logits = logits.masked_fill(self.barred_categories(state, closed), -torch.inf)
        probs = self.categories.posterior(state, logits.softmax(dim=-1), t, previous)
        random = frame.free if previous > 0 else torch.zeros_like(frame.free)
        fixed = len(self.scene_type.fixed)
        if fixed:
            certain = F.pad(frame.values[:fixed, POSE_FEATURES:], (0, 1))
            probs = torch.cat([certain.expand(len(probs), -1, -1), probs[:, fixed:]], dim=1)
        masked = (state == self.num_categories) & random if self._together else None
        groups = self.denoiser.groups_by_number(text) if self._systematic and text is not None else None
        category = logits.argmax(dim=-1)
        if self.categories.only_absorbs:
            category = torch.where(state < self.num_categories, state, category)
        estimate = torch.cat([pose, one_hot(category, self.num_categories, pose.dtype)], dim=-1).detach()
        return MixedStep(torch.where(known, values, mean), std * moving, probs, random, masked, estimate, groups)

    @torch.no_grad()
    def run_chain(
        self, x: Tensor, table: StepTable, noises: Sequence[Generator] | Generator | None,
        observed: Observed | None = None, text: Text | None = None, guidance: float = 0.0, eta: float = 1.0,
        hook: Hook | None = None, closed: Tensor | None = None, refined: bool = True,
    ) -> Tensor:  # fmt: skip
        """x_0 (B, N, D), as :meth:`ScenePrior.run_chain` describes it; observed entries carry no noise."""
        free = self.unconditional(len(x)) if text is None or guidance else None
        x = x if observed is None else observed.write(x)
        for step in range(len(table)):
            reverse: ReverseStep = self.transition(
                x, step, table, observed=observed, text=text, guidance=guidance, free=free, eta=eta, closed=closed,
                refined=refined,
            )  # fmt: skip
            if hook is not None:
                reverse = hook(step, x, reverse)
            x = reverse.from_noise(draw_noise(x, noises))
            x = x if observed is None else observed.write(x)
        return x

    # -- training ---------------------------------------------------------------------------------

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
        masks slots because they are empty. Under random masks alone, many open slots with many observed objects are
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

    def mean_square_error(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """(12,) error of the poses of free objects, as :meth:`ScenePrior.mean_square_error` describes it."""
        present = (x0[..., POSE_FEATURES:].argmax(dim=-1) != self.num_categories - 1).float()
        present[:, : len(self.scene_type.fixed)] = 0.0
        poses = [
            self.denoiser(part, t[: len(part)], self.observed_entries(part), self.unconditional(len(part)))[0]
            for part in self.add_noise(x0, t, noise).split(_AT_ONCE)
        ]
        error = (torch.cat(poses) - x0[..., :POSE_FEATURES]).square() * present[..., None]
        return error.sum(dim=(0, 1)) / present.sum()


def prompt_words(scene_type: SceneType) -> tuple[str, ...]:
    """The words of all prompts that can be written about scenes of a type, sorted, with the numbers up to 130.

    >>> from scene_envs.scene_types import get_scene_type
    >>> {"teapot", "cups", "behind", "17"} <= set(prompt_words(get_scene_type("dimsum_table")))
    True
    """
    names = Nouns(scene_type).plural
    frame = "A scene with where, and is are each an on in top of the same shelf tier from bottom object objects."
    return vocabulary([frame, *NUMBERS, *ORDINALS, *SIDES, *SIDE_PHRASES.values(), *names, *names.values()])
