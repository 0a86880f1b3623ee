"""``scene-envs post-train``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from agents.post_training import PostTrainConfig, post_train

if TYPE_CHECKING:
    from agents.cli_run import Run


def config() -> type[PostTrainConfig]:
    """The keys of this command."""
    return PostTrainConfig


def run(settings: PostTrainConfig, run: Run) -> None:
    """Post-train; the trainer writes its own metrics."""
    result = post_train(settings)
    first, last = (result.metrics["reward"][key] for key in ("first", "last"))
    ratio = result.metrics["guard"]["ratio"]
    if first is not None:
        run.say(f"mean reward of a batch: {first:.4g} at first, {last:.4g} at last; held-out loss {ratio:.2f}x")
    run.say(f"sample it: scene-envs sample prior={run.directory}")
