"""Time of every physics function on degenerate scenes: all objects at one point, in pairs, nested, outside, buried.

    python benchmarks/degenerate.py [TYPE ...] [--count 2] [--seed 0]

Scenes are the heaps of ``projection.py --heaps``: all slots of a type taken, by random assets. Printed is the CPU time
of one scene, the slowest of ``--count``, and whether each object has a finite answer.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch
from projection import HEAPS, heap
from rich.console import Console
from rich.table import Table

from rewards import evaluate_reward, make_reward
from scene_envs.physics import equilibrium, feasibility, make_ready, penetration, project, settle
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types

FUNCTIONS: dict[str, Callable[[SceneBatch], object]] = {
    "penetration": penetration,
    "feasibility": feasibility,
    "equilibrium": equilibrium,
    "project": project,
    "settle": settle,
    "make_ready": make_ready,
    "reward": lambda batch: evaluate_reward(make_reward("feasible_objects"), batch),
}


def seconds(function: Callable[[SceneBatch], object], batch: SceneBatch) -> tuple[float, bool]:
    """CPU time of a call, and whether the scene that it gave back, if any, is finite."""
    start = time.process_time()
    result = function(batch)
    spent = time.process_time() - start
    return spent, bool(torch.isfinite(getattr(result, "batch", batch).tensor).all())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("types", nargs="*", metavar="TYPE", help=f"of {', '.join(list_scene_types())}")
    parser.add_argument("--count", type=int, default=2, help="scenes per type and kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one-asset", action="store_true", help="all of the asset with most convex parts")
    options = parser.parse_args()
    torch.set_num_threads(1)
    table = Table(title="slowest scene, CPU s")
    for column in ("scene type", "kind", *FUNCTIONS):
        table.add_column(column)
    for name in options.types or list_scene_types():
        for kind in HEAPS:
            rng = np.random.default_rng(options.seed)
            batches = [heap(name, kind, rng, one_asset=options.one_asset) for _ in range(options.count)]
            cells = []
            for function in FUNCTIONS.values():
                results = [seconds(function, batch) for batch in batches]
                cells.append(
                    f"{max(r[0] for r in results):.2f}" + ("" if all(r[1] for r in results) else " not finite")
                )
            table.add_row(name, kind, *cells)
    Console(width=130).print(table)


if __name__ == "__main__":
    main()
