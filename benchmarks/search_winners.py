"""Best scenes of searches in another simulator, their pictures and curves; commands of search.py."""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from export import SIMULATORS
from ready import FORMATS, without
from rich.console import Console
from rich.table import Table

from scene_envs.envs.scoring import RewardScorer
from scene_envs.export import export, place
from scene_envs.scene import SceneBatch


def rest(options: argparse.Namespace) -> None:
    """Whether the feasible objects of scenes stand still in another simulator."""
    title = f"feasible objects after {options.duration:g} s in {options.simulator}"
    columns = ("feasible", "moved > 1 cm", "moved > 1 mm", "median, mm", "largest, mm", "outside the workspace", "s")
    table, scorer = Table("scene", *columns, title=title), RewardScorer("feasible_objects")
    total = np.zeros(4, dtype=int)
    for file in options.files:
        begun, batch = time.perf_counter(), SceneBatch.load(file)
        counted = scorer(batch).object_flags["feasible"] & batch.is_free
        outside = int((counted & ~batch.in_workspace).sum())
        moved = distances(without(batch, batch.is_free & ~counted), options.simulator, options.duration)
        numbers = [int(counted.sum()), int((moved > 1e-2).sum()), int((moved > 1e-3).sum()), outside]
        total += numbers
        millimetres = [f"{1e3 * np.median(moved):.3f}", f"{1e3 * moved.max():.2f}"]
        cells = [*map(str, numbers[:3]), *millimetres, str(outside), f"{time.perf_counter() - begun:.1f}"]
        table.add_row(Path(file).stem, *cells)
    table.add_section()
    table.add_row("all", *map(str, total[:3]), "", "", str(total[3]), "")
    Console(width=160).print(table)


def distances(batch: SceneBatch, simulator: str, duration: float) -> np.ndarray:
    """(objects,) m from where each free object was exported, after ``duration`` s."""
    simulate, moved = SIMULATORS[simulator][1], []
    with tempfile.TemporaryDirectory() as folder:
        export(batch, folder, FORMATS[simulator])
        for scene in place(batch):
            _, after = simulate(Path(folder), scene, duration)
            moved += [np.linalg.norm(after[o.name] - o.translation) for o in scene.objects if not o.welded]
    return np.nan_to_num(np.array(moved), nan=np.inf)


def pictures(options: argparse.Namespace) -> None:
    """A gallery of the scenes in files, with what is feasible in them, or what another objective says of them."""
    from scene_envs.render import gallery, render

    scorer, images, captions = RewardScorer(options.objective), [], []
    for file in options.files:
        batch = SceneBatch.load(file)
        score = scorer(batch, None if options.prompt is None else [options.prompt] * len(batch))
        bad = None
        if "feasible" in score.object_flags:
            bad = (batch.is_free & ~score.object_flags["feasible"])[:1]
            captions.append(f"{int(score.value[0])} of {int(batch.is_free[0].sum())} feasible")
        else:
            captions.append(f"{options.objective} {float(score.value[0]):.2f}")
        images.append(render(batch[0], width=480, height=360, highlight=bad)[0])
    gallery(images, columns=min(4, len(images)), captions=captions).save(options.output)


def curve(options: argparse.Namespace) -> None:
    """Best objective against scenes: median over the seeds, and the range of each planner."""
    from matplotlib.figure import Figure

    records = [json.loads(line) for line in Path(options.records).read_text().splitlines()]
    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots()
    colors = ("#1f6f8b", "#c8553d", "#5a8f29", "#8e6bb0", "#d99a2b", "#5c6b73", "#b0487a")
    for planner, color in zip(options.planners, colors, strict=False):
        curves = [
            np.array(r["curve"] + [r["curve"][-1]] * (r["scenes"] - len(r["curve"])), dtype=float)
            for r in records
            if (r["prior"], r["planner"], r["scenes"]) == (options.prior, planner, options.scenes)
            and (r["mask"] == options.mask or planner == "best_of")  # best of N masks nothing
        ]
        if not curves:
            continue
        x, stacked = np.arange(1, options.scenes + 1), np.stack(curves)
        median, low, high = np.median(stacked, axis=0), stacked.min(axis=0), stacked.max(axis=0)
        axes.step(x, median, where="post", color=color, label=f"{planner} ({len(curves)} seeds)", linewidth=2)
        axes.fill_between(x, low, high, step="post", color=color, alpha=0.15, linewidth=0)
    axes.set(xlabel="scenes", ylabel=f"best {options.objective.replace('_', ' ')}", xlim=(0, options.scenes))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(options.output)
