"""Groups of keys that pretraining and post-training share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from agents.configuration.checks import at_least, one_of, positive
from agents.utils.loggers import LOGGERS
from scene_envs.errors import InvalidInputError


@dataclass
class OptimizerSettings:
    """An optimiser of weights.

    Attributes:
        name: name of the optimiser: ``adamw``.
        lr: peak learning rate.
        warmup: steps over which the learning rate rises linearly.
        weight_decay: decoupled weight decay.
        clip: largest norm of a gradient; longer gradients are scaled down.
        ema: decay of the averaged weights, which are evaluated and saved; 0 uses the weights themselves.
    """

    KNOWN: ClassVar[Sequence[str]] = ("adamw",)
    """Optimisers by name."""

    name: str = "adamw"
    lr: float = 1e-3
    warmup: int = 0
    weight_decay: float = 0.0
    clip: float = 1.0
    ema: float = 0.0

    def __post_init__(self) -> None:
        one_of(self, "name", self.KNOWN, "optimizer")
        positive(self, "lr", "clip")
        at_least(self, 0, "warmup", "weight_decay")
        if not 0 <= self.ema < 1:
            raise InvalidInputError(f"ema={self.ema} must lie in [0, 1)")


@dataclass
class LoggerSettings:
    """Files of a run, and how often they are written.

    Attributes:
        name: ``csv`` writes log.csv, which every run has; ``tensorboard`` and ``wandb`` (offline) write their own files
            as well.
        checkpoint_every: steps or iterations between resumable checkpoints.
    """

    name: str = "csv"
    checkpoint_every: int = 10

    def __post_init__(self) -> None:
        one_of(self, "name", LOGGERS, "logger")
        at_least(self, 1, "checkpoint_every")
