"""Numbers of objects in the scenes of a type: the figures, tables and histograms of docs/scene_types.

    python benchmarks/scene_statistics.py [--scene pantry_shelf …] [--count 20000] [--seed 0] [--workers 2]
        [--pictures docs/scene_types] [--gallery 6]

Prints the counts per scene, and per asset, as Markdown. With ``--pictures`` it draws ``<scene>_counts.png`` there, and
with ``--gallery`` also ``<scene>.png``, a picture of so many scenes, from empty to full.

Scene ``i`` comes from the generator ``[seed, i]``, so the result does not depend on the number of workers. For the
counts, the contents of crocks and bowls are drawn but not settled (their poses are not looked at); draws that would
have spilled are therefore counted too. On a busy machine run it under ``nice``.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path
from time import perf_counter
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from scene_envs.grammars import Grammar, get_grammar
from scene_envs.grammars.layout import Containers
from scene_envs.scene_types import SceneType, get_scene_type, list_scene_types

Counts = NDArray[np.int64]

_CHUNK = 250
_COLOR = "#d8a03c"


def count_scenes(scene: str, count: int, seed: int, workers: int) -> tuple[Counts, Counter[str]]:
    """Objects per scene and asset (count, C), and why structures were thrown away."""
    starts = range(0, count, _CHUNK)
    jobs = [range(start, min(start + _CHUNK, count)) for start in starts]
    with ProcessPoolExecutor(workers, initializer=_one_thread) as pool:
        results = list(pool.map(partial(_count_chunk, scene, seed), jobs))
    return np.concatenate([counts for counts, _ in results]), sum((reasons for _, reasons in results), Counter())


def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)


_grammar = cache(get_grammar)


def _count_chunk(scene: str, seed: int, indices: range) -> tuple[Counts, Counter[str]]:
    grammar: Grammar = _grammar(scene)
    grammar.reasons.clear()
    with patch.object(Containers, "fill", _not_settled):
        scenes = [grammar.sample_array(np.random.default_rng([seed, index]), 1) for index in indices]
    return np.concatenate(scenes)[:, :, 12:-1].sum(axis=1).astype(np.int64), Counter(grammar.reasons)


def _not_settled(self: Containers, container: str, contents: list[str], *_: object) -> list[tuple[object, object]]:
    return [(np.eye(3), np.zeros(3))] * len(contents)


def report(scene_type: SceneType, counts: Counts, reasons: Counter[str]) -> str:
    """The tables of one scene type, as Markdown; ``counts`` is (count, C)."""
    total = counts.sum(axis=1)
    low, high = int(total.min()), int(total.max())
    tail = ", ".join(f"{value:.0f}" for value in np.percentile(total, [5, 50, 95]))
    lines = [
        f"### {scene_type.name}, {len(total):,} scenes",
        "",
        "| mean | standard deviation | 5 %, 50 %, 95 % | minimum | maximum |",
        "|---|---|---|---|---|",
        f"| {total.mean():.2f} | {total.std():.2f} | {tail} | {_in_scenes(total, low)} | {_in_scenes(total, high)} |",
        "",
        "| asset | mean per scene | most | scenes with any |",
        "|---|---|---|---|",
    ]
    fixed = Counter(welded.asset for welded in scene_type.fixed)
    for column, asset in enumerate(scene_type.library):
        number = counts[:, column]
        if (number == fixed[asset.name]).all():
            continue  # the welded support itself
        present = 100.0 * (number > 0).mean()
        lines.append(f"| {asset.name.replace('_', ' ')} | {number.mean():.2f} | {number.max()} | {present:.1f} % |")
    thrown = ", ".join(f"{reason}: {number}" for reason, number in reasons.most_common()) or "nothing"
    return "\n".join([*lines, "", f"thrown away while drawing: {thrown}"])


def _in_scenes(total: Counts, value: int) -> str:
    number = int((total == value).sum())
    return f"{value} ({number:,} scene{'s' if number > 1 else ''})"


def draw_histogram(total: Counts, support: str, path: Path) -> None:
    """Write the histogram of ``total`` (count,), whose objects include ``support``, to ``path``."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    low, high = int(total.min()), int(total.max())
    share = 100.0 * np.bincount(total, minlength=high + 1)[low:] / len(total)
    figure, axes = plt.subplots(figsize=(5.6, 2.6), dpi=80)
    axes.bar(np.arange(low, high + 1), share, color=_COLOR, width=0.85)
    axes.axvline(total.mean(), color="#333", linewidth=1)
    axes.text(total.mean() + 0.015 * (high - low), 0.94 * axes.get_ylim()[1], f"mean {total.mean():.2f}", fontsize=9)
    axes.set_xlabel(f"objects per scene, {support} included")
    axes.set_ylabel(f"% of {len(total):,} scenes")
    axes.set_xticks(range(low, high + 1, max(1, round((high - low) / 9))))
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def draw_gallery(scene: str, count: int, seed: int, path: Path) -> None:
    """Write a picture of ``count`` scenes to ``path``, chosen evenly from empty to full out of five times as many."""
    from scene_envs.render import gallery, render

    batch = get_grammar(scene).sample(np.random.default_rng(seed), 5 * count)
    batch = batch[batch.counts.argsort()[2::5]]
    captions = [f"{number} objects" for number in batch.counts.tolist()]
    gallery(render(batch, width=480, height=360), columns=3, captions=captions).save(path, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", nargs="+", default=list_scene_types())
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--pictures", type=Path, help="folder for histograms")
    parser.add_argument("--gallery", type=int, default=0, help="scenes in a picture of each scene type")
    options = parser.parse_args()
    for scene in options.scene:
        scene_type, start = get_scene_type(scene), perf_counter()
        counts, reasons = count_scenes(scene, options.count, options.seed, options.workers)
        print(report(scene_type, counts, reasons))
        print(f"{perf_counter() - start:.0f} s\n", flush=True)
        if options.pictures:
            options.pictures.mkdir(parents=True, exist_ok=True)
            draw_histogram(counts.sum(axis=1), _support(scene_type), options.pictures / f"{scene}_counts.png")
            if options.gallery:
                draw_gallery(scene, options.gallery, options.seed, options.pictures / f"{scene}.png")


def _support(scene_type: SceneType) -> str:
    return "the " + scene_type.library[scene_type.fixed[0].asset].display_name.split()[-1]


if __name__ == "__main__":
    main()
