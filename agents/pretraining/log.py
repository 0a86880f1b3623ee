"""Rows of a training run: to the log, to a CSV file, and to TensorBoard."""

from __future__ import annotations

import csv
import logging
from pathlib import Path
from typing import Any

from scene_envs.errors import MissingDependencyError

logger = logging.getLogger(__name__)

FIELDS = ("step", "loss", "heldout", "gradient_norm", "learning_rate", "seconds")


class TrainingLog:
    """Writes rows as they come.

    Args:
        directory: where ``log.csv`` and ``tensorboard/`` go.
        tensorboard: whether to write events for TensorBoard.

    Raises:
        MissingDependencyError: TensorBoard is asked for and not installed.
    """

    def __init__(self, directory: Path, tensorboard: bool = False) -> None:
        self.directory = directory
        self._writer: Any = None
        if tensorboard:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise MissingDependencyError(
                    "tensorboard=true needs the package tensorboard; install it with: pip install tensorboard"
                ) from error
            self._writer = SummaryWriter(str(directory / "tensorboard"))  # type: ignore[no-untyped-call]

    def write(self, row: dict[str, float], last_step: int) -> None:
        """One row; the time left is worked out from ``last_step``."""
        step, seconds = int(row["step"]), row["seconds"]
        left = (last_step - step) * seconds / max(1, step)
        logger.info("%s  left %.0f s", "  ".join(f"{key} {value:.6g}" for key, value in row.items()), left)
        path = self.directory / "log.csv"
        fresh = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            if fresh:
                writer.writeheader()
            writer.writerow(row)
        if self._writer is not None:
            for key, value in row.items():
                if key != "step":
                    self._writer.add_scalar(key, value, step)
            self._writer.flush()
