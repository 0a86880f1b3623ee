"""``scene-envs doctor``."""

from __future__ import annotations

from agents.cli.run_folder import Run
from agents.post_training.settings import PostTrainConfig


def run(settings: PostTrainConfig, run: Run) -> None:
    """Examine the run that ``post-train`` would make of these settings."""
    from rich.console import Console

    from agents.post_training.doctor import diagnose

    report = diagnose(settings)
    run.write_metrics(report.metrics())
    Console().print(report)
    for line in report.advice:
        run.log(line)
