"""Verdicts of feasibility with and without its short cuts: coarse parts, and objects that need no simulation.

    python benchmarks/levels.py [--scenes 1000] [--seed 0] [--types ...]

A third of the scenes of each type is as generated, a third has *precise* noise (2 mm sideways, 0.4 mm in height), and
a third has *rough* noise (10 mm and 2 mm). Each scene is judged three times: as ``feasibility`` does it; with fine
parts of every hollow object; and with every object simulated, with fine parts. The table counts the objects whose
verdict differs.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np
import torch
from feasibility import NOISE, disturbed
from rich.console import Console
from rich.table import Table

from scene_envs.grammars import get_grammar
from scene_envs.physics import FeasibilityResult, feasibility
from scene_envs.physics.motion import Physics, physics_of
from scene_envs.physics.placement import ObjectPairs, Objects
from scene_envs.physics.statics import Rest
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types


def simulated_fine(batch: SceneBatch, *, everything: bool) -> FeasibilityResult:
    """Feasibility with fine parts throughout; with ``everything``, every object is simulated."""
    physics = physics_of(batch.scene_type, "bullet")

    def all_fine(objects: Objects, pairs: ObjectPairs) -> np.ndarray:
        return physics.statics.hollow[objects.category]

    def none_rest(self: Physics, objects: Objects, pairs: ObjectPairs, duration: float) -> Rest:
        return Rest(np.zeros(len(objects), bool), np.zeros(len(objects)), np.zeros(len(objects)))

    real = Physics.rest
    physics.statics.needs_fine = all_fine  # type: ignore[method-assign]
    if everything:
        Physics.rest = none_rest  # type: ignore[method-assign]
    try:
        return feasibility(batch)
    finally:
        del physics.statics.needs_fine
        Physics.rest = real  # type: ignore[method-assign]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--types", nargs="*", default=list_scene_types())
    options = parser.parse_args()
    torch.set_num_threads(1)
    each = -(-options.scenes // (len(NOISE) * len(options.types)))
    columns = ("scene type", "noise", "scenes", "free objects", "feasible", "fine differs", "simulated differs")
    table = Table(*columns, "scenes/s", "scenes/s, all simulated", title="verdicts")
    objects = 0
    total: Counter[str] = Counter()
    who: Counter[str] = Counter()
    for name in options.types:
        clean = get_grammar(name).sample(np.random.default_rng(options.seed), each)
        for noise, scales in NOISE.items():
            batch = disturbed(clean, *scales, torch.Generator().manual_seed(options.seed))
            feasibility(batch[:4])
            start = time.process_time()
            normal = feasibility(batch)
            middle = time.process_time()
            fine = simulated_fine(batch, everything=False)
            last = time.process_time()
            everything = simulated_fine(batch, everything=True)
            spent = middle - start, time.process_time() - last
            counts = {
                "fine": int((normal.feasible != fine.feasible).sum()),
                "simulated": int((normal.feasible != everything.feasible).sum()),
            }
            for scene, slot in torch.nonzero(normal.feasible != everything.feasible).tolist():
                asset = batch.scene_type.assets[int(batch.categories[scene, slot])]
                verdict = "feasible" if normal.feasible[scene, slot] else "not feasible"
                moved = 1e3 * float(everything.displacement[scene, slot])
                turned = 1e3 * float(everything.rotation[scene, slot])
                quick = 1e3 * float(normal.displacement[scene, slot]), 1e3 * float(normal.rotation[scene, slot])
                who[f"{asset} {verdict}"] += 1
                print(
                    f"{name} {noise} scene {scene} slot {slot} {asset}: {verdict}, "
                    f"moves {quick[0]:.2f} mm {quick[1]:.1f} mrad; simulated {moved:.2f} mm {turned:.1f} mrad"
                )
            objects += int(batch.is_free.sum())
            total.update(counts)
            table.add_row(
                name, noise, str(len(batch)), str(int(batch.is_free.sum())), f"{int(normal.counts.sum())}",
                str(counts["fine"]), str(counts["simulated"]), *(f"{len(batch) / seconds:.0f}" for seconds in spent),
            )  # fmt: skip
    console = Console()
    console.print(table)
    console.print(f"{objects} objects: " + ", ".join(f"{k} differs {v} ({v / objects:.2%})" for k, v in total.items()))
    console.print(who.most_common(12))


if __name__ == "__main__":
    main()
