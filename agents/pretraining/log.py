"""Rows of a training run: to the log, to a CSV file, and to a logger."""

from __future__ import annotations

import csv
import logging
from pathlib import Path

from agents.utils.loggers import RunLogger

logger = logging.getLogger(__name__)

FIELDS = ("step", "loss", "heldout", "gradient_norm", "learning_rate", "seconds")


class TrainingLog:
    """Writes rows as they come.

    Args:
        directory: where ``log.csv`` goes.
        also: the logger that gets the same rows, as :func:`agents.utils.loggers.make_logger` makes it.
    """

    def __init__(self, directory: Path, also: RunLogger | None = None) -> None:
        self.directory = directory
        self._also = RunLogger() if also is None else also

    def close(self) -> None:
        """Close the other logger."""
        self._also.close()

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
        self._also.log({key: value for key, value in row.items() if key != "step"}, step)
