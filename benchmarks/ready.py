"""Ready objects in another simulator: their motion, and the overlaps that are left.

    python benchmarks/ready.py [TYPE ...] [--count 30] [--seed 0] [--noise 0 0.004 0.015] [--simulator MuJoCo]
                               [--duration 2] [--others drop] [--scenes FILE | --ready FILE] [--save FOLDER] [--details]

Scenes come from the grammar of each type. Every free object gets Gaussian noise; ``--noise`` lists its standard
deviations sideways in m, and its height has a fifth of that. The first scene has the first level, the second scene
the second, and so on in turn. `make_ready` projects and settles the scenes, and their export is simulated for
``--duration`` seconds. The table counts the objects that `make_ready` marks ready, those of them that are then more
than 1 mm (object frame) from where they were exported, the largest distance, the ready objects in an overlap deeper
than 0.1 mm by `penetration`, and the deepest overlap. Objects that are not ready are left out of the exported scene.
With `--others keep` they stay in it and are not counted.

`--details` lists objects that moved: their pose, their distance after 0.1 s and at the end, and what they overlap.
`--save` writes the ready objects of each type to FOLDER/TYPE.safetensors. `--ready FILE` simulates such a file again.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from export import SIMULATORS
from feasibility import disturbed
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from scene_envs.export import PlacedObject, export, place
from scene_envs.grammars import get_grammar
from scene_envs.physics import PenetrationResult, PhysicsPool, make_ready, penetration
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import list_scene_types

FORMATS = {"MuJoCo": "mjcf", "Drake": "drake"}
"""Export format that each simulator loads."""
MOVED, DEEP = 1e-3, 1e-4
"""Distance and depth (m) beyond which an object is counted."""
EARLY = 0.1
"""Time (s) of the first distance in the details."""


@dataclass(frozen=True)
class Figures:
    """Figures of ready objects in a simulator.

    Attributes:
        scenes: number of scenes.
        free: number of free objects in them.
        ready: number of ready objects among these.
        moved: (ready,) m, distance of each from where it was exported.
        depth: (ready,) m, deepest overlap of each.
    """

    scenes: int
    free: int
    ready: int
    moved: NDArray[np.float64]
    depth: NDArray[np.float64]

    @classmethod
    def total(cls, all_of: list[Figures]) -> Figures:
        """The figures of several scene types together."""
        return cls(
            sum(figures.scenes for figures in all_of),
            sum(figures.free for figures in all_of),
            sum(figures.ready for figures in all_of),
            np.concatenate([figures.moved for figures in all_of]),
            np.concatenate([figures.depth for figures in all_of]),
        )

    def row(self) -> list[str]:
        """Cells of the table, without the name."""
        moved, deep = int((self.moved > MOVED).sum()), int((self.depth > DEEP).sum())
        share = f"{self.ready / max(self.free, 1):.2%}"
        largest, median = self.moved.max(initial=0.0), np.median(self.moved) if self.ready else 0.0
        distances = [f"{moved} ({moved / max(self.ready, 1):.2%})", f"{1e3 * median:.3f}", f"{1e3 * largest:.2f}"]
        depths = [f"{deep} ({deep / max(self.ready, 1):.2%})", f"{1e3 * self.depth.max(initial=0.0):.3f}"]
        return [str(self.scenes), str(self.free), f"{self.ready} ({share})", *distances, *depths]


def sampled(name: str, count: int, levels: list[float], seed: int) -> SceneBatch:
    """Scenes of a grammar; scene i has the noise ``levels[i % len(levels)]``."""
    clean = get_grammar(name).sample(np.random.default_rng(seed), count)
    scale = torch.tensor(levels)[torch.arange(count) % len(levels)][:, None, None]
    noise = disturbed(clean, 1.0, 0.2, torch.Generator().manual_seed(seed)).translations - clean.translations
    return clean.with_poses(clean.translations + scale * noise, clean.rotations)


def without(batch: SceneBatch, dropped: torch.Tensor) -> SceneBatch:
    """The scenes with the slots ``dropped`` (B, N) empty."""
    categories = batch.categories.masked_fill(dropped, batch.scene_type.num_assets)
    return SceneBatch.from_parts(batch.translations, batch.rotations, categories, batch.scene_type)


def measure(
    batch: SceneBatch, ready: torch.Tensor, free: int, options: argparse.Namespace, pool: PhysicsPool
) -> tuple[Figures, list[str]]:
    """Simulate the scenes; returns figures of the ``ready`` objects (B, N), and a line for each of them that moved."""
    overlaps = penetration(batch, pool=pool)
    simulate = SIMULATORS[options.simulator][1]
    moved, lines = torch.zeros(ready.shape, dtype=torch.float64), []
    with tempfile.TemporaryDirectory() as folder:
        export(batch, folder, FORMATS[options.simulator])
        for scene in place(batch):
            counted = [thing for thing in scene.objects if ready[scene.index, thing.slot]]
            _, after = simulate(Path(folder), scene, options.duration)
            for thing in counted:
                moved[scene.index, thing.slot] = float(np.linalg.norm(after[thing.name] - thing.translation))
            far = [thing for thing in counted if not moved[scene.index, thing.slot] <= MOVED]
            if far and options.details:
                _, early = simulate(Path(folder), scene, EARLY)
                names = {thing.slot: thing.name for thing in scene.objects}
                lines += [
                    describe(thing, scene.index, early[thing.name], after[thing.name], overlaps, names) for thing in far
                ]
    moved = moved.nan_to_num(nan=torch.inf)
    figures = Figures(len(batch), free, int(ready.sum()), moved[ready].numpy(), overlaps.depth[ready].double().numpy())
    return figures, lines


def describe(
    thing: PlacedObject,
    scene: int,
    early: NDArray[np.float64],
    after: NDArray[np.float64],
    overlaps: PenetrationResult,
    names: dict[int, str],
) -> str:
    """One object that moved: where it was, how far it got, and what it overlaps."""
    near, far = (1e3 * float(np.linalg.norm(place - thing.translation)) for place in (early, after))
    with np.printoptions(precision=5, suppress=True):
        pose = f"at {thing.translation} m, quaternion (w, x, y, z) {thing.quaternion}, went {after - thing.translation}"
    partners = [
        f"{names[next(slot for slot in pair.slots if slot != thing.slot)]} {1e3 * pair.depth:.3f} mm"
        for pair in overlaps.pairs[scene]
        if thing.slot in pair.slots
    ]
    return (
        f"scene {scene} slot {thing.slot} {thing.name} ({thing.asset.name}): {near:.2f} mm after {EARLY} s, "
        f"{far:.2f} mm at the end; {pose}; overlaps {', '.join(partners) or 'nothing'}"
    )


def sources(options: argparse.Namespace, pool: PhysicsPool) -> Iterator[tuple[SceneBatch, torch.Tensor, int]]:
    """Per scene type or file: scenes to export, which of their objects are ready (B, N), and how many were free."""
    if options.ready:
        batch = SceneBatch.load(options.ready)
        yield batch, batch.is_free, int(batch.is_free.sum())
        return
    given = [SceneBatch.load(options.scenes)[: options.count]] if options.scenes else None
    for batch in given or (sampled(name, options.count, options.noise, options.seed) for name in options.types):
        result = make_ready(batch, pool=pool)
        free = int(batch.is_free.sum())
        promised = without(result.batch, result.batch.is_free & ~result.ready)
        if options.save:
            promised.save(Path(options.save) / f"{batch.scene_type.name}.safetensors")
        yield result.batch if options.others == "keep" else promised, result.ready, free


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("types", nargs="*", metavar="TYPE", help=f"scene types, of {', '.join(list_scene_types())}")
    parser.add_argument("--count", type=int, default=30, help="scenes per type")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.004, 0.015], help="m sideways")
    parser.add_argument("--simulator", choices=list(FORMATS), default="MuJoCo")
    parser.add_argument("--duration", type=float, default=2.0, help="s")
    parser.add_argument("--others", choices=["drop", "keep"], default="drop", help="what becomes of objects not ready")
    parser.add_argument("--scenes", help="make the first scenes of this file ready")
    parser.add_argument("--ready", help="simulate this file as it is; all its free objects count")
    parser.add_argument("--save", help="folder for the ready objects, one file per type")
    parser.add_argument("--details", action="store_true")
    options = parser.parse_args()
    options.types = options.types or list_scene_types()
    torch.set_num_threads(1)
    title = f"ready objects after {options.duration:g} s in {options.simulator}, others {options.others}"
    columns = ("scenes", "free", "ready", "moved > 1 mm", "median (mm)", "largest (mm)", "overlap > 0.1 mm")
    table = Table("scene type", *columns, "deepest (mm)", "s", title=title)
    console, found = Console(width=150, soft_wrap=True), []
    with PhysicsPool(workers=1) as pool:
        start = time.perf_counter()
        for batch, ready, free in sources(options, pool):
            figures, lines = measure(batch, ready, free, options, pool)
            now = time.perf_counter()
            table.add_row(batch.scene_type.name, *figures.row(), f"{now - start:.0f}")
            found.append(figures)
            for line in lines:
                print(f"{batch.scene_type.name} {line}", flush=True)
            start = now
    if len(found) > 1:
        table.add_section()
        table.add_row("all", *Figures.total(found).row(), "")
    console.print(table)


if __name__ == "__main__":
    main()
