"""Samples of several priors from the same noise, as a picture and a table.

python -m benchmarks.post_training.pictures PRIOR ... [--count 8] [--shown 4] [--seed 3] [--slots N] [--output FILE]

A row of the picture is a prior, a column one seed of the noise. No scene is selected. The table has means over
``--count`` samples of 50 steps.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from agents import ScenePrior
from scene_envs.physics import feasibility
from scene_envs.render import gallery, picture_camera, render


def main() -> None:
    """Sample, print the table and draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("priors", nargs="+", help="shipped names, or folders of runs")
    parser.add_argument("--count", type=int, default=8, help="samples of each prior")
    parser.add_argument("--shown", type=int, default=4, help="of them in the picture")
    parser.add_argument("--seed", type=int, default=3, help="of the noise")
    parser.add_argument("--slots", type=int, help="per scene")
    parser.add_argument("--output", type=Path, default=Path("runs/samples.png"), help="the picture")
    options = parser.parse_args()
    print("| prior | objects | feasible |\n|---|---|---|")
    images, captions = [], []
    for name in options.priors:
        batch = ScenePrior.load(name).sample(options.count, num_steps=50, slots=options.slots, seed=options.seed)
        report = feasibility(batch)
        print(f"| {name} | {batch.counts.double().mean():.1f} | {report.counts.double().mean():.1f} |")
        camera = picture_camera(batch.scene_type.name, 400, 300)
        images.append(render(batch[: options.shown], camera=camera, width=400, height=300))
        captions += [
            f"{total} objects, {good} feasible"
            for total, good in zip(batch.counts[: options.shown].tolist(), report.counts.tolist(), strict=False)
        ]
    options.output.parent.mkdir(parents=True, exist_ok=True)
    gallery(list(np.concatenate(images)), columns=options.shown, captions=captions).save(options.output)


if __name__ == "__main__":
    main()
