"""The keys of the program that makes tables, and the sizes it knows; imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from agents.configuration.composition import dotted, dotted_values
from agents.pretraining.settings import PretrainConfig
from scene_envs.errors import InvalidInputError, unknown_name


@dataclass(frozen=True)
class Size:
    """Settings that all rows of the tables have in common.

    Attributes:
        iterations: optimiser steps of a row.
        batch_size: scenes per step.
        parameters: number of trained parameters of a row's network, without its text encoder.
        count: samples that are measured.
        num_steps: denoising steps per sample.
        classifier_seeds: splits over which a classifier's accuracy is averaged.
        pretraining: further keys of ``pretrain``.
    """

    iterations: int
    batch_size: int
    parameters: int
    count: int
    num_steps: int = 50
    classifier_seeds: int = 10
    pretraining: Mapping[str, Any] = field(default_factory=dict)


_PAPER = dotted_values(PretrainConfig(recipe="paper"))
_OF_SIZE = ("network.depth", "network.heads", "optimizer.rate.warmup", "optimizer.lr")

SIZES: dict[str, Size] = {
    "tiny": Size(3, 4, 60_000, 6, 2, 1, {"network.depth": 1, "network.heads": 2, "optimizer.rate.warmup": 1}),
    "small": Size(
        600, 64, 700_000, 256, pretraining={"network.depth": 4, "network.heads": 4, "optimizer.rate.warmup": 50}
    ),
    "paper": Size(
        _PAPER["iterations"], _PAPER["batch_size"], 88_300_000, 2000,
        pretraining={**{key: _PAPER[key] for key in _OF_SIZE}, "optimizer.compute.matmul_precision": "high"},
    ),
}  # fmt: skip
"""``tiny`` is for tests, ``small`` for a CPU, ``paper`` has the size of the paper's network and wants a GPU."""

_OWN = "a key of tables itself"
_NOT_OF_PRETRAINING = {
    **dict.fromkeys(("scene", "data", "heldout", "seed", "device", "iterations", "batch_size"), _OWN),
    "output": "each row has its own folder",
    "prior": "rows start from fresh weights",
    "recipe": "it is a set of keys; give those",
}
"""Keys of ``pretrain`` that the user cannot give in ``pretraining``, and the reasons."""

ALL_TABLES = ("unconditional", "conditional", "objective", "rotation", "precision")


@dataclass
class TablesConfig:
    """The tables of the paper, and that of the precision of a prior, from one training run per row.

    Attributes:
        scene: scene type, which must be the type of data.
        data: dataset folder of training scenes with prompts, or grammar for fresh scenes without end.
        heldout: dataset folder of real scenes for comparison; empty takes the last 2 % of data.
        tables: one or several of unconditional, conditional, objective, rotation and precision.
        rows: patterns of the names of rows to train and show, such as [ours, paper*]; empty for all.
        size: tiny (for tests, seconds), small (for a CPU) or paper (88.3 M parameters, for a GPU).
        iterations: optimiser steps of each row; null takes the number of the size.
        batch_size: scenes per step; null takes the number of the size.
        parameters: number of trained parameters of each row's network, reached by its width; null takes the number of
            the size.
        count: number of samples of each prior, and of real scenes for comparison; null takes the number of the size.
        num_steps: denoising steps per sample; null takes the number of the size.
        guidance: weight of classifier-free guidance for the samples with prompts, 0 for none.
        pretraining: further keys of pretrain for every row, such as {optimizer: {lr: 5e-4}}; null for none.
        seed: seed of weights, batches, noise and samples.
        device: torch device.
        workers: physics worker processes; 0 computes physics in this process.
        output: folder for the runs, tables.md, tables.csv and plot.png; the same command resumes there.
    """

    compares_keys: ClassVar[bool] = True
    """Rows of other settings may join those in a folder; the program refuses what does not fit them."""

    scene: str = "dimsum_table"
    data: str = "data/dimsum_table"
    heldout: str = ""
    tables: list[str] = field(default_factory=lambda: list(ALL_TABLES))
    rows: list[str] = field(default_factory=list)
    size: str = "small"
    iterations: int | None = None
    batch_size: int | None = None
    parameters: int | None = None
    count: int | None = None
    num_steps: int | None = None
    guidance: float = 1.0
    pretraining: Any = None
    seed: int = 0
    device: str = "cpu"
    workers: int = 2
    output: str = ""

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise unknown_name("size", self.size, SIZES)
        for name in self.tables:
            if name not in ALL_TABLES:
                raise unknown_name("table", name, ALL_TABLES)
        if not self.tables:
            raise InvalidInputError(f"tables=[] asks for nothing; name some of {', '.join(ALL_TABLES)}")
        if self.pretraining is not None and not isinstance(self.pretraining, Mapping):
            raise InvalidInputError(
                f"pretraining={self.pretraining!r} is no mapping; write it like {{network: {{hidden: 64}}}}"
            )
        taken = [f"{key} ({why})" for key, why in _NOT_OF_PRETRAINING.items() if key in (self.pretraining or {})]
        if taken:
            raise InvalidInputError(f"pretraining cannot set {', '.join(taken)}")
        for name in ("iterations", "batch_size", "parameters", "count", "num_steps"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InvalidInputError(f"{name}={value} must be at least 1, or null for the size's")
        if self.measured < 2:
            raise InvalidInputError(f"count={self.count} is too few to compare scenes; measure at least 2")

    @property
    def preset(self) -> Size:
        """The size, as it is without overrides."""
        return SIZES[self.size]

    @property
    def measured(self) -> int:
        """Samples that are measured."""
        return self.preset.count if self.count is None else self.count

    @property
    def steps(self) -> int:
        """Denoising steps per sample."""
        return self.preset.num_steps if self.num_steps is None else self.num_steps

    @property
    def target_parameters(self) -> int:
        """Number of trained parameters of a row's network."""
        return self.preset.parameters if self.parameters is None else self.parameters

    def common(self) -> dict[str, Any]:
        """Keys of ``pretrain`` that every row has; those that the user gave override the others."""
        preset = self.preset
        iterations = preset.iterations if self.iterations is None else self.iterations
        return {
            "scene": self.scene,
            "data": self.data,
            "heldout": self.heldout,
            "iterations": iterations,
            "batch_size": preset.batch_size if self.batch_size is None else self.batch_size,
            "seed": self.seed,
            "device": self.device,
            "logger.log_every": max(1, iterations // 5),
            "logger.evaluate_every": max(1, iterations // 2),
            "logger.checkpoint_every": max(1, min(250, iterations // 5)),
            **preset.pretraining,
            **dotted(self.pretraining or {}),
        }
