"""Scenes per second of feasibility, projection and settling, per core, at about 20 and 60 objects.

    python benchmarks/feasibility.py [--count 48] [--seed 0] [--physics auto]

The 20-object scenes are Dimsum Tables of 18 to 22 objects. The 60-object scenes are three such tables side by side,
welded in one scene. *At rest* scenes are as generated. *Precise* and *rough* scenes have Gaussian noise on every free
object, as samples of a good and of a poor prior have: 0.4 mm in height and 2 mm sideways, or 2 mm and 10 mm. Rates
are per CPU second of one thread, which a busy machine changes little. Geometry and bodies are built before the clock
starts. Projection is timed scene by scene on the rough scenes. Settling (1.5 s) is timed on the projected scenes.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from scene_envs.grammars import get_grammar
from scene_envs.physics import feasibility, project, settle
from scene_envs.physics.engines import engine_name
from scene_envs.physics.motion import physics_of
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import FixedObject, SceneType, get_scene_type, register_scene_type

NOISE = {"at rest": (0.0, 0.0), "precise": (0.002, 0.0004), "rough": (0.010, 0.002)}
"""Standard deviations (m) sideways and in height."""
SPACING = 1.4
"""Distance (m) between tables."""


def single_tables(count: int, rng: np.random.Generator) -> SceneBatch:
    """Dimsum Tables of 18 to 22 objects."""
    kept: list[SceneBatch] = []
    while sum(len(batch) for batch in kept) < count:
        batch = get_grammar("dimsum_table").sample(rng, 32)
        kept.append(batch[torch.nonzero((batch.counts >= 18) & (batch.counts <= 22)).flatten()])
    return SceneBatch.concatenate(kept)[:count]


def three_tables(batch: SceneBatch) -> SceneBatch:
    """Scenes of three consecutive tables of ``batch``, 1.4 m apart."""
    base = batch.scene_type
    shifts = (-SPACING, 0.0, SPACING)
    (x0, y0, z0), (x1, y1, z1) = base.workspace
    wide = register_scene_type(
        SceneType(
            name="three_dimsum_tables",
            assets=base.assets,
            slots=3 * base.slots,
            workspace=((x0 - SPACING, y0, z0), (x1 + SPACING, y1, z1)),
            welded=base.welded,
            fixed=tuple(FixedObject("cafe_table", (shift, 0.0, 0.0)) for shift in shifts),
            camera=base.camera,
        )
    )
    groups = batch.tensor[: 3 * (len(batch) // 3)].clone().unflatten(0, (-1, 3))  # (G, 3, N, D)
    present = groups[..., -1] == 0
    groups[..., 0] += torch.tensor(shifts)[None, :, None] * present
    tables, others = groups[:, :, :1], groups[:, :, 1:]
    return SceneBatch(torch.cat([tables.flatten(1, 2), others.flatten(1, 2)], dim=1), wide)


def disturbed(batch: SceneBatch, sideways: float, height: float, generator: torch.Generator) -> SceneBatch:
    """Gaussian noise on the translations of free objects."""
    scale = torch.tensor([sideways, sideways, height])
    noise = torch.randn(batch.translations.shape, generator=generator) * scale * batch.is_free.unsqueeze(-1)
    return batch.with_poses(batch.translations + noise, batch.rotations)


def forget(batch: SceneBatch, physics: str) -> None:
    """Drop the simulations that this process remembers of scenes of this type, so that scenes are simulated again."""
    physics_of(batch.scene_type, engine_name(physics))._known.clear()


def measure(title: str, batch: SceneBatch, seed: int, physics: str, console: Console) -> None:
    """Print one table for one size of scene."""
    generator = torch.Generator().manual_seed(seed)
    objects = float(batch.counts.float().mean())
    table = Table("what", "scenes/s per core", "outcome", title=f"{title}: {objects:.1f} objects, {len(batch)} scenes")
    scenes = {name: disturbed(batch, *noise, generator) for name, noise in NOISE.items()}
    for name, noisy in scenes.items():
        feasibility(noisy, physics=physics)  # builds what is needed
        forget(noisy, physics)
        start = time.process_time()
        result = feasibility(noisy, physics=physics)
        rate = len(batch) / (time.process_time() - start)
        share = float(result.counts.sum() / noisy.is_free.sum())
        table.add_row(f"feasibility, {name}", f"{rate:.0f}", f"{share:.1%} of objects feasible")
    spent, converged, projected = [], [], []
    for index in range(len(batch)):
        start = time.process_time()
        result_one = project(scenes["rough"][index], physics=physics)
        spent.append(time.process_time() - start)
        converged.append(bool(result_one.converged[0]))
        projected.append(result_one.batch)
    outcome = f"median {1e3 * np.median(spent):.0f} ms, {np.mean(converged):.1%} free of overlap"
    table.add_row("projection, rough", f"{1.0 / np.mean(spent):.1f}", outcome)
    start = time.process_time()
    settled = settle(SceneBatch.concatenate(projected), duration=1.5, physics=physics)
    rate = len(batch) / (time.process_time() - start)
    ready = feasibility(settled.batch, physics=physics)
    share = float(ready.feasible.sum() / settled.batch.is_free.sum())
    table.add_row("settling, after projection", f"{rate:.1f}", f"{share:.1%} of objects ready")
    console.print(table)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=48, help="20-object scenes; a third as many with 60 objects")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--physics", default="auto", help="engine")
    options = parser.parse_args()
    torch.set_num_threads(1)
    get_scene_type("dimsum_table")
    batch = single_tables(options.count, np.random.default_rng(options.seed))
    console = Console()
    measure("one table", batch, options.seed, options.physics, console)
    measure("three tables", three_tables(batch), options.seed, options.physics, console)


if __name__ == "__main__":
    main()
