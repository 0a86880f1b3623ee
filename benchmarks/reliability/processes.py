"""Small commands in processes of their own, and what they wrote."""

from __future__ import annotations

import atexit
import hashlib
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

POST = (
    "post-train", "reward=object_count", "num_steps=6", "batch_size=4", "iterations=5", "algorithm.gradient_steps=1",
    "regularisation.batch_size=2", "regularisation.bank_size=12", "guard.scenes=4", "guard.every=2", "slots=6",
    "logger.checkpoint_every=1", "logger.report_scenes=0", "logger.progress=none",
)  # fmt: skip
PRETRAIN = (
    "pretrain", "data=DATA", "iterations=6", "batch_size=4", "network.hidden=16",
    "network.depth=1", "network.heads=2", "logger.checkpoint_every=1", "logger.evaluate_every=3", "logger.log_every=1",
)  # fmt: skip
GENERATE = ("generate", "count=40", "shard_size=10", "workers=0", "verify=false", "progress=false")
RESUMABLE = {"post-train": POST, "pretrain": PRETRAIN, "generate": GENERATE}
RESULTS = {
    "post-train": ("prior/model.safetensors", "log.csv"),
    "pretrain": ("prior/model.safetensors", "log.csv"),
    "generate": ("scenes-00000.parquet", "scenes-00003.parquet", "metadata.json"),
}


def command(*words: str) -> list[str]:
    """The process of a command; ``data=DATA`` stands for a small dataset."""
    filled = [word if word != "data=DATA" else f"data={dataset()}" for word in words]
    return [sys.executable, "-m", "agents.cli", *filled]


@cache
def dataset() -> str:
    """A small dataset, made once."""
    place = tempfile.TemporaryDirectory()
    atexit.register(place.cleanup)
    subprocess.run(command(*GENERATE, f"output={place.name}/data"), check=True, capture_output=True)
    return f"{place.name}/data"


def digests(folder: Path, names: Sequence[str] | dict[str, str]) -> dict[str, str]:
    """Digests of results; of logs without the columns that hold times."""
    found = {}
    for name in names:
        content = (folder / name).read_bytes() if (folder / name).exists() else b"none"
        if name.endswith(".csv"):
            rows = [line.split(",") for line in content.decode().splitlines()]
            keep = [index for index, column in enumerate(rows[0]) if "seconds" not in column] if rows else []
            content = repr([[row[index] for index in keep] for row in rows]).encode()
        found[name] = hashlib.sha256(content).hexdigest()
    return found
