"""A scene prior: a trained denoiser with its process, layout and normalizer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import torch
from torch import Generator, Tensor, nn

from agents.diffusion import (
    GaussianProcess,
    Preconditioning,
    ResidualVariance,
    ReverseStep,
    StepTable,
)
from agents.networks.count_conditioning import CountConditioning
from agents.networks.text import Text
from agents.priors.forward import Trainable
from agents.priors.guidance import guidance_hook, physics_strength
from agents.priors.hooks import Hook
from agents.priors.inpainting import Inpainting
from agents.priors.loading import Loadable
from agents.priors.prompt_validation import check_prompts, no_text
from scene_envs.envs.settings import check_physics_guidance
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.protocols import StepTableLike
from scene_envs.scene import TRANSLATION, SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type

UNIONS = ("one_type", "any")
"""Assets that a scene of a union of scene types may hold: those of one of its types, or any."""

Prior = TypeVar("Prior", bound="ScenePrior")


class ScenePrior(Loadable, Trainable, Inpainting, nn.Module, ABC):
    """A trained denoiser with its schedule, layout and normalizer. Tensors x are normalised scenes (B, N, D).

    Fixed welded objects and constant features are *known*: clamped to their values while sampling and left
    out of the loss and of every log-probability. The two kinds of prior are
    :class:`~agents.priors.continuous.ContinuousPrior` and :class:`~agents.priors.mixed.MixedPrior`.

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table")
    >>> prior.sample(2, num_steps=3, seed=0)
    SceneBatch('dimsum_table', (2, 34, 20))
    """

    process: GaussianProcess
    """Gaussian process of the poses, and of all other continuous features."""
    denoiser: Any
    """The network inside its process, a module with ``.network``."""

    def _keep(
        self,
        config: Any,
        normalizer: Normalizer,
        preconditioning: Preconditioning,
        card: dict[str, Any] | None,
        residual: ResidualVariance | None,
    ) -> None:
        """Store the parts that priors of every process have."""
        self.config = config
        self.scene_type: SceneType = get_scene_type(config.scene_type)
        check_physics_guidance(config.physics_guidance, self.scene_type)
        self.normalizer = normalizer
        self.preconditioning = preconditioning
        self.card = card or {}
        self.residual = residual
        self._fixed: Tensor
        fixed = SceneBatch.empty(self.scene_type, 1, len(self.scene_type.fixed) or 1)
        self.register_buffer("_fixed", self.normalised(fixed)[0], persistent=False)

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self._fixed.device

    # -- text -----------------------------------------------------------------------------------

    def encode_prompts(self, prompts: Sequence[str]) -> Text:
        """Tokens (B, L, W) and mask (B, L) of prompts.

        Raises:
            InvalidInputError: the prior reads no prompts, or one is too long.
        """
        raise no_text(self.scene_type, next(iter(prompts), ""))

    def warn_unknown_words(self, prompts: Iterable[str]) -> None:
        """Warn of words in ``prompts`` that the prior cannot read; does nothing for a prior without prompts."""

    def freeze_text(self) -> None:
        """Freeze the text encoder, if there is one: training does not change it from then on."""

    @property
    def count_conditioning(self) -> CountConditioning | None:
        """The part of the network that reads how many objects a prompt asks for; None if there is none."""
        return None

    # -- the reverse chain ----------------------------------------------------------------------

    def step_table(self, num_steps: int) -> StepTable:
        """The reverse steps of a chain of ``num_steps``, any number in 1..T."""
        return StepTable.spaced(self.config.num_timesteps, num_steps)

    @property
    def features(self) -> int:
        """D, numbers per slot of the denoised tensor."""
        return self.scene_type.features

    @property
    def is_constant(self) -> Tensor:
        """(D,) bool: features that never vary."""
        return self.normalizer.is_constant

    def known(self, slots: int) -> Tensor:
        """(slots, D) bool: entries that are clamped (fixed welded slots, constant features)."""
        known = self.is_constant.to(self._fixed.device).expand(slots, -1).clone()
        known[: len(self.scene_type.fixed)] = True
        return known

    def clamp(self, x: Tensor) -> Tensor:
        """``x`` (B, N, D) with its known entries set to their values."""
        count = len(self.scene_type.fixed)
        x = torch.where(self.is_constant.to(x.device), torch.zeros_like(x), x)
        if count:
            x = torch.cat([self._fixed[:count].to(x).expand(x.shape[0], -1, -1), x[:, count:]], dim=1)
        return x

    def with_union(self: Prior, union: str) -> Prior:
        """This prior, whose scenes of a union of scene types hold the assets of ``"one_type"``, or ``"any"`` assets.

        A prior with continuous categories has no such setting and is not changed.

        Raises:
            UnknownNameError: another word.
        """
        if union not in UNIONS:
            raise unknown_name("union", union, UNIONS)
        return self

    def with_physics_guidance(self: Prior, strength: float) -> Prior:
        """This prior; its samples have physics guidance of ``strength`` (0 to 1) where a caller gives none.

        Raises:
            InvalidInputError: not from 0 to 1, or the assets have no geometry.
        """
        strength = physics_strength(strength, self.config, self.scene_type)
        self.config = replace(self.config, physics_guidance=strength)
        return self

    def with_open_empty(self: Prior, share: float) -> Prior:
        """This prior; in its training, ``share`` of the masks of whole slots include every empty slot.

        A prior that is not told of observed entries has no such masks and is not changed.
        """
        return self

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        """x_T (count, slots, D): standard normal with the known entries clamped."""
        noise = torch.randn(count, slots, self.features, generator=generator, device=self._fixed.device)
        return self.clamp(noise)

    @abstractmethod
    def transition(self, x_t: Tensor, step: int, table: StepTableLike, *, eta: float = 1.0) -> ReverseStep:
        """p(x_{t-1} | x_t) of scenes (B, N, D); differentiable in the network's parameters.

        Known entries are certain; at the last step all entries are. ``eta`` scales the noise of the continuous
        features, as in :meth:`sample`.
        """

    def estimate(self, step: int, table: StepTable) -> tuple[float, Tensor]:
        """Weight of the denoised translations in x_{t-1}, and their standard deviation (3,), normalised."""
        weight, std = self.process.estimate(int(table.timesteps[step]), int(table.previous[step]), self.residual)
        return weight, std[TRANSLATION].to(self.device)

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
        """``count`` denoised scenes x_0 (count, slots, D), normalised, from one batch; arguments as in :meth:`sample`.

        ``hook`` is called at every step, before x_{t-1} is drawn.

        Priors that read prompts override it.
        """
        table = self.step_table(num_steps)
        x = self.initial(count, self.config.slots if slots is None else slots, generator)
        for step in range(len(table)):
            noise = torch.randn(x.shape, generator=generator, device=x.device)
            reverse: ReverseStep = self.transition(x, step, table, eta=eta)
            x = (reverse if hook is None else hook(step, x, reverse)).from_noise(noise)
        return x

    def sample(
        self,
        count: int,
        *,
        prompt: str | Sequence[str] | None = None,
        guidance: float = 0.0,
        claim_guidance: float = 0.0,
        physics_guidance: float | None = None,
        num_steps: int = 50,
        slots: int | None = None,
        seed: int = 0,
        batch_size: int = 64,
        eta: float = 1.0,
    ) -> SceneBatch:
        """``count`` scenes by ancestral sampling (Ho et al. 2020, Algorithm 2) over ``num_steps`` strides.

        Args:
            count: number of scenes.
            prompt: what the scenes should hold, one text for all or one per scene; None for anything.
            guidance: w of classifier-free guidance, (1 + w) conditional - w unconditional (Ho and Salimans 2022); it
                needs a prompt.
            claim_guidance: strength of guidance to the claims of the prompt, see
                :class:`~agents.priors.claim_guidance.ClaimGuidance` and
                :class:`~agents.priors.number_guidance.NumberGuidance`; 2 is a good choice. It needs a prompt.
            physics_guidance: strength with which objects are moved out of overlaps and onto supports at the last steps,
                0 to 1, see :class:`~agents.priors.physics_guidance.PhysicsGuidance`. None takes the strength that the
                prior was published with (``config.physics_guidance``): 1 for shipped priors whose names end in
                ``_feasible``, otherwise 0.
            num_steps: denoiser evaluations per scene, 1..T.
            slots: slots per scene; more than trained is allowed.
            seed: of the torch generator; the same seed and batch size give the same scenes.
            batch_size: scenes denoised at once.
            eta: noise of the continuous features in the reverse steps (Song et al. 2021, Eq. 16). 1 is the ancestral
                chain. With 0, only x_T and the discrete categories of a mixed prior are random.
        """
        if count < 1:
            raise InvalidInputError(f"count={count}: ask for at least one scene")
        if batch_size < 1:
            raise InvalidInputError(f"batch_size={batch_size}: at least one scene must be denoised at a time")
        wide = self.config.slots if slots is None else slots
        prompts = check_prompts(
            prompt, guidance, count, scene_type=self.scene_type, slots=wide, conditional=self.conditional,
            claim_guidance=claim_guidance,
        )  # fmt: skip
        strength = physics_strength(physics_guidance, self.config, self.scene_type)
        generator = Generator(str(self._fixed.device)).manual_seed(seed)
        chunks = []
        for start in range(0, count, batch_size):
            texts = None if prompts is None else prompts[start : start + batch_size]
            size = min(batch_size, count - start)
            x0 = self.sample_tensor(
                size, prompts=texts, guidance=guidance, num_steps=num_steps, slots=slots, generator=generator, eta=eta,
                hook=self.sampling_hook(
                    size, wide, num_steps, prompts=texts, claim_guidance=claim_guidance,
                    physics_guidance=strength,
                ),
            )  # fmt: skip
            chunks.append(x0)
        return self.decode(torch.cat(chunks))

    def sampling_hook(
        self,
        count: int,
        slots: int,
        num_steps: int,
        *,
        prompts: Sequence[str] | None = None,
        claim_guidance: float = 0.0,
        physics_guidance: float = 0.0,
    ) -> Hook | None:
        """Hook of a chain that samples whole scenes under guidance; None where nothing guides them.

        Args:
            count: scenes.
            slots: slots per scene.
            num_steps: steps of the chain.
            prompts: one per scene; without prompts there is no claim guidance.
            claim_guidance: as in :meth:`sample`.
            physics_guidance: strength, 0 for none.
        """
        moved = torch.ones(count, slots, 1, dtype=torch.bool)
        moved[:, : len(self.scene_type.fixed)] = False
        return guidance_hook(
            self, self.scene_type, self.step_table(num_steps), self.decode, moved,
            prompts=prompts, claim_guidance=claim_guidance, physics_guidance=physics_guidance,
        )  # fmt: skip

    def decode(self, x: Tensor) -> SceneBatch:
        """Scenes from normalised x_0 (B, N, D); known entries take their exact values."""
        return SceneBatch.from_tensor(self.clamp(x), self.scene_type, normalised=self.normalizer)

    def encode(self, batch: SceneBatch) -> Tensor:
        """Normalised x_0 (B, N, D) of scenes.

        Raises:
            InvalidInputError: the first slots do not hold the scene type's fixed welded objects.
        """
        expected = [self.scene_type.assets.index(fixed.asset) for fixed in self.scene_type.fixed]
        found = batch.categories[:, : len(expected)]
        wrong = (found != torch.tensor(expected, dtype=found.dtype, device=found.device)).any(dim=1)
        if bool(wrong.any()):
            scene = int(torch.nonzero(wrong)[0])
            names = [fixed.asset for fixed in self.scene_type.fixed]
            raise InvalidInputError(
                f"scene {scene} does not begin with the fixed objects {names}; reorder its slots so that it does"
            )
        return self.clamp(self.normalised(batch))

    def normalised(self, batch: SceneBatch) -> Tensor:
        """(B, N, D) scenes as this process sees them, before known entries are clamped."""
        return batch.to_tensor(normalised=self.normalizer)
