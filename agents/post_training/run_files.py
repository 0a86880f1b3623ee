"""Files of a run: configuration, log and metrics, each written atomically."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from agents.configuration.tree import config_text, dotted
from agents.post_training.config import RESUMABLE, PostTrainConfig
from agents.utils.checkpoints import load_checkpoint
from scene_envs import files
from scene_envs.errors import InvalidInputError, TrainingError

CHECKPOINT_NAME = "checkpoint.pt"
LOG_NAME = "log.csv"
METRICS_NAME = "metrics.json"
SCENES_NAME = "real_scenes.safetensors"
BASE_SAMPLES_NAME = "base_samples.safetensors"


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` atomically.

    Raises:
        TrainingError: the file could not be written; a file that was there before is unchanged.
    """
    writing(repr(str(path)), lambda: files.write_text(path, text))


def writing(what: str, write: Callable[[], object]) -> None:
    """Run ``write``; an OSError or RuntimeError of it becomes a TrainingError that names ``what``."""
    try:
        write()
    except (OSError, RuntimeError) as error:
        raise TrainingError(f"could not write {what} ({error}); free some space and run the same again") from error


def write_config(directory: Path, config: PostTrainConfig) -> None:
    """Write ``config.yaml`` with every field of ``config``."""
    write_text(directory / "config.yaml", files.sealed(config_text(config.plain())))


def run_metrics(
    history: Sequence[Mapping[str, float]],
    batch_size: int,
    seconds: float,
    best_reward: float,
    guard: Mapping[str, Any],
) -> dict[str, Any]:
    """Content of ``metrics.json`` for a run with the log ``history``."""
    rewards = [row["reward"] for row in history if math.isfinite(row["reward"])]
    return {
        "iterations": len(history),
        "seconds": round(seconds, 1),
        "reward": {
            "first": rewards[0] if rewards else None,
            "last": rewards[-1] if rewards else None,
            "best": best_reward,
            "invalid_scenes": round(sum((1.0 - row["valid_fraction"]) * batch_size for row in history)),
        },
        "guard": dict(guard),
    }


def write_metrics(directory: Path, metrics: Mapping[str, Any]) -> None:
    """Write ``metrics.json``; numbers that JSON lacks become null."""
    path = directory / METRICS_NAME
    writing(repr(str(path)), lambda: files.write_json(path, metrics))


def write_log(directory: Path, history: Sequence[Mapping[str, float]]) -> None:
    """Write ``log.csv``: one row per iteration, with the union of the columns of all rows."""
    columns = list(dict.fromkeys(name for row in history for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(history)
    write_text(directory / LOG_NAME, text.getvalue())


def load_resumable(directory: Path, config: PostTrainConfig) -> dict[str, Any] | None:
    """The checkpoint of an interrupted run of the same configuration, or None when there is none.

    Raises:
        CorruptFileError: the checkpoint is truncated.
        InvalidInputError: the directory holds a run of another configuration.
    """
    path = directory / CHECKPOINT_NAME
    if not path.exists():
        return None
    state = load_checkpoint(path)
    before, now = _flat(state.get("config", {})), _flat(config.plain())
    changed = [
        name for name in now if name.partition(".")[0] not in RESUMABLE and before.get(name, now[name]) != now[name]
    ]
    if changed:
        differences = "; ".join(f"{name} was {before[name]!r}, is {now[name]!r}" for name in changed)
        raise InvalidInputError(
            f"{str(directory)!r} holds a run with another configuration ({differences}); "
            "give another output, or the same settings to resume it"
        )
    return state


def _flat(config: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration with nested keys joined by dots; the reward stays one value, even if it is a mapping."""
    return {**dotted({**config, "reward": None}), "reward": config.get("reward")}
