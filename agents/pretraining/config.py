"""Configuration of one pretraining run; imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.configuration.checks import at_least
from agents.configuration.fields import composed, named, nested
from agents.configuration.shared_keys import TrainingKeys
from agents.pretraining.settings import (
    LossSettings,
    NetworkSettings,
    PretrainLoggerSettings,
    PretrainOptimizerSettings,
    ProcessSettings,
    TextSettings,
    registered_networks,
)


@dataclass
class SceneKeys:
    """Scenes to train on.

    :class:`PretrainConfig` describes the keys.
    """

    scene: Any = named("dimsum_table", "scene")
    data: str = "data/dimsum_table"
    heldout: str = ""


@composed
@dataclass
class PretrainConfig(SceneKeys, TrainingKeys):
    """One pretraining run.

    Keys that are not listed are those of :class:`~agents.configuration.TrainingKeys`.

    Attributes:
        scene: scene type. This key is ignored with ``prior=`` and with several datasets, which define the union of
            their scene types.
        data: dataset folder of training scenes. Several folders, joined by commas, train one prior on all their scene
            types with equal probability; ``grammar`` draws fresh scenes from the grammar without end.
        heldout: dataset folder of held-out scenes. Empty takes the last 2 % of ``data``, or 512 scenes of the grammar.
            It must be empty if there are several datasets.
        prior: prior from which training starts: a shipped name, or the folder of a prior or a run. Its scene type,
            network, process and text encoder stay as they are. Empty for a fresh prior.
        output: run folder; a run that was interrupted there is resumed; empty for runs/COMMAND-TIME on the command
            line, runs/pretrain in Python.
        iterations: optimiser steps.
        batch_size: scenes per step, over all processes and parts.
        seed: seed of weights, batches and noise.
        recipe: a named set of values for the other keys: ``ours``, or ``paper`` for the paper's setting. Keys that are
            given as well override it.
        network: the denoiser network.
        process: the diffusion process.
        loss: the training loss.
        text: the text encoder.
        optimizer: the optimiser of the weights.
        logger: log files.
    """

    prior: str = ""
    iterations: int = 5000
    batch_size: int = 128
    seed: int = 0
    network: NetworkSettings = nested(NetworkSettings, folder="network", option="flux", registered=registered_networks)
    process: ProcessSettings = nested(ProcessSettings, folder="process", option="mixed")
    loss: LossSettings = nested(LossSettings)
    text: TextSettings = nested(TextSettings, folder="text", option="none")
    optimizer: PretrainOptimizerSettings = nested(PretrainOptimizerSettings, folder="optimizer", option="muon")
    logger: PretrainLoggerSettings = nested(PretrainLoggerSettings, folder="logger", option="csv")

    def __post_init__(self) -> None:
        at_least(self, 1, "batch_size")
        at_least(self, 0, "iterations")

    @property
    def directory(self) -> Path:
        """The run directory."""
        return Path(self.output or "runs/pretrain")
