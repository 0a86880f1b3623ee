"""``scene-envs pretrain``."""

from __future__ import annotations

from agents.cli.run_folder import Run
from agents.pretraining.settings import PretrainConfig


def run(settings: PretrainConfig, run: Run) -> None:
    """Train the prior; the trainer writes its own metrics."""
    from agents.pretraining.trainer import pretrain

    metrics = pretrain(settings)
    loss = "" if metrics["heldout_loss"] is None else f"held-out loss {metrics['heldout_loss']:.4g} after "
    run.say(f"{loss}{metrics['trained_steps']} steps")
    run.say(f"sample it: scene-envs sample prior={run.directory}")
