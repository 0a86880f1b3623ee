"""``scene-envs demo``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agents.cli.run_folder import Run


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
    from agents.cli.commands.post_train import say_change
    from agents.post_training.demo import run_demo

    say_change(run_demo(settings.output, settings.seed, settings.workers), run)
    run.say(f"open {run.directory / 'report.html'}; scene-envs sample prior={run.directory} draws more")
