"""Seconds of post-training iterations and of pretraining steps, and peak memory of DDPO-SF on the paper's network.

    python benchmarks/training_speed.py [--device auto] [--small] [--repeats 5] [--output FILE]

An iteration samples 256 scenes in 25 steps from `dimsum_table`, scores their number of objects and updates the weights;
its first part, up to the scores, has a row of its own. A pretraining step has 256 scenes and the network of the paper's
recipe without text. The first turn of each row, which compiles and copies, is printed apart from the median of the
others and their spread. Peak memory is the allocator's on a GPU, and of the process on a CPU. To time another checkout,
run `PYTHONPATH=OTHER python benchmarks/training_speed.py`. All of it takes a few minutes on a GPU. `--small` tries the
script on a CPU in seconds, with 8 scenes, 4 steps and a small network.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from agents.post_training import PostTrainConfig
from agents.post_training.trainer import PostTrainer
from agents.pretraining import PretrainConfig
from agents.pretraining.initial_prior import SceneTable, build_prior
from agents.pretraining.trainer import Pretrainer
from agents.priors.prior import ScenePrior
from agents.priors.testing import tiny_prior
from scene_envs.grammars import get_grammar
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch

GIBIBYTE = 2**30
_CARD = "name,clocks.sm,clocks.max.sm,clocks.mem,power.limit,temperature.gpu"
_REAL = 512
"""Real scenes of a run."""


@dataclass(frozen=True)
class Row:
    """Seconds of the first turn, median of the others, and their least and greatest; peak memory in GiB."""

    what: str
    first: float
    median: float
    least: float
    greatest: float
    memory: float


def measured(what: str, turn: Callable[[], object], device: torch.device, repeats: int) -> Row:
    """``turn`` once, and then ``repeats`` times."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    seconds = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        turn()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - begun)
    first, *others = seconds
    peak = (
        torch.cuda.max_memory_allocated(device)
        if device.type == "cuda"
        else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    )
    return Row(what, first, median(others), min(others), max(others), peak / GIBIBYTE)


def post_training(
    algorithm: str, prior: ScenePrior | str, scenes: int, steps: int, device: torch.device, repeats: int, title: str
) -> list[Row]:
    """Sampling with scoring, and a whole iteration."""
    with TemporaryDirectory() as folder:
        config = PostTrainConfig(
            prior=prior if isinstance(prior, str) else "dimsum_table", reward="object_count", algorithm=algorithm,
            batch_size=scenes, num_steps=steps, output=folder, device=str(device), progress="none",
            regularisation={"bank_size": _REAL}, guard={"samples": 0, "scenes": 64},
        )  # fmt: skip
        trainer = PostTrainer(config, prior=None if isinstance(prior, str) else prior)
        try:
            trainer.prepare()
            sampling = measured(f"{title}: sampling", lambda: trainer.learner.rollout(0), device, repeats)
            return [sampling, measured(f"{title}: iteration", trainer.step, device, repeats)]
        finally:
            trainer.close()


def untrained(small: bool) -> tuple[PretrainConfig, ScenePrior, SceneBatch]:
    """The network of the paper's recipe, or a small one of the same form, without text."""
    raw = get_grammar("dimsum_table").sample(np.random.default_rng(0), _REAL)
    network = {"hidden": 32, "depth": 2, "heads": 2} if small else {}
    config = PretrainConfig(
        recipe="paper", network=network, text={"encoder": "none"}, batch_size=8 if small else 256, data="grammar"
    )
    return config, build_prior(config, raw.tensor, Normalizer.fit(raw.tensor)), raw


def pretraining(small: bool, device: torch.device, repeats: int, folder: str) -> Row:
    """Steps of pretraining."""
    config, prior, raw = untrained(small)
    config.output, config.device = folder, str(device)
    scenes = prior.encode(raw)
    trainer = Pretrainer(config, SceneTable(scenes[:-8]), scenes[-8:], prior)
    size = sum(parameter.numel() for parameter in prior.parameters()) / 1e6
    return measured(f"pretraining, {size:.0f} M parameters: step", trainer._update, device, 4 * repeats)


def card(device: torch.device) -> str:
    """The device and its clocks as they are."""
    if device.type != "cuda":
        return f"{device}, {torch.get_num_threads()} threads"
    found = torch.cuda.get_device_name(device)
    if shutil.which("nvidia-smi"):
        query = ["nvidia-smi", f"--query-gpu={_CARD}", "--format=csv,noheader", f"--id={device.index or 0}"]
        found = f"{_CARD}: {subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()}"
    return f"{found}; TF32 in products: {torch.backends.cuda.matmul.allow_tf32}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--small", action="store_true", help="a trial of the script")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--output", type=Path, help="JSON file of the rows")
    options = parser.parse_args()
    there = torch.cuda.is_available()
    device = torch.device(options.device if options.device != "auto" else "cuda" if there else "cpu")
    small, repeats = options.small, options.repeats
    scenes, steps = (8, 4) if small else (256, 25)
    console, begun = Console(), time.perf_counter()
    console.print(f"torch {torch.__version__} on {card(device)}", highlight=False)
    rows: list[Row] = []
    prior: ScenePrior | str = tiny_prior(process="mixed") if small else "dimsum_table"
    for algorithm in ("nft", "ddpo_sf"):
        title = f"{algorithm}, {scenes} scenes x {steps} steps"
        rows += post_training(algorithm, prior, scenes, steps, device, repeats, title)
    with TemporaryDirectory() as folder:
        rows.append(pretraining(small, device, repeats, folder))
    count = 4 if small else 32
    title = f"ddpo_sf, network of pretraining, {count} scenes x {steps} steps"
    rows += post_training("ddpo_sf", untrained(small)[1], count, steps, device, 2, title)
    table = Table("", "first, s", "median, s", "least", "greatest", "peak, GiB", title="Training")
    for row in rows:
        figures = (row.first, row.median, row.least, row.greatest)
        table.add_row(row.what, *(f"{figure:.3f}" for figure in figures), f"{row.memory:.2f}")
    console.print(table)
    console.print(f"{time.perf_counter() - begun:.0f} s in all, on {card(device)}", highlight=False)
    if options.output is not None:
        written: dict[str, Any] = {"device": card(device), "torch": torch.__version__, "rows": [vars(r) for r in rows]}
        options.output.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
