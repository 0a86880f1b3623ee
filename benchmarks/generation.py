"""Scenes per second of generation on one core: the grammar alone, the physics check, and both with the writing.

    python benchmarks/generation.py [--scene dimsum_table pantry_shelf …] [--count 200] [--seed 0]

Rates are per CPU second of one thread, which a busy machine disturbs little. Every stage gets scenes that it has not
seen. Geometry and the simulator's bodies are built before the clock starts, and the normalizer is fitted before it, as
both happen once per dataset. The file is written, read back and streamed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from scene_envs.datasets import SceneDataset, describe_all, generate, judge_scenes
from scene_envs.datasets.generation import fixed_normalizer
from scene_envs.grammars import get_grammar


def rate(count: int, run: Callable[[], object]) -> float:
    """``count`` over the CPU seconds that ``run`` takes."""
    start = time.process_time()
    run()
    return count / (time.process_time() - start)


def prepared(scene: str, folder: Path, count: int) -> None:
    """A dataset folder with its metadata but no shard, so that the normalizer is not timed."""
    generate(scene, count, folder, workers=0, shard_size=count, progress=False, verify=False)
    (folder / "scenes-00000.parquet").unlink()
    metadata = folder / "metadata.json"
    metadata.write_text(metadata.read_text().replace('"verified": false', '"verified": true'))


def measure(scene: str, count: int, seed: int, console: Console) -> None:
    """Print the rates of one scene type."""
    grammar, rng = get_grammar(scene), np.random.default_rng(seed)
    judge_scenes(grammar.sample(rng, 4))
    batch = grammar.sample(rng, count)
    table = Table("stage", "scenes/s per core", title=f"{scene}, {count} scenes")
    table.add_row("grammar", f"{rate(count, lambda: grammar.sample_array(rng, count)):.0f}")
    table.add_row("three prompts", f"{rate(count, lambda: describe_all(batch, rng)):.0f}")
    table.add_row("verification", f"{rate(count, lambda: judge_scenes(batch)):.1f}")
    start = time.process_time()
    fixed_normalizer(grammar)
    normalizer_seconds = time.process_time() - start
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent)
        prepared(scene, folder, count)
        run = rate(count, lambda: generate(scene, count, folder, workers=0, shard_size=count, progress=False))
        table.add_row("all, to parquet", f"{run:.1f}")
        table.add_row("reading", f"{rate(count, lambda: SceneDataset.load(folder)):.0f}")
        size = (folder / "scenes-00000.parquet").stat().st_size / count
    console.print(table)
    console.print(f"normalizer, once per dataset: {normalizer_seconds:.1f} s; {size / 1000:.2f} kB per scene on disk")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=["dimsum_table"])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    for scene in options.scene:
        measure(scene, options.count, options.seed, Console())


if __name__ == "__main__":
    main()
