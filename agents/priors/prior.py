"""Scene priors: trained denoisers with their process, layout and normalizer, which sample, inpaint, train and load."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Generator, Tensor, nn

from agents.configuration.composition import check_types
from agents.configuration.prior_names import joint_name, split_name
from agents.diffusion import GaussianProcess, Preconditioning, ResidualVariance, ReverseStep, StepTable
from agents.diffusion.gaussian import check_weighting, make_schedule, timestep_distribution, timestep_weights
from agents.networks.denoisers import Observed, check_precision
from agents.networks.flux_modules import CountConditioning
from agents.networks.registry import config_from_state, config_state
from agents.networks.text import Text
from agents.networks.text_encoders import text_config_from_state
from agents.priors.adapters import AdapterSpec, merge_adapters, parse_adapters
from agents.priors.claim_guidance import ClaimGuidance
from agents.priors.config import UNIONS
from agents.priors.files import StoredPrior, explained, read_stored, write_stored
from agents.priors.guidance import Guide, Hook, NumberGuidance, PhysicsGuidance, physics_strength
from scene_envs.arrays import constant_on, within_memory
from scene_envs.datasets.prompts import parse_prompt
from scene_envs.envs.settings import check_claim_guidance, check_guidance, check_physics_guidance
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.normalizer import Normalizer
from scene_envs.protocols import StepTableLike
from scene_envs.scene import CATEGORY, POSE, POSE_FEATURES, TRANSLATION, SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type
from scene_envs.supports import welded_mask

Prompt = str | Sequence[str] | None
"""One text for all scenes, one per scene, or None for anything."""

Prior = TypeVar("Prior", bound="ScenePrior")

_CLASSES: dict[str, type[ScenePrior]] = {}
"""Classes of priors by the name of their process."""


@dataclass(frozen=True)
class NoisedScenes:
    """B scenes of N slots at timesteps of the forward process, with the training targets of the denoiser.

    Attributes:
        x_t: (B, N, D) noised scenes; known entries carry no noise, nor do observed ones of a mixed prior.
        t: (B,) int64 timesteps.
        target: (B, N, F) of the continuous output; F is 12 (poses) for a mixed prior and D for a continuous one.
        weight: (B, N, F) weights of its squared errors; 0 on known and on observed entries.
        scale: (B,) weight of the timestep in the loss.
        category: (B, N) int64, the clean categories.
        drawn: (B, N) weights of the category losses, 0 where the category is seen; None for a continuous prior.
        observed: entries that are observed; None where there are none.
    """

    x_t: Tensor
    t: Tensor
    target: Tensor
    weight: Tensor
    scale: Tensor
    category: Tensor
    drawn: Tensor | None = None
    observed: Observed | None = None

    def rows(self, rows: slice) -> NoisedScenes:
        """Some of the scenes."""
        some: dict[str, Any] = {name: value[rows] for name, value in vars(self).items() if isinstance(value, Tensor)}
        return replace(self, **some, observed=None if self.observed is None else self.observed.rows(rows))


@dataclass(frozen=True)
class DenoiserOutput:
    """Output of the denoiser for noised scenes.

    Attributes:
        continuous: (B, N, F), in the units of :attr:`NoisedScenes.target`.
        logits: (B, N, K) of the clean categories; None for a continuous prior.
    """

    continuous: Tensor
    logits: Tensor | None = None


class Frame(NamedTuple):
    """What is known of the entries of scenes of N slots.

    Attributes:
        known: (N, D) bool, entries that are clamped.
        values: (N, D) what they are clamped to; 0 elsewhere.
        free: (N,) bool, slots that no fixed object has.
        moving: (N, D) 1 for entries that are not known, 0 for the others.
    """

    known: Tensor
    values: Tensor
    free: Tensor
    moving: Tensor


class ScenePrior(nn.Module, ABC):
    """A trained denoiser with its schedule, layout and normalizer. Tensors x are normalised scenes (B, N, D).

    Fixed welded objects and constant features are *known*: clamped to their values while sampling and left
    out of the loss and of every log-probability. The two kinds of prior are
    :class:`~agents.priors.continuous.ContinuousPrior` and :class:`~agents.priors.mixed.MixedPrior`.

    Args:
        config: its configuration.
        normalizer: normalizer of raw scenes in the scene type's layout; a mixed prior uses its pose features alone.
        preconditioning: moments (F,) of what the network denoises, normalised: poses, or whole slots.
        card: facts about its training.
        residual: (G, F) measured error of what the network denoises.

    In inpainting, the network of a mixed prior reads the observed entries without noise. That of a continuous prior
    reads them with the noise of each level (Lugmayr et al. 2022, Eq. 8).

    >>> from agents.priors.testing import tiny_prior
    >>> prior = tiny_prior("dimsum_table")
    >>> prior.sample(2, num_steps=3, seed=0)
    SceneBatch('dimsum_table', (2, 34, 20))
    """

    process_name = ""
    """Name of the process in configuration files; a subclass that sets it can be loaded by :meth:`load`."""
    config_type: type[Any]
    """Class of its configuration, a dataclass."""
    config: Any
    """Its configuration."""
    scene_type: SceneType
    normalizer: Normalizer
    preconditioning: Preconditioning
    card: dict[str, Any]
    """Facts about its training."""
    residual: ResidualVariance | None
    """Measured error of the denoiser, if it was measured."""
    process: GaussianProcess
    """Gaussian process of the poses, and of all other continuous features."""
    denoiser: Any
    """The network inside its process, a module with ``.network``."""
    loaded_as: str = ""
    """Name or path by which :meth:`load` found the prior, with its adapters; empty for one that was not loaded."""
    _fixed: Tensor
    _timestep_weights: Tensor

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if cls.process_name:
            _CLASSES[cls.process_name] = cls

    def __init__(
        self,
        config: Any,
        normalizer: Normalizer,
        preconditioning: Preconditioning,
        card: dict[str, Any] | None = None,
        residual: ResidualVariance | None = None,
    ) -> None:
        super().__init__()
        check_weighting(config.loss_weighting, config.prediction)
        self.config = config
        self.scene_type = get_scene_type(config.scene_type)
        check_physics_guidance(config.physics_guidance, self.scene_type)
        self.normalizer = normalizer
        self.preconditioning = preconditioning
        self.card = card or {}
        self.residual = residual
        schedule = make_schedule(config.schedule, config.num_timesteps, config.noise_floor, config.noise_ceiling)
        self.process = GaussianProcess(schedule, config.prediction, preconditioning)
        distribution = timestep_distribution(config.timesteps, config.prediction)
        self._timestep_weights = timestep_weights(distribution, schedule, config.noise_mean, config.noise_std)
        self.denoiser = self._denoiser()
        fixed = SceneBatch.empty(self.scene_type, 1, len(self.scene_type.fixed) or 1)
        self.register_buffer("_fixed", self.normalised(fixed)[0], persistent=False)
        self._frames: dict[Any, Frame] = {}
        self._strides: dict[Any, tuple[ResidualVariance | None, tuple[float, float, Tensor]]] = {}

    @abstractmethod
    def _denoiser(self) -> nn.Module:
        """The network inside its process, once the configuration fits the scene type."""

    @property
    def device(self) -> torch.device:
        """Device of the weights."""
        return self._fixed.device

    # -- files ------------------------------------------------------------------------------------

    @classmethod
    def load(cls: type[Prior], name: str | os.PathLike[str] | ScenePrior, adapter: AdapterSpec | None = None) -> Prior:
        """A shipped prior by name, or one from a prior or run directory; in evaluation mode.

        Args:
            name: name or path of the prior; ``NAME with ADAPTER`` names its adapters as well.
            adapter: updates that are added to its weights: priors that were trained from this one, or the folders of
                such runs. Several are joined by ``+`` or in a list, each with a factor before ``*`` if need be.

        Raises:
            UnknownNameError: no shipped prior has that name.
            InvalidInputError: an adapter is missing, or was trained on another prior.
            CorruptFileError: its files are not those of a prior, or do not fit each other.
        """
        if isinstance(name, ScenePrior):
            if adapter:
                raise InvalidInputError(
                    f"adapter={adapter!r} is added to a prior that is loaded by name; give its name or folder, not the "
                    "prior itself"
                )
            return cast(Prior, name)
        name, named = split_name(name)
        terms = [term for spec in (named, adapter) if spec for term in parse_adapters(spec)]
        stored = read_stored(name)
        if terms:
            stored = merge_adapters(stored, str(name), terms)
        with explained(name):
            if stored.process not in _CLASSES:
                raise unknown_name("process", stored.process, _CLASSES)
            made: Any = _CLASSES[stored.process]
            config = made.config_from_state(stored.fields)
            prior = made(config, stored.normalizer, stored.preconditioning, stored.card, stored.residual)
            prior.load_weights(stored.tensors)
        prior.loaded_as = joint_name(name, [spec for spec in (named, adapter) if spec])
        return cast(Prior, prior.eval())

    def save(self, directory: str | os.PathLike[str], precision: str = "float32") -> Path:
        """Write ``config.json`` and ``model.safetensors`` into ``directory``.

        Args:
            directory: folder, made if need be.
            precision: format of the weights in the file, ``"float32"`` or ``"float16"``; loading makes float32.
        """
        stored = StoredPrior(
            self.process_name,
            self.config_state(),
            self.scene_type,
            self.normalizer,
            self.preconditioning,
            self.card,
            self.residual,
            self.weights(),
        )
        return write_stored(directory, stored, precision)

    def config_state(self) -> dict[str, Any]:
        """The ``prior`` entry of the configuration file."""
        return {**asdict(self.config), "network": config_state(self.config.network)}

    @classmethod
    def config_from_state(cls, fields: dict[str, Any]) -> Any:
        """Inverse of :meth:`config_state`, also after a trip through JSON."""
        fields = {**fields, "network": config_from_state(fields["network"], cls.process_name)}
        if "text" in fields:
            fields["text"] = text_config_from_state(fields["text"])
        check_types(cls.config_type, fields)
        return cls.config_type(**fields)

    def weights(self) -> dict[str, Tensor]:
        """Trained tensors by name, as a prior's file holds them."""
        return dict(self.denoiser.network.state_dict())

    def load_weights(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of :meth:`weights`; raises RuntimeError when names or shapes differ."""
        self.denoiser.network.load_state_dict(tensors)

    # -- text -------------------------------------------------------------------------------------

    @property
    def conditional(self) -> bool:
        """Whether the prior reads prompts."""
        return False

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

    # -- scenes and numbers -----------------------------------------------------------------------

    @property
    def features(self) -> int:
        """D, numbers per slot of the denoised tensor."""
        return self.scene_type.features

    @property
    def pose_width(self) -> int:
        """Leading features of the continuous output that are poses; the others, if any, are categories."""
        return POSE_FEATURES

    @cached_property
    def is_constant(self) -> Tensor:
        """(D,) bool: features that never vary."""
        return self.normalizer.is_constant

    def known(self, slots: int) -> Tensor:
        """(slots, D) bool: entries that are clamped (fixed welded slots, constant features)."""
        known = constant_on(self.is_constant, self._fixed.device).expand(slots, -1).clone()
        known[: len(self.scene_type.fixed)] = True
        return known

    def clamp(self, x: Tensor) -> Tensor:
        """``x`` (B, N, D) with its known entries set to their values."""
        frame = self.frame(x)
        return torch.where(frame.known, frame.values, x)

    def frame(self, x: Tensor) -> Frame:
        """What is known of the entries of scenes ``x`` (B, N, D); computed once for each number of slots."""
        key = x.shape[1], x.device, x.dtype
        if key not in self._frames:
            with torch.inference_mode(False):  # training may read it, too
                known, count = self.known(x.shape[1]).to(x.device), len(self.scene_type.fixed)
                values = torch.cat([self._fixed[:count].to(x), x.new_zeros(x.shape[1] - count, known.shape[1])])
                free = torch.arange(x.shape[1], device=x.device) >= count
                self._frames[key] = Frame(known, values, free, (~known).to(x))
        return self._frames[key]

    def stride(self, t: int, previous: int, eta: float, like: Tensor) -> tuple[float, float, Tensor]:
        """Weights of x_0 and x_t in the mean of a reverse step, and its std, () or (F,); computed once.

        Errors are those of :meth:`~agents.diffusion.GaussianProcess.posterior`.
        """
        key = t, previous, eta, like.device
        known = self._strides.get(key)
        if known is None or known[0] is not self.residual:
            with torch.inference_mode(False):  # training may read it, too
                residual = None if self.residual is None else self.residual.at(t)
                x0_weight, xt_weight, std = self.process.posterior_weights(t, previous, residual, eta)
                known = self._strides[key] = (self.residual, (x0_weight, xt_weight, std.to(like.device)))
        return known[1]

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

    def decode(self, x: Tensor) -> SceneBatch:
        """Scenes from normalised x_0 (B, N, D); known entries take their exact values."""
        return SceneBatch.from_tensor(self.clamp(x), self.scene_type, normalised=self.normalizer)

    def normalised(self, batch: SceneBatch) -> Tensor:
        """(B, N, D) scenes as this process sees them, before known entries are clamped."""
        return batch.to_tensor(normalised=self.normalizer)

    # -- settings ---------------------------------------------------------------------------------

    def with_union(self: Prior, union: str) -> Prior:
        """This prior, whose scenes of a union of scene types hold the assets of ``"one_type"``, or ``"any"`` assets.

        A prior with continuous categories has no such setting, and is not changed.

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

    def with_precision(self: Prior, precision: str) -> Prior:
        """This prior, whose chains compute the products of the network's blocks in ``precision``.

        One of ``"float32"``, ``"tf32"`` and ``"bfloat16"``. Positions, relations, contacts, all that enters and leaves
        the blocks, and the steps whose noise-to-signal ratio is at most 0.1 are always in float32. Training is not
        changed.

        Raises:
            UnknownNameError: another word.
            InvalidInputError: the device of the prior has no such products, or its network no such blocks.
        """
        check_precision(precision, self.device)
        if precision != "float32" and not hasattr(self.denoiser.network, "body_precision"):
            raise InvalidInputError(
                f"precision={precision!r}: {type(self.denoiser.network).__name__} has no body_precision, which tells a "
                "network the precision of its blocks; use precision=float32"
            )
        self.denoiser.chain_precision = precision
        return self

    def with_open_empty(self: Prior, share: float) -> Prior:
        """This prior; in its training, ``share`` of the masks of whole slots include every empty slot.

        A prior whose network reads no observed entries has no such masks and is not changed.
        """
        return self

    def with_module(self: Prior, name: str) -> Prior:
        """This prior, whose network has the module ``name``; a new one changes nothing until it is trained.

        Args:
            name: ``refinement`` (:class:`~agents.networks.geometry.Refinement`) or ``count_logits``
                (:class:`~agents.networks.flux_modules.CountLogits`).

        Raises:
            InvalidInputError: the network cannot have the module.
        """
        raise InvalidInputError(
            f"{name} needs a mixed flux network, a refinement also relations and assets with geometry, and "
            f"{self.loaded_as or self.scene_type.name!r} lacks one of them; take another prior"
        )

    # -- the reverse chain ------------------------------------------------------------------------

    def step_table(self, num_steps: int) -> StepTable:
        """The reverse steps of a chain of ``num_steps``, any number in 1..T."""
        return StepTable.spaced(self.config.num_timesteps, num_steps)

    def initial(self, count: int, slots: int, generator: Generator | None = None) -> Tensor:
        """x_T (count, slots, D), see :meth:`initial_from_noise`; the generator is on the device of the weights."""
        noise = torch.randn(count, slots, self.features, generator=generator, device=self._fixed.device)
        return self.initial_from_noise(noise)

    def initial_from_noise(self, noise: Tensor) -> Tensor:
        """x_T (B, N, D) from standard normal ``noise`` (B, N, D), known entries clamped."""
        return self.clamp(noise)

    @abstractmethod
    def transition(self, x_t: Tensor, step: int, table: StepTableLike, *, eta: float = 1.0) -> ReverseStep:
        """p(x_{t-1} | x_t) of scenes (B, N, D); differentiable in the network's parameters.

        Known entries are certain; at the last step all entries are. ``eta`` scales the noise of the continuous
        features, as in :meth:`sample`.
        """

    def estimate(self, step: int, table: StepTable) -> tuple[float, Tensor]:
        """Weight of the denoised translations in x_{t-1}, and their standard deviation (3,), normalised, on the CPU."""
        weight, std = self.process.estimate(int(table.timesteps[step]), int(table.previous[step]), self.residual)
        return weight, std[TRANSLATION]

    def position_std(self, step: int, table: StepTable) -> Tensor:
        """(3,) standard deviation of the denoised positions at a step of a chain, m, on the CPU; 0 without extent."""
        scale = self.normalizer.scale[TRANSLATION].cpu()
        return torch.where(scale == 0, torch.zeros_like(scale), self.estimate(step, table)[1] / scale)

    @torch.no_grad()
    def sample(
        self, count: int, *, prompt: Prompt = None, guidance: float = 0.0,
        claim_guidance: float = 0.0, physics_guidance: float | None = None, num_steps: int = 50,
        slots: int | None = None, seed: int = 0, batch_size: int = 64, eta: float = 1.0,
    ) -> SceneBatch:  # fmt: skip
        """``count`` scenes by ancestral sampling (Ho et al. 2020, Algorithm 2) over ``num_steps`` strides.

        Args:
            count: number of scenes.
            prompt: text that says what the scenes should hold, one for all or one per scene; None for anything.
            guidance: w of classifier-free guidance, (1 + w) conditional - w unconditional (Ho and Salimans 2022); it
                needs a prompt.
            claim_guidance: strength of guidance to the claims of the prompt, see
                :class:`~agents.priors.claim_guidance.ClaimGuidance` and
                :class:`~agents.priors.guidance.NumberGuidance`; 2 is a good choice. It needs a prompt.
            physics_guidance: strength with which objects are moved out of overlaps and onto supports at the last steps,
                0 to 1, see :class:`~agents.priors.guidance.PhysicsGuidance`. None takes the strength that the
                prior was published with (``config.physics_guidance``): 1 for shipped priors whose names end in
                ``_feasible``, otherwise 0. Guided chains leave a refinement out.
            num_steps: denoiser evaluations per scene, 1..T.
            slots: slots per scene; more than trained is allowed.
            seed: seed of the torch generator; the same seed and batch size give the same scenes.
            batch_size: scenes denoised at once.
            eta: noise of the continuous features in the reverse steps (Song et al. 2021, Eq. 16). 1 is the ancestral
                chain. With 0, only x_T and the discrete categories of a mixed prior are random.
        """
        if count < 1:
            raise InvalidInputError(f"count={count}: ask for at least one scene")
        if batch_size < 1:
            raise InvalidInputError(f"batch_size={batch_size}: at least one scene must be denoised at a time")
        wide = self.config.slots if slots is None else slots
        prompts = self._check_prompts(prompt, guidance, claim_guidance, count, wide)
        strength = physics_strength(physics_guidance, self.config, self.scene_type)
        generator, table = Generator(str(self.device)).manual_seed(seed), self.step_table(num_steps)

        def denoised(start: int, size: int) -> Tensor:
            texts = None if prompts is None else prompts[start : start + size]
            hook = self.sampling_hook(
                size, wide, num_steps, prompts=texts, claim_guidance=claim_guidance, physics_guidance=strength
            )
            text = None if texts is None else self.encode_prompts(texts)
            x = self.initial(size, wide, generator)
            refined = not strength
            return self.run_chain(x, table, generator, None, text, guidance, eta, hook, refined=refined)

        chunks = [
            within_memory(partial(denoised, start), min(batch_size, count - start), "batch_size")
            for start in range(0, count, batch_size)
        ]
        return self.decode(torch.cat(chunks))

    @abstractmethod
    def run_chain(
        self, x: Tensor, table: StepTable, noises: Sequence[Generator] | Generator | None,
        observed: Observed | None = None, text: Text | None = None, guidance: float = 0.0, eta: float = 1.0,
        hook: Hook | None = None, closed: Tensor | None = None, refined: bool = True,
    ) -> Tensor:  # fmt: skip
        """x_0 (B, N, D) from x_T, with observed entries kept. No gradient passes.

        Args:
            x: x_T (B, N, D).
            table: the chain.
            noises: one generator for all scenes, or one per scene; None for torch's own.
            observed: entries that are kept.
            text: tokens (B, L, W) and mask (B, L) of the prompts; None without.
            guidance, eta: settings of :meth:`sample`.
            hook: hook that is called at every step.
            closed: (B, K) bool, categories that slots that are not observed do not take.
            refined: False leaves a refinement out, as where physics guidance moves the objects.
        """

    def sampling_hook(
        self, count: int, slots: int, num_steps: int, *, prompts: Sequence[str] | None = None,
        claim_guidance: float = 0.0, physics_guidance: float = 0.0,
    ) -> Hook | None:  # fmt: skip
        """Hook of a chain that samples whole scenes under guidance; None where nothing guides them.

        Args:
            count: scenes.
            slots: slots per scene.
            num_steps: steps of the chain.
            prompts: one per scene; without prompts there is no claim guidance.
            claim_guidance: strength of claim guidance, see :meth:`sample`.
            physics_guidance: strength, 0 for none.
        """
        moved = torch.ones(count, slots, 1, dtype=torch.bool)
        moved[:, : len(self.scene_type.fixed)] = False
        table = self.step_table(num_steps)
        return self.guidance_hook(table, self.decode, moved, prompts, claim_guidance, physics_guidance)

    def guidance_hook(
        self, table: StepTable, scenes: Callable[[Tensor], SceneBatch], moved: Tensor, prompts: Sequence[str] | None,
        claim_guidance: float, physics_guidance: float, guide: Guide | None = None,
    ) -> Hook | None:  # fmt: skip
        """The hook of one chain under guidance; None if nothing guides it.

        At a step it calls number guidance, ``guide``, claim guidance and physics guidance.

        Args:
            table: the chain.
            scenes: the B scenes of normalised x_0 (B, N, D), as guides see them.
            moved: (B, N, 1) bool, slots whose poses are denoised.
            prompts: one per scene; without prompts there is no claim guidance.
            claim_guidance: strength, 0 for none.
            physics_guidance: strength, 0 for none.
            guide: guide of the caller.
        """
        scale, moved = (there.to(self.device) for there in (self.normalizer.scale[TRANSLATION], moved))
        guides: list[Guide] = [] if guide is None else [guide]
        draw = None
        if prompts is not None and claim_guidance:
            guides.append(ClaimGuidance(prompts, self.scene_type, claim_guidance, moved.squeeze(-1)))
            draw = NumberGuidance(prompts, self.scene_type)
        if physics_guidance:
            guides.append(PhysicsGuidance(physics_guidance, moved.squeeze(-1)))
        if draw is None and not guides:
            return None
        errors = [self.position_std(step, table) for step in range(len(table))] if guides else []
        there = torch.stack(errors).to(self.device) if guides else scale

        def hook(step: int, x: Tensor, reverse: ReverseStep) -> ReverseStep:
            estimate = reverse.denoised
            if draw is not None:
                reverse = draw(x, reverse)
            if estimate is None:
                return reverse
            denoised = partial(scenes, estimate)
            for each in guides:
                acts = getattr(each, "acts", None)
                shift = each(step, len(table), denoised, there[step]) if acts is None or acts(errors[step]) else None
                if shift is not None:
                    reverse = reverse.shifted(self.estimate(step, table)[0] * scale * shift.to(scale) * moved)
            return reverse

        return hook

    # -- inpainting -------------------------------------------------------------------------------

    @torch.no_grad()
    def inpaint(
        self, batch: SceneBatch, mask: Tensor, *, prompt: Prompt = None, guidance: float = 0.0,
        claim_guidance: float = 0.0, physics_guidance: float | None = None, num_steps: int = 50,
        generators: Sequence[Generator] | None = None, seed: int = 0, guide: Guide | None = None,
    ) -> SceneBatch:  # fmt: skip
        """Regenerate the masked entries, given the rest.

        A room keeps its furniture: if generated welded objects are kept and none is masked, masked slots take no
        welded asset.

        Args:
            batch: scenes to change.
            mask: bool, True where something is regenerated: (B, N) for whole slots, or (B, N, 2) for the pose and the
                category of each slot. Fixed welded slots are never regenerated.
            prompt: text that says what the whole scenes should hold in the end, one for all or one per scene.
            guidance, claim_guidance, physics_guidance: arguments of :meth:`sample`; regenerated objects are moved.
            num_steps: denoiser evaluations, 1..T.
            generators: one per scene, so that a scene's result does not depend on its neighbours' noise.
            seed: seed of the generators, where none are given.
            guide: moves the poses that are regenerated.

        Returns:
            Scenes on the device of ``batch``, whose unmasked entries are bit-identical to its own. Where the category
            alone is regenerated, an object stays an object and an empty slot stays empty, as the pose is kept.

        Raises:
            InvalidInputError: a mask of the wrong shape or type, not one generator per scene, a prompt for a prior
                that reads none, guidance without a prompt, ``claim_guidance`` below 0, or ``physics_guidance`` outside
                0 to 1.
        """
        both = check_mask(batch, mask, generators).to(batch.tensor.device)
        both[:, : len(self.scene_type.fixed)] = False
        prompts = self._check_prompts(prompt, guidance, claim_guidance, len(batch), batch.tensor.shape[1])
        strength = physics_strength(physics_guidance, self.config, self.scene_type)
        if generators is None:
            generators = [Generator().manual_seed(seed + i) for i in range(len(batch))]
        table = self.step_table(num_steps)

        def scenes(x: Tensor) -> SceneBatch:
            return merge(batch, self.decode(x).to(batch.tensor.device), both)

        hook = self.guidance_hook(table, scenes, both[..., :1], prompts, claim_guidance, strength, guide)
        text = None if prompts is None else self.encode_prompts(prompts)
        given, changed = batch.to(self.device), both.to(self.device)
        observed = Observed(self.encode(given), ~changed[..., 0], ~changed[..., 1])
        x = self.initial_from_noise(draw_noise(observed.x, generators))
        closed = self.closed_categories(given, changed)
        x = self.run_chain(
            x, table, generators, observed, text, guidance, hook=hook, closed=closed, refined=not strength
        )
        return scenes(x)

    def _check_prompts(
        self, prompt: Prompt, guidance: float, claim_guidance: float, count: int, slots: int
    ) -> list[str] | None:
        """One prompt per scene, or None for scenes without; raises InvalidInputError as :meth:`inpaint` does."""
        check_claim_guidance(prompt, claim_guidance)
        if prompt is None:
            check_guidance(prompt, guidance)
            return None
        texts = [prompt] if isinstance(prompt, str) else prompt
        if not isinstance(texts, Sequence) or not all(isinstance(text, str) for text in texts):
            raise InvalidInputError(f"prompt={str(prompt)[:80]!r} must be a text, a list of texts, or null")
        prompts = [prompt] * count if isinstance(prompt, str) else list(prompt)
        if len(prompts) != count:
            raise InvalidInputError(f"{len(prompts)} prompts for {count} scenes; give one text, or one per scene")
        if not self.conditional:
            raise no_text(self.scene_type, next(iter(prompts), ""))
        check_guidance("".join(prompts), guidance)
        check_object_count(prompts, self.scene_type, slots)
        return prompts

    def complete(
        self, batch: SceneBatch, *, prompt: Prompt = None, guidance: float = 0.0,
        claim_guidance: float = 0.0, physics_guidance: float | None = None, slots: int | None = None,
        fill: int | None = None, num_steps: int = 50, seed: int = 0,
    ) -> SceneBatch:  # fmt: skip
        """Fill the empty slots of ``batch``, keeping its objects.

        With all empty slots open, a prior crowds a scene. With ``fill`` open slots, it adds at most that many objects.

        Args:
            batch: scenes.
            prompt: text that says what the completed scenes should hold, one for all or one per scene.
            guidance, claim_guidance, physics_guidance: arguments of :meth:`inpaint`.
            slots: slots of the result, at least those of ``batch``; None keeps them.
            fill: most objects to add to a scene; None for as many as there are empty slots.
            num_steps: denoiser evaluations per scene.
            seed: seed of the noise; scene i uses ``seed + i``.
        """
        wide = batch if slots is None else batch.with_slots(slots)
        if fill is not None and fill < 0:
            raise InvalidInputError(f"fill={fill}: give the most objects to add, at least 0, or None")
        open_slots = wide.is_empty if fill is None else wide.is_empty & (wide.is_empty.cumsum(dim=1) <= fill)
        return self.inpaint(
            wide, open_slots, prompt=prompt, guidance=guidance, claim_guidance=claim_guidance,
            physics_guidance=physics_guidance, num_steps=num_steps, seed=seed,
        )  # fmt: skip

    def rearrange(
        self, batch: SceneBatch, *, prompt: Prompt = None, guidance: float = 0.0,
        claim_guidance: float = 0.0, physics_guidance: float | None = None, num_steps: int = 50, seed: int = 0,
    ) -> SceneBatch:  # fmt: skip
        """New poses for the free objects of ``batch``; all categories, and the poses of welded objects, stay.

        Arguments as in :meth:`complete`.
        """
        free = batch.is_free
        mask = torch.stack([free, torch.zeros_like(free)], dim=-1)
        return self.inpaint(
            batch, mask, prompt=prompt, guidance=guidance, claim_guidance=claim_guidance,
            physics_guidance=physics_guidance, num_steps=num_steps, seed=seed,
        )  # fmt: skip

    def closed_categories(self, batch: SceneBatch, mask: Tensor) -> Tensor:
        """(B, K) bool: categories that the slots under ``mask`` (B, N, 2) must not take.

        These are the welded assets, in scenes that keep generated furniture and regenerate none. No mask generator
        masks furniture, so without this rule every further inpainting of empty slots would add furniture.
        """
        changed = mask[..., 1]
        welded = constant_on(welded_mask(self.scene_type), changed.device)
        furniture, changed = (x[:, len(self.scene_type.fixed) :] for x in (welded[batch.categories], changed))
        closed = (furniture & ~changed).any(dim=1) & ~(furniture & changed).any(dim=1)
        return closed[:, None] & welded

    # -- training ---------------------------------------------------------------------------------

    def pretraining_loss(
        self,
        x0: Tensor,
        generator: Generator | None = None,
        reduction: str = "mean",
        t: Tensor | None = None,
        text: Text | None = None,
    ) -> Tensor:
        """The training loss of scenes ``x0`` (B, N, D) as :meth:`encode` gives them, on entries that are not known.

        Args:
            x0: normalised scenes.
            generator: source of timesteps and noise (CPU).
            reduction: ``"mean"`` over scenes, or ``"none"`` for (B,); always the mean over entries.
            t: (B,) timesteps, drawn when None.
            text: tokens (B, L, W) and their mask (B, L), as :meth:`encode_prompts` gives them; None without prompts.
        """
        per_scene = self.noised_loss(self.noised(x0, generator, t), text)
        return per_scene.mean() if reduction == "mean" else per_scene

    @abstractmethod
    def noised_loss(self, noised: NoisedScenes, text: Text | None = None) -> Tensor:
        """(B,) training losses of scenes that :meth:`noised` has noised; arguments as for :meth:`output`."""

    @abstractmethod
    def noised(self, x0: Tensor, generator: Generator | None = None, t: Tensor | None = None) -> NoisedScenes:
        """A draw of the forward process for scenes ``x0`` (B, N, D), as the pretraining loss takes it.

        Args:
            x0: normalised scenes.
            generator: source of timesteps, noise and observed entries (CPU).
            t: (B,) timesteps, drawn when None.
        """

    @abstractmethod
    def output(self, noised: NoisedScenes, text: Text | None = None) -> DenoiserOutput:
        """Output of the denoiser for noised scenes; differentiable in its parameters.

        Args:
            noised: scenes that :meth:`noised` gives.
            text: tokens (B, L, W) and their mask (B, L), as :meth:`encode_prompts` gives them; None without prompts.
        """

    def denoised(self, noised: NoisedScenes, output: DenoiserOutput) -> Tensor:
        """(B, N, F) estimate of x_0 from the continuous ``output`` of noised scenes."""
        features = output.continuous.shape[-1]
        return self.process.x0_from_output(noised.x_t[..., :features], noised.t, output.continuous)

    def observed_entries(self, x: Tensor, observed: Observed | None = None) -> Observed | None:
        """Observed entries of scenes ``x`` (B, N, D), without noise, as the network reads them; None for none."""
        return observed

    def draw_timesteps(self, count: int, generator: Generator | None = None) -> Tensor:
        """(count,) int64 training timesteps, from the distribution that the configuration names."""
        return torch.multinomial(self._timestep_weights, count, replacement=True, generator=generator)

    def loss_weight(self, slots: int) -> Tensor:
        """(slots, D) weights of the pretraining loss; 0 on known entries."""
        weight = (~self.known(slots)).float()
        weight[:, TRANSLATION] *= self.config.translation_weight
        return weight

    @torch.no_grad()
    def fit_residual(self, x0: Tensor, levels: int = 40, seed: int = 0) -> ResidualVariance:
        """Measure the denoiser's error on normalised scenes ``x0`` (B, N, D) at ``levels`` timesteps, and keep it."""
        generator = Generator().manual_seed(seed)
        timesteps = StepTable.spaced(self.config.num_timesteps, levels).timesteps.flip(0)
        rows = []
        for t in timesteps:
            noise = torch.randn(x0.shape, generator=generator).to(x0.device)
            rows.append(self.mean_square_error(x0, t.to(x0.device).expand(len(x0)), noise).cpu())
        self.residual = ResidualVariance(timesteps, torch.stack(rows))
        return self.residual

    @abstractmethod
    def mean_square_error(self, x0: Tensor, t: Tensor, noise: Tensor) -> Tensor:
        """(F,) mean squared error of denoised scenes ``x0`` (B, N, D), with ``noise`` added at timesteps ``t`` (B,)."""


def draw_noise(like: Tensor, generators: Sequence[Generator] | Generator | None) -> Tensor:
    """Standard normal noise shaped as ``like`` (B, N, D), from one generator or one CPU generator per scene."""
    if generators is None or isinstance(generators, Generator):
        return torch.randn(like.shape, generator=generators, device=like.device)
    return torch.stack([torch.randn(like.shape[1:], generator=g) for g in generators]).to(like.device)


# -- masks -----------------------------------------------------------------------------------------


def check_mask(batch: SceneBatch, mask: Tensor, generators: Sequence[Generator] | None = None) -> Tensor:
    """The mask as (B, N, 2), a copy; raises InvalidInputError when an argument does not fit ``batch``."""
    expected = tuple(batch.tensor.shape[:2])
    if tuple(mask.shape) not in (expected, (*expected, 2)) or mask.dtype != torch.bool:
        raise InvalidInputError(
            f"mask must be bool of shape {expected}, or {(*expected, 2)} for pose and category, "
            f"got {mask.dtype} {tuple(mask.shape)}"
        )
    if generators is not None and len(generators) != len(batch):
        raise InvalidInputError(f"{len(generators)} generators for {len(batch)} scenes; give one per scene")
    return (mask if mask.ndim == 3 else torch.stack([mask, mask], dim=-1)).clone()


def merge(batch: SceneBatch, new: SceneBatch, mask: Tensor) -> SceneBatch:
    """``batch`` with the poses and categories of ``new`` where ``mask`` (B, N, 2) says so."""
    empty = batch.scene_type.num_assets
    taken = mask[..., 1] & (mask[..., 0] | (new.is_empty == batch.is_empty))  # if the pose is kept, emptiness is too
    category = torch.where(taken[..., None], new.tensor[..., CATEGORY], batch.tensor[..., CATEGORY])
    pose = torch.where(mask[..., :1], new.tensor[..., POSE], batch.tensor[..., POSE])
    gone = category.argmax(dim=-1, keepdim=True) == empty
    return SceneBatch(torch.cat([torch.where(gone, torch.zeros_like(pose), pose), category], dim=-1), batch.scene_type)


# -- prompts ---------------------------------------------------------------------------------------


def no_text(scene_type: SceneType, prompt: str) -> InvalidInputError:
    """The error of a prompt for a prior that reads none."""
    return InvalidInputError(
        f"this prior of {scene_type.name!r} was trained without text and cannot follow the prompt {prompt!r}; "
        "leave prompt= out, or load a prior that reads prompts"
    )


def asked_objects(prompt: str, scene_type: SceneType) -> int:
    """Number of objects that a prompt asks for; 0 for free text.

    >>> from scene_envs.scene_types import get_scene_type
    >>> asked_objects("A scene with 12 objects.", get_scene_type("dimsum_table"))
    12
    """
    try:
        facts = parse_prompt(prompt, scene_type)
    except InvalidInputError:
        return 0
    return max(facts.count or 0, sum((facts.objects or {}).values()))


def check_object_count(prompts: Sequence[str], scene_type: SceneType, slots: int) -> None:
    """Raise InvalidInputError for a prompt that asks for more objects than a scene has slots; free text may."""
    for prompt in dict.fromkeys(prompts):
        asked = asked_objects(prompt, scene_type)
        if asked > slots:
            raise InvalidInputError(
                f"the prompt {prompt!r} asks for {asked} objects, a scene has {slots} slots; give slots={asked} or more"
            )
