"""CPU time of physics over the number of objects, at constant density, and its plot.

    python benchmarks/growth.py [--largest 512] [--noise 0.002] [--physics auto] [--save benchmarks/growth.csv]

Dim sum tables of about twenty objects stand side by side, welded, in one scene; every free object is moved by Gaussian
noise, a fifth of it in height. Each line is the time of one scene of one process, with what is built once
built before. An exponent is the slope of log time over log number: 1 is linear growth.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from scene_envs.grammars import get_grammar
from scene_envs.physics import feasibility, make_ready, penetration, project
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import FixedObject, SceneType, register_scene_type

SPACING = 1.4
"""Distance (m) between tables."""
CALLS: dict[str, Callable[..., Any]] = {
    "penetration": penetration,
    "feasibility": feasibility,
    "project": project,
    "make_ready": make_ready,
}


def tables(count: int, rng: np.random.Generator) -> SceneBatch:
    """One scene of ``count`` tables in rows of five."""
    batch = get_grammar("dimsum_table").sample(rng, count)
    base = batch.scene_type
    shifts = torch.tensor([((index % 5) * SPACING, (index // 5) * SPACING) for index in range(count)])
    (x0, y0, z0), (x1, y1, z1) = base.workspace
    far = shifts.max(dim=0).values.tolist()
    kind = register_scene_type(
        SceneType(
            name=f"{count}_dimsum_tables",
            assets=base.assets,
            slots=count * base.slots,
            workspace=((x0, y0, z0), (x1 + far[0], y1 + far[1], z1)),
            welded=base.welded,
            fixed=tuple(FixedObject("cafe_table", (*shift, 0.0)) for shift in shifts.tolist()),
            camera=base.camera,
        )
    )
    rows = batch.tensor.clone()
    rows[..., :2] += shifts[:, None] * (rows[..., -1:] == 0)
    return SceneBatch(torch.cat([rows[:, :1].flatten(0, 1), rows[:, 1:].flatten(0, 1)])[None], kind)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--largest", type=int, default=512)
    parser.add_argument("--noise", type=float, default=0.002)
    parser.add_argument("--physics", default="auto")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--save", type=Path, default=None)
    options = parser.parse_args()
    torch.set_num_threads(1)
    found: list[tuple[int, dict[str, float]]] = []
    count = 1
    while not found or 2 * found[-1][0] <= 1.2 * options.largest:
        scene = tables(count, np.random.default_rng(options.seed))
        noise = torch.randn(scene.translations.shape, generator=torch.Generator().manual_seed(options.seed))
        noise *= torch.tensor([1.0, 1.0, 0.2]) * options.noise * scene.is_free[..., None]
        scene = scene.with_poses(scene.translations + noise, scene.rotations)
        spent = {}
        for name, call in CALLS.items():
            if not found or name != "make_ready":
                call(scene, physics=options.physics)  # builds what is needed
            start = time.process_time()
            call(scene, physics=options.physics)
            spent[name] = time.process_time() - start
        found.append((int(scene.is_free.sum()), spent))
        count *= 2
    numbers = np.array([number for number, _ in found])
    table = Table("objects", *(f"{name}, s" for name in CALLS), title=f"physics={options.physics}")
    for number, spent in found:
        table.add_row(str(number), *(f"{spent[name]:.3f}" for name in CALLS))
    slopes = [np.polyfit(np.log(numbers), np.log([spent[name] for _, spent in found]), 1)[0] for name in CALLS]
    table.add_row("exponent", *(f"{slope:.2f}" for slope in slopes))
    Console().print(table)
    if options.save is not None:
        with options.save.open("w", newline="") as file:
            rows = csv.writer(file)
            rows.writerow(["objects", *CALLS])
            rows.writerows([number, *(f"{spent[name]:.4f}" for name in CALLS)] for number, spent in found)
        _plot(options.save.with_suffix(".png"), numbers, {name: [spent[name] for _, spent in found] for name in CALLS})


def _plot(path: Path, numbers: np.ndarray, seconds: dict[str, list[float]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(5.6, 3.6))
    for name, values in seconds.items():
        axes.loglog(numbers, values, marker="o", label=name)
    axes.loglog(numbers, seconds["penetration"][0] * numbers / numbers[0], "k:", linewidth=1, label="linear")
    axes.set(xlabel="free objects in one scene", ylabel="CPU seconds per scene")
    axes.set_xticks(numbers, [str(number) for number in numbers], minor=False)
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
