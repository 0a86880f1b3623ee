"""Pictures of a search: the curve against NFE, and a scene with the mask of the next step."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from scene_envs.scene import SceneBatch


def draw_curve(
    curves: Mapping[str, Sequence[float]],
    path: Path,
    *,
    num_steps: int,
    first: int,
    scale: float = 1.0,
    label: str = "objective",
) -> Path:
    """Best objective against denoiser evaluations, one line per planner.

    Args:
        curves: best Φ after each generated scene, by planner; values that are not finite are left out.
        path: image file to write.
        num_steps: denoiser evaluations per generated scene.
        first: number of scenes that were fresh samples in the tree search; a line marks their end. 0 draws no line.
        scale: raw objective at Φ = 1.
        label: name of the objective.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    figure = Figure(figsize=(6.4, 4.0), dpi=150, layout="constrained")
    axes = figure.subplots()
    for (name, curve), color in zip(curves.items(), ("#1f6f8b", "#9aa0a6", "#c8553d", "#5a8f29"), strict=False):
        points = [(n * num_steps, scale * v) for n, v in enumerate(curve, start=1) if math.isfinite(v)]
        if points:
            axes.step(*zip(*points, strict=True), where="post", label=name, color=color, linewidth=2)
    if first:
        axes.axvline(first * num_steps, color="#9aa0a6", linewidth=1, linestyle=":", label="first samples")
    axes.set_xlabel("denoiser evaluations (NFE)")
    axes.set_ylabel(f"best {label}")
    axes.set_xlim(left=0)
    if all(math.isclose(scale * v, round(scale * v)) for v in itertools.chain(*curves.values()) if math.isfinite(v)):
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, loc="lower right")
    figure.savefig(path)
    return path


def draw_scene(scene: SceneBatch, state: Any, path: Path, *, width: int = 640, height: int = 480) -> Path:
    """Draw one scene; the objects that its state would regenerate next are red.

    Args:
        scene: a batch of one.
        state: search state of the scene; ``value``, ``objective`` and ``mask`` (N,) are read.
        path: image file to write.
        width: width of the picture in pixels.
        height: height of the picture in pixels.
    """
    from scene_envs.render import gallery, render

    marked = state.mask.unsqueeze(0) & scene.is_free
    image = render(scene, width=width, height=height, highlight=marked)[0]
    objects = int(scene.is_free.sum())
    objective = f"objective {state.objective:.4g}" if state.valid else "not scored"
    caption = f"{objective} | {objects} free objects | {int(marked.sum())} to redo (red)"
    gallery([image], columns=1, captions=[caption]).save(path)
    return path
