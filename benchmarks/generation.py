"""Scenes per second of generation on one core: the grammar alone, the physics check, and both with the writing.

    python benchmarks/generation.py [--scene dimsum_table] [--count 200] [--seed 0]

Rates are per CPU second of one thread, which a busy machine disturbs little. Geometry and the simulator's bodies are
built before the clock starts.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from collections.abc import Callable

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from scene_envs.datasets import describe, generate, verify_scenes
from scene_envs.grammars import get_grammar


def rate(count: int, run: Callable[[], object]) -> float:
    """``count`` over the CPU seconds that ``run`` takes."""
    start = time.process_time()
    run()
    return count / (time.process_time() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="dimsum_table")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    grammar, rng, count = get_grammar(options.scene), np.random.default_rng(options.seed), options.count
    batch = grammar.sample(rng, count)
    reasons: Counter[str] = Counter()
    verify_scenes(batch, Counter())
    table = Table("stage", "scenes/s per core", title=f"{options.scene}, {count} scenes")
    table.add_row("grammar", f"{rate(count, lambda: grammar.sample_array(rng, count)):.0f}")
    table.add_row("prompts", f"{rate(count, lambda: describe(batch, rng)):.0f}")
    table.add_row("verification", f"{rate(count, lambda: verify_scenes(batch, reasons)):.1f}")
    with tempfile.TemporaryDirectory() as folder:
        run = rate(count, lambda: generate(options.scene, count, folder, workers=0, shard_size=count, progress=False))
    table.add_row("all, to parquet", f"{run:.1f}")
    console = Console()
    console.print(table)
    console.print(f"thrown away by the verification: {dict(+reasons) or 'nothing'}")


if __name__ == "__main__":
    main()
