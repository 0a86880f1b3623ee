"""Settings of the post-training algorithms; imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from agents.configuration import require_at_least, require_one_of, require_positive
from scene_envs.errors import InvalidInputError

CREDITS = ("auto", "scene", "object")
CATEGORY_CREDITS = ("auto", "scene", "none")


@dataclass
class AlgorithmSettings:
    """Settings that all algorithms share.

    Attributes:
        name: name of a registered algorithm.
        scenes_per_prompt: number of scenes of a batch that share a prompt; advantages are computed within such a group.
    """

    learning_rate: ClassVar[float] = 5e-5
    """Learning rate unless ``optimizer.lr`` names another."""
    regularisation_weight: ClassVar[float] = 0.5
    """Coefficient of the pretraining loss unless ``regularisation.weight`` names another."""
    sample_limits: ClassVar[Mapping[str, float]] = {}
    """Limits of the guard's sample figures unless ``guard`` names others; a reward may ask for other object counts."""

    name: str = ""
    scenes_per_prompt: int = 8

    def __post_init__(self) -> None:
        require_at_least(self, 2, "scenes_per_prompt")

    @property
    def optimiser_steps(self) -> int:
        """Optimiser steps per batch: the key ``updates`` of algorithms that have it."""
        return getattr(self, "updates", 1)


@dataclass
class DDPOSFSettings(AlgorithmSettings):
    """DDPO-SF: the score-function policy gradient (Black et al. 2024, Eq. 3).

    Attributes:
        gradient_steps: number of denoising steps per iteration that contribute to the gradient, drawn from the eligible
            steps.
        min_std: smallest sigma of an eligible step, in normalised units; steps with less noise are excluded from the
            gradient.
        credit: ``scene`` gives every slot the advantage of the scene, ``object`` gives it its own (for rewards with
            ``per_object``), ``auto`` uses ``object`` if the reward allows it.
    """

    name: str = "ddpo_sf"
    gradient_steps: int = 8
    min_std: float = 0.03
    credit: str = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 1, "gradient_steps")
        require_positive(self, "min_std")
        require_one_of(self, "credit", CREDITS)


@dataclass
class DDPOISSettings(DDPOSFSettings):
    """DDPO-IS: DDPO with clipped importance weights, for several updates per batch (Eq. 4).

    Attributes:
        clip_epsilon: half-width of the clip of the probability ratio.
        updates: optimiser steps per batch.
    """

    name: str = "ddpo_is"
    clip_epsilon: float = 1e-4
    updates: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 1, "updates")
        if not 0 < self.clip_epsilon < 1:
            raise InvalidInputError(f"clip_epsilon={self.clip_epsilon} must lie between 0 and 1")


@dataclass
class ForwardProcessSettings(AlgorithmSettings):
    """Settings that the forward-process algorithms share.

    Attributes:
        updates: optimiser steps per batch.
        draws: number of timesteps and noises of every scene per optimiser step.
        credit: credit of poses: ``scene`` gives every slot the advantage of the scene, ``object`` gives it its own (for
            rewards with ``per_object``), ``auto`` uses ``object`` if the reward allows it.
        category_credit: credit of categories: ``scene`` uses the advantage of the scene, ``none`` keeps the categories
            as they are, ``auto`` is ``none`` if poses have credit per object and the reward counts no objects, else
            ``scene``.
        sampler_decay: final decay of the averaged weights that sample, per iteration; it rises from 0.
    """

    learning_rate: ClassVar[float] = 2e-4
    regularisation_weight: ClassVar[float] = 0.2
    sample_limits: ClassVar[Mapping[str, float]] = {
        "count_distance": 1.0,
        "stack_distance": 0.5,
        "category_kl": 0.05,
        "classifier_accuracy": 0.1,
    }

    updates: int = 2
    draws: int = 2
    credit: str = "auto"
    category_credit: str = "auto"
    sampler_decay: float = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 1, "updates", "draws")
        require_one_of(self, "credit", CREDITS)
        require_one_of(self, "category_credit", CATEGORY_CREDITS)
        if not 0 <= self.sampler_decay < 1:
            raise InvalidInputError(f"sampler_decay={self.sampler_decay} must lie in [0, 1)")


@dataclass
class NFTSettings(ForwardProcessSettings):
    """NFT: good samples pull, bad samples push, both within bounds (Zheng et al. 2025).

    Attributes:
        beta: strength; smaller ones step further from the sampling policy.
        advantage_clip: advantage, in standard deviations, at which a sample is fully good or bad.
        expectation_lr: learning rate of the copy of the denoiser that learns the mean of own samples; 0 takes the
            sampling policy for it.
    """

    name: str = "nft"
    beta: float = 0.5
    advantage_clip: float = 2.0
    expectation_lr: float = 3e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "beta", "advantage_clip")
        require_at_least(self, 0, "expectation_lr")


@dataclass
class AWMSettings(ForwardProcessSettings):
    """AWM: the pretraining loss of own samples times their advantage (Xue et al. 2025).

    Attributes:
        beta: strength of the pull to the sampling policy, above 1.
        advantage_clip: largest advantage, in standard deviations.
        expectation_lr: the setting of the same name of ``nft``.
    """

    name: str = "awm"
    beta: float = 2.0
    advantage_clip: float = 2.0
    expectation_lr: float = 3e-4

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "advantage_clip")
        require_at_least(self, 0, "expectation_lr")
        if not self.beta > 1:
            raise InvalidInputError(f"beta={self.beta} must be above 1: below, a bad sample pushes without bound")


@dataclass
class GuidanceDistillationSettings(AlgorithmSettings):
    """Guidance distillation: the prior learns to place objects as physics guidance does; the reward is reported only.

    Attributes:
        updates: optimiser steps per batch.
        draws: number of steps of the chain of every scene per optimiser step.
        strength: strength of the physics guidance that is learned, 0 to 1.
        clip: largest move of an object that is learned at a step, in standard deviations of its denoised position.
        sampler_decay: decay of the averaged weights that sample, per iteration.
    """

    learning_rate: ClassVar[float] = 2e-4
    regularisation_weight: ClassVar[float] = 0.03
    sample_limits: ClassVar[Mapping[str, float]] = ForwardProcessSettings.sample_limits

    name: str = "guidance_distillation"
    updates: int = 4
    draws: int = 2
    strength: float = 1.0
    clip: float = 1.0
    sampler_decay: float = 0.9

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(self, 1, "updates", "draws")
        require_positive(self, "strength", "clip")
        if self.strength > 1:
            raise InvalidInputError(f"strength={self.strength:g} must lie in (0, 1]; 1 learns the whole moves")
        if not 0 <= self.sampler_decay < 1:
            raise InvalidInputError(f"sampler_decay={self.sampler_decay} must lie in [0, 1)")
