"""``scene-envs pretrain``, ``post-train`` and ``doctor``."""

from __future__ import annotations

from types import SimpleNamespace

from agents.cli.run_folder import Run
from agents.post_training.settings import PostTrainConfig
from agents.pretraining.settings import PretrainConfig


def run_pretrain(settings: PretrainConfig, run: Run) -> None:
    """Train the prior; the trainer writes its own metrics."""
    from agents.pretraining.trainer import pretrain

    metrics = pretrain(settings)
    loss = "" if metrics["heldout_loss"] is None else f"held-out loss {metrics['heldout_loss']:.4g} after "
    run.say(f"{loss}{metrics['trained_steps']} steps")
    run.say(f"sample it: scene-envs sample prior={run.directory}")


def run_post_train(settings: PostTrainConfig, run: Run) -> None:
    """Post-train and report; the trainer and the report write the metrics."""
    from agents.post_training import post_train, post_train_and_compare
    from agents.post_training.report import rows_with_change
    from agents.utils.process_group import is_first_process

    if not is_first_process():
        post_train(settings)
    elif settings.logger.report_scenes:
        metrics = post_train_and_compare(settings, scenes=settings.logger.report_scenes)
        for label, *cells in rows_with_change(metrics["before"], metrics["after"]):
            run.say(f"{label:<40} " + "  ".join(f"{cell:>14}" for cell in cells))
        run.say(f"held-out loss {metrics['guard']['ratio']:.2f}x of the base prior's")
        run.say(f"open {run.directory / 'report.html'}")
    else:
        metrics = post_train(settings).metrics
        first, last = metrics["reward"]["first"], metrics["reward"]["last"]
        if first is not None:
            run.say(f"mean reward of a batch: {first:.4g} at first, {last:.4g} at last")
        run.say(f"held-out loss {metrics['guard']['ratio']:.2f}x of the base prior's")
        if lost := metrics["reward"]["invalid_scenes"]:
            run.say(f"{lost} scenes without a valid reward; log.txt says why")
    run.say(f"sample it: scene-envs sample prior={run.directory}")


def run_doctor(settings: PostTrainConfig, run: Run) -> None:
    """Examine the run that ``post-train`` would make of these settings."""
    from rich.console import Console

    from agents.post_training.doctor import diagnose

    report = diagnose(settings)
    run.write_metrics(report.metrics())
    Console().print(report)
    for line in report.advice:
        run.log(line)


pretrain, post_train, doctor = (SimpleNamespace(run=run) for run in (run_pretrain, run_post_train, run_doctor))
