"""A run that collapses, and what the guard makes of it: NFT as published (`algorithm.expectation_lr=0`), the same with
`guard.action=rollback`, NFT at its defaults, and the same with a shorter average of the weights that sample, toward
`feasible_share` on `dimsum_table`.

    python -m benchmarks.collapse runs/collapse --iterations 1000

It trains the four runs, resumes those that are there, keeps samples of the published run at four moments, and draws
`collapse.png` and `collapse.csv`.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

import numpy as np
import torch

from agents import ScenePrior
from agents.cli.main import main as command
from agents.post_training.run_files import CHECKPOINT_NAME
from agents.utils.checkpoints import load_checkpoint
from scene_envs import SceneBatch
from scene_envs.render import render

PRIOR = "dimsum_table"
PUBLISHED = {"algorithm.expectation_lr": 0.0, "algorithm.sampler_decay": 0.9}
RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "published": ("as published", PUBLISHED),
    "rollback": (
        "as published, guard.action=rollback",
        PUBLISHED | {"guard.action": "rollback", "guard.samples_every": 10},
    ),
    "defaults": ("defaults", {}),
    "short_average": ("defaults, algorithm.sampler_decay=0.9", {"algorithm.sampler_decay": 0.9}),
}
MOMENTS = (0, 20, 50, 120)
"""Iterations of the published run whose samples are shown."""
SHARED = {
    "prior": PRIOR,
    "reward": "feasible_share",
    "algorithm": "nft",
    "batch_size": 24,
    "regularisation.batch_size": 24,
    "guard.every": 10,
    "guard.samples_every": 50,
    "logger.report_scenes": 0,
}
CURVES = {"reward": "feasible share, mean of five batches", "guard_ratio": "held-out loss / base prior's",
          "guard_classifier_accuracy": "accuracy of the guard's classifier"}  # fmt: skip
_BATCHES = 5
"""Batches over which the curve of the reward is averaged."""
COLORS = {"published": "#c44e52", "rollback": "#dd8452", "defaults": "#4c72b0", "short_average": "#8c8c8c"}


def train(folder: Path, name: str, iterations: int) -> None:
    """Train or resume a run; samples of the published one are kept at its moments."""
    moments = [moment for moment in MOMENTS[1:] if moment < iterations] if name == "published" else []
    for stop in [*moments, iterations]:
        keys = SHARED | RUNS[name][1] | {"iterations": stop, "output": str(folder / name)}
        if code := command(["post-train", *(f"{key}={value}" for key, value in keys.items())]):
            raise SystemExit(code)
        if stop in moments:
            sample(folder / name / CHECKPOINT_NAME, folder / f"moment_{stop}.safetensors")


def sample(checkpoint: Path | None, path: Path) -> None:
    """Four samples, from the same noise, of the averaged weights in a checkpoint, or of the base prior."""
    prior = ScenePrior.load(PRIOR)
    if checkpoint is not None:
        weights = load_checkpoint(checkpoint)["learner"]["algorithm"]["sampler"]
        prior.load_state_dict(weights)
    prior.sample(4, num_steps=25, seed=0).save(path)


def read(folder: Path, name: str) -> list[dict[str, float]]:
    """Rows of the log of a run; figures that a row lacks are left out."""
    with (folder / name / "log.csv").open() as file:
        return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(file)]


def draw(folder: Path, path: Path) -> None:
    """The curves of all runs, and four samples of the published one at each moment."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(12, 6.6), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.15, 1))
    for axes, (key, label) in zip(upper.subplots(1, len(CURVES)), CURVES.items(), strict=True):
        for name, (title, _) in RUNS.items():
            if not (rows := [row for row in read(folder, name) if key in row]):
                continue
            iterations, values = np.array([(row["iteration"], row[key]) for row in rows]).T
            if key == "reward":
                values = np.convolve(values, np.full(_BATCHES, 1 / _BATCHES), mode="valid")
                iterations = iterations[_BATCHES - 1 :]
            axes.plot(iterations, values, color=COLORS[name], label=title, linewidth=1.2,
                      marker="" if key == "reward" else ".", markersize=4)  # fmt: skip
        axes.set(xlabel="iteration", title=label)
        axes.grid(alpha=0.3)
    upper.legend(*upper.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(RUNS), fontsize=9)
    cells = lower.subplots(2, 2 * len(MOMENTS))
    for column, moment in enumerate(MOMENTS):
        batch = SceneBatch.load(folder / f"moment_{moment}.safetensors")
        images = render(batch, width=320, height=280)
        for index, image in enumerate(images):
            cell = cells[index // 2, 2 * column + index % 2]
            cell.imshow(image)
            cell.set_axis_off()
        cells[0, 2 * column].set_title(f"iteration {moment}", loc="left")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Train what is missing, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the runs")
    parser.add_argument("--iterations", type=int, default=1000, help="iterations of each run")
    parser.add_argument("--draw", action="store_true", help="only draw what is there")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    if not arguments.draw:
        sample(None, arguments.folder / "moment_0.safetensors")
        for name in RUNS:
            train(arguments.folder, name, arguments.iterations)
    draw(arguments.folder, arguments.folder / "collapse.png")
    with (arguments.folder / "collapse.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["run", "iteration", *CURVES, "guard_sample_reward"])
        for name in RUNS:
            for row in read(arguments.folder, name):
                values = [row.get(key) for key in (*CURVES, "guard_sample_reward")]
                writer.writerow(
                    [name, int(row["iteration"]), *("" if value is None else f"{value:.5g}" for value in values)]
                )


if __name__ == "__main__":
    main()
