"""Loggers of a run's figures: a CSV file alone, TensorBoard, or Weights & Biases offline."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scene_envs.errors import MissingDependencyError, unknown_name

LOGGERS = ("csv", "tensorboard", "wandb")
"""Names that :func:`make_logger` takes."""


class RunLogger:
    """Logger of the rows of a run; this base class writes nothing, as every run writes ``log.csv`` itself.

    >>> logger = RunLogger()
    >>> logger.log({"reward": 1.0}, step=1)
    >>> logger.close()
    """

    def log(self, row: Mapping[str, float], step: int) -> None:
        """One row of figures after ``step`` steps or iterations."""

    def close(self) -> None:
        """Write the remaining rows and end the log."""


class TensorBoardRunLogger(RunLogger):
    """Events for TensorBoard, in ``tensorboard/`` of the folder of a run."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        from torchrl.record.loggers import TensorboardLogger

        self._logger: Any = TensorboardLogger(exp_name="tensorboard", log_dir=str(folder))

    def log(self, row: Mapping[str, float], step: int) -> None:
        """One row; events are on disk when it returns."""
        self._logger.log_metrics(dict(row), step=step)
        self._logger.experiment.flush()

    def close(self) -> None:
        """Close the file of events."""
        self._logger.experiment.close()


class WandbRunLogger(RunLogger):
    """A run of Weights & Biases that stays in ``wandb/`` of the folder of a run; ``wandb sync`` sends it."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        from torchrl.record.loggers import WandbLogger

        self._logger: Any = WandbLogger(
            exp_name=Path(folder).resolve().name,
            offline=True,
            save_dir=str(folder),
            project="scene-envs",
            log_env_packages=False,
            mode="offline",
        )

    def log(self, row: Mapping[str, float], step: int) -> None:
        """One row."""
        self._logger.log_metrics(dict(row), step=step)

    def close(self) -> None:
        """Finish the run of Weights & Biases."""
        self._logger.experiment.finish()


def make_logger(name: str, folder: str | os.PathLike[str]) -> RunLogger:
    """The logger ``name``, one of :data:`LOGGERS`, of the run in ``folder``; an UnknownNameError, or a
    MissingDependencyError if its package is not installed.
    """
    if name not in LOGGERS:
        raise unknown_name("logger", name, LOGGERS)
    if name == "csv":
        return RunLogger()
    if importlib.util.find_spec(name) is None:
        raise MissingDependencyError(
            f"logger={name} needs the package {name}, which is not installed: pip install "
            f"'scene-envs[{name}]', or take logger=csv"
        )
    return (TensorBoardRunLogger if name == "tensorboard" else WandbRunLogger)(folder)
