"""Plot of reward against realism of the table ``frontier``, and its figures as CSV.

    python -m benchmarks.post_training.frontier FOLDER [--output FILE] [--csv FILE]

FOLDER is the output of ``python -m benchmarks.post_training table=frontier``. A point is a run: its colour is the
algorithm, and its label the weight of the regularisation. The line joins the points that no other point beats in both
figures.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.post_training.rows import TABLES

COLOURS = {"nft": "#1f77b4", "awm": "#d95f02", "ddpo_sf": "#2ca02c"}


@dataclass(frozen=True)
class Point:
    """A measured run: algorithm and weight (both "" for the base prior), reward and accuracy."""

    algorithm: str
    weight: str
    reward: float
    accuracy: float


def points(folder: Path) -> list[Point]:
    """The base prior, then every run that ``folder`` has figures of."""
    found = []
    for name in ("dimsum_table", *(row.name for row in TABLES["frontier"].rows)):
        file = folder / f"{name}-figures" / "metrics.json"
        if file.exists():
            figures = json.loads(file.read_text(encoding="utf-8"))
            algorithm, _, weight = name.split("-")[1:] if "-" in name else ("", "", "")
            found.append(Point(algorithm, weight, figures["feasible_objects"], figures["classifier_accuracy"]))
    return found


def frontier(found: Sequence[Point]) -> list[Point]:
    """Points that no other point beats in both figures, by increasing accuracy.

    >>> a, b, c = (Point("nft", "1", reward, accuracy) for reward, accuracy in [(14, 0.6), (15, 0.7), (13, 0.7)])
    >>> frontier([a, b, c]) == [a, b]
    True
    """
    kept: list[Point] = []
    for point in sorted(found, key=lambda each: (each.accuracy, -each.reward)):
        if not kept or point.reward > kept[-1].reward:
            kept.append(point)
    return kept


def draw(found: Sequence[Point], output: Path) -> None:
    """Write the plot as a PNG file."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(8, 5))
    for algorithm, colour in COLOURS.items():
        own = [point for point in found if point.algorithm == algorithm]
        accuracies, rewards = [100 * point.accuracy for point in own], [point.reward for point in own]
        axes.scatter(accuracies, rewards, color=colour, s=45, label=algorithm, zorder=3)
        for point in own:
            place = (100 * point.accuracy, point.reward)
            axes.annotate(point.weight, place, xytext=(5, 4), textcoords="offset points", fontsize=8, color=colour)
    for point in found:
        if not point.algorithm:
            axes.scatter(
                [100 * point.accuracy], [point.reward], color="black", marker="s", label="base prior", zorder=3
            )
    best = frontier(found)
    axes.plot([100 * p.accuracy for p in best], [p.reward for p in best], color="0.6", lw=1, label="frontier")
    axes.set_xlabel("accuracy of a classifier, samples against real scenes, % (50 is chance)")
    axes.set_ylabel("feasible objects per raw sample")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    figure.tight_layout()
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output, dpi=110)


def main() -> None:
    """Read the folder, write the plot and the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--output", type=Path, default=Path("runs/frontier.png"))
    parser.add_argument("--csv", type=Path, help="file of the figures; none without")
    options = parser.parse_args()
    found = points(options.folder)
    draw(found, options.output)
    if options.csv:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["algorithm", "weight", "feasible_objects", "classifier_accuracy"])
            writer.writerows([p.algorithm, p.weight, f"{p.reward:.3f}", f"{p.accuracy:.4f}"] for p in found)


if __name__ == "__main__":
    main()
