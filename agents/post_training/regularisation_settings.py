"""Settings of the regularisation; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass

from agents.configuration.checks import at_least, one_of, positive
from agents.post_training.hold import held_ratio
from scene_envs.errors import InvalidInputError

OBJECTIVES = ("pretraining", "discriminative")
"""Losses of the regularisation."""


@dataclass
class RegularisationSettings:
    """Settings of the regularisation: pretraining loss on real scenes.

    Attributes:
        objective: ``pretraining`` is the pretraining loss on real scenes. ``discriminative`` raises the likelihood of
            real scenes relative to the base prior and lowers that of samples of the base prior.
        weight: coefficient of this loss; null takes the default of the algorithm.
        sharpness: scale of the discriminative loss; with a larger value the prior moves less far from its base.
        base_samples: number of samples of the base prior in the discriminative loss; they are drawn once.
        hold: target that the run holds by adjusting the coefficient: ``guard:1.05`` is the held-out loss as a ratio to
            the base prior's; null keeps the coefficient constant.
        batch_size: real scenes per update.
        scenes: source of the real scenes: ``grammar``, or a dataset folder.
        bank_size: number of real scenes that are drawn from the grammar or read from the dataset, including the
            held-out scenes.
    """

    objective: str = "pretraining"
    weight: float | None = None
    sharpness: float = 20.0
    base_samples: int = 1024
    hold: str | None = None
    batch_size: int = 48
    scenes: str = "grammar"
    bank_size: int = 4096

    def __post_init__(self) -> None:
        at_least(self, 1, "batch_size", "base_samples")
        one_of(self, "objective", OBJECTIVES)
        positive(self, "sharpness")
        if self.weight is not None and not self.weight >= 0:
            raise InvalidInputError(f"regularisation.weight={self.weight} must not be negative")
        if self.target is not None and self.weight == 0:
            raise InvalidInputError(f"hold={self.hold} adjusts regularisation.weight, which is 0; give a weight")

    @property
    def target(self) -> float | None:
        """Ratio of the held-out loss to the base prior's that ``hold`` names."""
        return None if self.hold is None else held_ratio(self.hold)

    @property
    def pretraining_weight(self) -> float:
        """``weight``, or 0 for null; the config of a run has replaced null by the default of the algorithm."""
        return self.weight or 0.0
