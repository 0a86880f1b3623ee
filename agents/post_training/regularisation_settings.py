"""Settings of the regularisation and of adapters; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass

from agents.configuration import require_at_least, require_one_of, require_positive
from agents.post_training.hold import Target
from scene_envs.errors import InvalidInputError

OBJECTIVES = ("pretraining", "discriminative")
"""Losses of the regularisation."""
REAL_SCENES = 48
"""Real scenes per update where neither the settings nor the algorithm name another number."""


@dataclass
class RegularisationSettings:
    """Settings of the regularisation: pretraining loss on real scenes, and KL divergence from the base prior.

    Attributes:
        objective: ``pretraining`` is the pretraining loss on real scenes. ``discriminative`` raises the likelihood of
            real scenes relative to the base prior and lowers that of samples of the base prior.
        weight: coefficient of this loss; null takes the default of the algorithm.
        sharpness: scale of the discriminative loss; with a larger value the prior moves less far from its base.
        base_samples: number of samples of the base prior in the discriminative loss; they are drawn once.
        kl: coefficient of the KL divergence from the base prior, measured on own samples, in nats per random variable
            of a scene; null for none, or 1 with ``hold=kl:VALUE``.
        hold: target that the run holds by adjusting both coefficients. ``guard:1.05`` is the held-out loss as a ratio
            to the base prior's, ``kl:0.01`` the KL divergence; null keeps the coefficients constant.
        batch_size: real scenes per update; null takes 48, or the run's ``batch_size`` with ``algorithm=neon``.
        scenes: source of the real scenes: ``grammar``, or a dataset folder.
        bank_size: number of real scenes that are drawn from the grammar or read from the dataset, including the
            held-out scenes.
        replay: further scenes for the pretraining loss, such as the winners of a search: the folder of a run, a scene
            file or a dataset; null for none.
        replay_share: share of replayed scenes in each batch of the pretraining loss, if there is a replay.
    """

    objective: str = "pretraining"
    weight: float | None = None
    sharpness: float = 20.0
    base_samples: int = 1024
    kl: float | None = None
    hold: str | None = None
    batch_size: int | None = None
    scenes: str = "grammar"
    bank_size: int = 4096
    replay: str | None = None
    replay_share: float = 0.5

    def __post_init__(self) -> None:
        require_at_least(self, 1, "batch_size", "base_samples")
        require_one_of(self, "objective", OBJECTIVES)
        require_positive(self, "sharpness")
        if not 0 < self.replay_share <= 1:
            raise InvalidInputError(f"regularisation.replay_share={self.replay_share} must be in (0, 1]")
        if self.weight is not None and not self.weight >= 0:
            raise InvalidInputError(f"regularisation.weight={self.weight} must not be negative")
        if self.kl is not None and not self.kl >= 0:
            raise InvalidInputError(f"regularisation.kl={self.kl} must not be negative")
        if self.target is not None and self.weight == 0 and not self.kl_weight:
            raise InvalidInputError(
                f"hold={self.hold} adjusts regularisation.weight and regularisation.kl, and both are 0; give one"
            )

    @property
    def real_scenes(self) -> int:
        """``batch_size``, or its default for null; the config of a run has replaced null."""
        return REAL_SCENES if self.batch_size is None else self.batch_size

    @property
    def target(self) -> Target | None:
        """Target that ``hold`` names."""
        return None if self.hold is None else Target.parse(self.hold)

    @property
    def pretraining_weight(self) -> float:
        """``weight``, or 0 for null; the config of a run has replaced null by the default of the algorithm."""
        return self.weight or 0.0

    @property
    def kl_weight(self) -> float:
        """``kl``; null stands for 1 with ``hold=kl:VALUE``, and for 0 otherwise."""
        if self.kl is None:
            return float(self.target is not None and self.target.figure == "kl")
        return self.kl


@dataclass
class AdapterSettings:
    """Low-rank updates of the attention and MLP matrices, which are trained in place of all weights.

    Attributes:
        rank: rank of the updates; 0 trains all weights.
        alpha: scale of the updates, times the rank: they are multiplied by alpha / rank.
    """

    rank: int = 0
    alpha: float = 16.0

    def __post_init__(self) -> None:
        require_at_least(self, 0, "rank")
        require_positive(self, "alpha")

    @property
    def scale(self) -> float:
        """Scale of the updates, alpha / rank."""
        return self.alpha / self.rank
