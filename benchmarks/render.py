"""Seconds per image of semantic renders and pictures, and the size of a viewer, per scene type.

    python benchmarks/render.py [--count 8] [--seed 0]

Scenes come from the grammars. Times are CPU seconds of one thread, which a busy machine disturbs little; bodies are
made before the clock starts. Semantic renders are 640 x 480, pictures 480 x 360; the viewer holds 16 scenes.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from scene_envs.grammars import get_grammar
from scene_envs.render import render, write_viewer
from scene_envs.scene_types import list_scene_types


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    table = Table("scene type", "objects", "semantic (ms)", "picture (ms)", "viewer (MB)")
    for name in list_scene_types():
        scenes = get_grammar(name).sample(np.random.default_rng(options.seed), max(16, options.count))
        batch = scenes[: options.count]
        render(batch, style="semantic", width=32, height=24)  # makes the bodies
        cells = [name, f"{batch.counts.double().mean():.0f}"]
        for style in ("semantic", "picture"):
            start = time.process_time()
            render(batch, style=style)  # type: ignore[arg-type]
            cells.append(f"{1e3 * (time.process_time() - start) / len(batch):.0f}")
        with tempfile.TemporaryDirectory() as folder:
            size = write_viewer(scenes[:16], Path(folder) / "viewer.html").stat().st_size
        table.add_row(*cells, f"{size / 1e6:.2f}")
    Console().print(table)


if __name__ == "__main__":
    main()
