"""``scene-envs post-train``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from agents.post_training import PostTrainConfig, post_train, steer
from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    from agents.cli_run import Run


@dataclass
class PostTrainKeys(PostTrainConfig):
    """A post-training run and its report.

    Attributes:
        report_scenes: fresh samples of the prior before and after, measured and pictured in report.html; 0 for no
            report.
    """

    report_scenes: int = 256

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.report_scenes < 0:
            raise InvalidInputError(f"report_scenes={self.report_scenes} must not be negative; 0 writes no report")

    @property
    def run_config(self) -> PostTrainConfig:
        """The run without its report."""
        return PostTrainConfig(**{field.name: getattr(self, field.name) for field in fields(PostTrainConfig)})


def config() -> type[PostTrainKeys]:
    """The keys of this command."""
    return PostTrainKeys


def run(settings: PostTrainKeys, run: Run) -> None:
    """Post-train and report; the trainer and the report write the metrics."""
    if settings.report_scenes:
        metrics = steer(settings.run_config, scenes=settings.report_scenes)
        say_change(metrics, run)
        run.say(f"open {run.directory / 'report.html'}")
    else:
        metrics = post_train(settings.run_config).metrics
        first, last = metrics["reward"]["first"], metrics["reward"]["last"]
        if first is not None:
            run.say(f"mean reward of a batch: {first:.4g} at first, {last:.4g} at last")
        run.say(f"held-out loss {metrics['guard']['ratio']:.2f}x of the base prior's")
    run.say(f"sample it: scene-envs sample prior={run.directory}")


def say_change(metrics: Mapping[str, Any], run: Run) -> None:
    """Before and after, a line each."""
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
