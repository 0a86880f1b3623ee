"""``scene-envs evaluate``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from agents.cli_run import Run


@dataclass
class EvaluateConfig:
    """Measures of a prior's raw samples.

    Attributes:
        prior: a shipped name, or the folder of a prior or a run.
        count: samples, and real scenes from the grammar to compare with.
        num_steps: denoising steps per sample.
        seed: of the samples and of the real scenes.
        project: also measure after projection and settling, the slowest part.
        batch_size: scenes denoised at once.
        workers: physics worker processes; 0 computes in this one.
        output: folder for metrics.json and metrics.md.
    """

    prior: str = "dimsum_table"
    count: int = 200
    num_steps: int = 50
    seed: int = 0
    project: bool = True
    batch_size: int = 64
    workers: int = 2
    output: str = ""


def config() -> type[EvaluateConfig]:
    """The keys of this command."""
    return EvaluateConfig


def run(settings: EvaluateConfig, run: Run) -> None:
    """Measure and tabulate."""
    from agents.evaluation import evaluate_prior, figure_table
    from scene_envs.physics import PhysicsPool

    with PhysicsPool(workers=settings.workers) as pool:
        figures = evaluate_prior(
            settings.prior,
            settings.count,
            num_steps=settings.num_steps,
            seed=settings.seed,
            batch_size=settings.batch_size,
            pool=pool,
            ready=settings.project,
        )
    run.write_metrics(figures)
    table = figure_table(figures)
    (run.directory / "metrics.md").write_text(table + "\n", encoding="utf-8")
    run.say(table)
