"""Configuration of priors: layout, network, process and loss."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from agents.diffusion.categorical import UNMASKINGS
from agents.networks.registry import NetworkConfig
from agents.networks.text_encoders import AnyTextConfig
from scene_envs.errors import Checked, OneOf

PROCESSES = ("continuous", "mixed")
"""Diffusion processes: categories as numbers, or as discrete states."""
CATEGORY_LOSSES = ("cross_entropy", "bound")
UNIONS = ("one_type", "any")
"""Assets that a scene of a union of scene types may hold: those of one of its types, or any."""


@dataclass(frozen=True)
class DenoiserConfig:
    """What is denoised, and by which network.

    Attributes:
        scene_type: name of its scene type.
        slots: slots per scene that it was trained on.
        network: kind and size of its denoiser.
        physics_guidance: strength of physics guidance where a caller gives none, 0 to 1.
    """

    scene_type: str
    slots: int
    network: NetworkConfig
    physics_guidance: float = field(default=0.0, kw_only=True)


@dataclass(frozen=True)
class PoseDiffusionConfig:
    """Noise of the poses, and the loss of their denoising.

    Attributes:
        schedule: noise schedule, ``"karras"`` or ``"linear"``.
        prediction: ``"edm"`` (preconditioning of Karras et al. 2022), ``"epsilon"``, ``"x0"`` or ``"v"``.
        num_timesteps: T of the schedule.
        noise_mean: mean of ln(noise-to-signal) over training timesteps.
        noise_std: its standard deviation.
        translation_weight: weight of x, y, z in the pretraining loss, other features having 1.
        timesteps: distribution of training timesteps, ``"lognormal"`` (of the noise-to-signal ratio), ``"uniform"`` or
            ``"both"`` in equal parts; None is what was published with the prediction, lognormal for ``"edm"`` and
            uniform for the others.
        loss_weighting: weighting of the loss by timestep, ``"none"`` or ``"min_snr"``.
        noise_floor: lowest noise-to-signal ratio of the ``"karras"`` schedule, in normalised units.
        noise_ceiling: highest.
        clip: bound on denoised scenes while sampling, normalised units; 0 for none (1 is that of Ho et al. 2020).
    """

    schedule: str = "karras"
    prediction: str = "edm"
    num_timesteps: int = 1000
    noise_mean: float = -1.8
    noise_std: float = 2.1
    translation_weight: float = 3.0
    timesteps: str | None = None
    loss_weighting: str = "none"
    noise_floor: float = 0.002
    noise_ceiling: float = 80.0
    clip: float = 0.0


@dataclass(frozen=True)
class PriorConfig(PoseDiffusionConfig, DenoiserConfig):
    """Configuration of a continuous prior, whose categories are diffused as numbers with the poses.

    Further fields are those of :class:`DenoiserConfig` and :class:`PoseDiffusionConfig`.

    Attributes:
        rotation: representation of the rotations, ``"matrix"``, ``"quaternion"`` or ``"axis_angle"``.
    """

    rotation: str = "matrix"


@dataclass(frozen=True)
class MixedPriorConfig(PoseDiffusionConfig, DenoiserConfig, Checked):
    """Configuration of a mixed discrete-continuous prior.

    Further fields are those of :class:`DenoiserConfig` and :class:`PoseDiffusionConfig`.

    Attributes:
        timesteps: distribution of training timesteps, one of those of continuous priors but not None.
        kernel: kernel of the categories, one of :data:`~agents.diffusion.CATEGORICAL_KERNELS`.
        category_loss: ``"cross_entropy"`` of the clean category, or ``"bound"``, the paper's variational bound.
        category_weight: weight of the category loss, over that of the pose loss.
        auxiliary: weight of the cross-entropy in the bound.
        observed_share: share of training scenes in which some poses or categories are observed, for inpainting.
        open_empty_share: share of those in which whole slots are observed that observe no empty slot, as a mask of all
            empty slots does.
        text: kind and size of the text encoder; None for a prior that reads no prompts.
        empty_slots: ``"dropped"`` leaves slots that are known to be empty out of the network, which saves most of the
            work at low noise and needs an absorbing kernel; ``"attended"`` is the paper's.
        unmasking: choice of the masked slots that a step of an absorbing kernel unmasks: ``"even"``, as near to the
            expected number as can be; ``"systematic"``, the same, and kinds of objects whose number a prompt gives are
            near their expected numbers, too; or ``"independent"``, each by its own chance. Other kernels draw
            independently.
        union: what a scene of a union of scene types may hold: ``"one_type"``, the assets of one member, which is
            settled by the first objects of the scene, or ``"any"`` assets. Needs an absorbing kernel; other scene
            types have one member.
    """

    timesteps: str = "lognormal"
    kernel: str = "mask_and_replace"
    category_loss: Annotated[str, OneOf(CATEGORY_LOSSES, "category loss")] = "cross_entropy"
    category_weight: float = 0.3
    auxiliary: float = 5e-4
    observed_share: float = 0.3
    open_empty_share: float = 0.0
    text: AnyTextConfig | None = None
    empty_slots: str = "attended"
    unmasking: Annotated[str, OneOf(UNMASKINGS)] = "even"
    union: Annotated[str, OneOf(UNIONS)] = "one_type"
