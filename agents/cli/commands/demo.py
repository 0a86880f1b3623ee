"""``scene-envs demo``."""

from __future__ import annotations

from dataclasses import dataclass

from agents.cli.run_folder import Run
from agents.configuration.composition import DeviceKeys, ProgressKeys


@dataclass
class DemoConfig(DeviceKeys, ProgressKeys):
    """The demonstration.

    Attributes:
        output: folder for report.html, samples.png, ready.png, metrics.json and the two runs, clutter and feasible.
        seed: seed of training and of the samples.
        workers: physics worker processes.
    """

    output: str = "runs/demo"
    seed: int = 0
    workers: int = 2


def run(settings: DemoConfig, run: Run) -> None:
    """Post-train twice, compare, report."""
    from agents.post_training.demo import RUNS, run_demo
    from agents.post_training.report import number_rows

    metrics = run_demo(**vars(settings))
    for label, *cells in number_rows({name: metrics[name] for name in ("base", *RUNS)}):
        run.say(f"{label:<40} " + "  ".join(f"{cell:>14}" for cell in cells))
    run.say(f"open {run.directory / 'report.html'}; scene-envs sample prior={run.directory / 'feasible'} draws more")
