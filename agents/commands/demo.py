"""``scene-envs demo``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agents.cli_run import Run


@dataclass
class DemoConfig:
    """The demonstration.

    Attributes:
        output: folder for report.html, curve.png, before.png, after.png, metrics.json and the post-trained prior.
        seed: of training and of the samples.
        workers: physics worker processes.
    """

    output: str = "runs/demo"
    seed: int = 0
    workers: int = 2


def config() -> type[DemoConfig]:
    """The keys of this command."""
    return DemoConfig


def run(settings: DemoConfig, run: Run) -> None:
    """Post-train, compare, report."""
    from agents.post_training.demo import run_demo

    metrics = run_demo(settings.output, settings.seed, settings.workers)
    before, after = metrics["before"], metrics["after"]
    for name, label in (
        ("objects", "objects per scene"),
        ("feasible_objects", "feasible as sampled"),
        ("ready_objects", "simulation-ready"),
    ):
        if before.get(name) and name in after:
            change = after[name] / before[name] - 1
            run.say(f"{label:<20} {before[name]:6.2f} -> {after[name]:6.2f}  ({change:+.0%})")
    run.say(f"{'held-out loss':<20} {metrics['guard']['ratio']:.2f}x of the base prior's")
    run.say(f"open {run.directory / 'report.html'}; scene-envs sample prior={run.directory} draws more")
