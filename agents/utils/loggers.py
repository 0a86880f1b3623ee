"""Loggers of a run's figures: a CSV file alone, TensorBoard, or Weights & Biases offline."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scene_envs.errors import MissingDependencyError

LOGGERS = ("csv", "tensorboard", "wandb")
"""Names of loggers."""


class RunLogger:
    """Logger of the rows of the run in ``folder``, beside ``log.csv``, which every run writes itself: ``csv`` adds
    nothing, ``tensorboard`` writes events to ``tensorboard/``, and ``wandb`` a run of Weights & Biases to ``wandb/``,
    which ``wandb sync`` sends. A MissingDependencyError without the package.

    >>> logger = RunLogger("csv", "runs/mine")
    >>> logger.log({"reward": 1.0}, step=1)
    >>> logger.close()
    """

    def __init__(self, name: str, folder: str | os.PathLike[str]) -> None:
        self._logger: Any = None
        if name == "csv":
            return
        if importlib.util.find_spec(name) is None:
            raise MissingDependencyError(
                f"logger={name} needs the package {name}, which is not installed: pip install "
                f"'scene-envs[{name}]', or take logger=csv"
            )
        from torchrl.record import loggers

        if name == "tensorboard":
            self._logger = loggers.TensorboardLogger(exp_name="tensorboard", log_dir=str(folder))
        else:
            self._logger = loggers.WandbLogger(
                exp_name=Path(folder).resolve().name,
                offline=True,
                save_dir=str(folder),
                project="scene-envs",
                log_env_packages=False,
                mode="offline",
            )

    def log(self, row: Mapping[str, float], step: int) -> None:
        """One row of figures after ``step`` steps or iterations; events of TensorBoard are on disk when it returns."""
        if self._logger is not None:
            self._logger.log_metrics(dict(row), step=step)
            getattr(self._logger.experiment, "flush", lambda: None)()

    def close(self) -> None:
        """Write the remaining rows and end the log."""
        if self._logger is not None:
            run = self._logger.experiment
            (run.finish if hasattr(run, "finish") else run.close)()
