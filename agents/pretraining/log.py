"""Log of a training run: rows of the CSV file and of a logger, and pictures of samples."""

from __future__ import annotations

import csv
import io
import logging
from pathlib import Path

from agents.priors.prior import ScenePrior
from agents.utils.loggers import RunLogger
from scene_envs.errors import MissingDependencyError
from scene_envs.files import write_text

logger = logging.getLogger(__name__)

FIELDS = ("step", "loss", "heldout", "gradient_norm", "learning_rate", "seconds")


class TrainingLog:
    """Log of a run; each row is written at once.

    Args:
        directory: folder of ``log.csv``.
        also: another logger that gets the same rows, see :func:`agents.utils.loggers.make_logger`.
    """

    def __init__(self, directory: Path, also: RunLogger | None = None) -> None:
        self.directory = directory
        self._also = RunLogger() if also is None else also

    def begin(self, step: int) -> None:
        """Keep each row up to ``step`` once; remove rows beyond a checkpoint and, with ``step`` 0, of another run."""
        path = self.directory / "log.csv"
        if not path.exists():
            return
        with path.open(newline="", encoding="utf-8", errors="replace") as file:
            rows = list(csv.DictReader(file))
        # the last row of a killed run may lack some numbers
        whole = [row for row in rows if str(row.get("step") or "").isdigit() and None not in map(row.get, FIELDS)]
        kept = {int(row["step"]): row for row in whole if int(row["step"]) <= step}
        if not kept:
            path.unlink()
            return
        text = io.StringIO()
        writer = csv.DictWriter(text, FIELDS, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(kept[number] for number in sorted(kept))
        write_text(path, text.getvalue())

    def close(self) -> None:
        """Close the other logger."""
        self._also.close()

    def write(self, row: dict[str, float], last_step: int) -> None:
        """Write one row; the time left is estimated from ``last_step``."""
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


def draw_samples(prior: ScenePrior, directory: Path, step: int, seed: int) -> None:
    """Draw a gallery of samples of a prior, ``samples-STEP.png`` in ``directory``; skipped without PyBullet."""
    from scene_envs.render import gallery, render

    batch = prior.sample(8, num_steps=50, seed=seed).to("cpu")
    captions = [f"{int(count)} objects" for count in batch.counts]
    try:
        images = render(batch, width=400, height=300)
    except MissingDependencyError as error:
        logger.warning("no pictures of samples: %s", error)
        return
    gallery(list(images), columns=4, captions=captions).save(directory / f"samples-{step:07d}.png")
