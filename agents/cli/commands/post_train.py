"""``scene-envs post-train``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from agents.post_training import PostTrainConfig, post_train, post_train_and_compare
from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    from agents.cli.run_folder import Run


@dataclass
class PostTrainKeys(PostTrainConfig):
    """A post-training run and its report.

    Attributes:
        report_scenes: fresh samples of the prior before and after, measured and pictured in report.html; 0 for no
            report.
        prompt: what the scenes should hold, for priors that read prompts: a text, a list such as '["A scene with two
            cups.", "A scene with 9 objects."]', data for the prompts of the real scenes, or grammar for descriptions of
            the grammar's; null for anything.
    """

    report_scenes: int = 256
    prompt: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.report_scenes < 0:
            raise InvalidInputError(f"report_scenes={self.report_scenes} must not be negative; 0 writes no report")

    @property
    def run_config(self) -> PostTrainConfig:
        """The run without its report."""
        values = {field.name: getattr(self, field.name) for field in fields(PostTrainConfig)}
        return PostTrainConfig(**{**values, "prompt": read_prompts(self.prompt)})


def read_prompts(text: str | None) -> str | list[str] | None:
    """One prompt as it is, and a list of them where the text is one.

    >>> read_prompts("A scene with a cup, a plate and a teapot."), read_prompts("[a cup, a plate]")
    ('A scene with a cup, a plate and a teapot.', ['a cup', 'a plate'])
    """
    import yaml

    if text is None or not text.lstrip().startswith("["):
        return text
    try:
        prompts = yaml.safe_load(text)
    except yaml.YAMLError:
        prompts = None
    if not isinstance(prompts, list) or not all(isinstance(prompt, str) for prompt in prompts):
        raise InvalidInputError(
            f'prompt={text!r} is no list of texts; write \'["A scene with two cups.", "A scene with 9 objects."]\''
        )
    return prompts


def config() -> type[PostTrainKeys]:
    """The keys of this command."""
    return PostTrainKeys


def run(settings: PostTrainKeys, run: Run) -> None:
    """Post-train and report; the trainer and the report write the metrics."""
    if settings.report_scenes:
        metrics = post_train_and_compare(settings.run_config, scenes=settings.report_scenes)
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
        ("prompt_match", "match of the prompts"),
    ):
        if before.get(name) and name in after:
            change = after[name] / before[name] - 1
            run.say(f"{label:<20} {before[name]:6.2f} -> {after[name]:6.2f}  ({change:+.0%})")
    run.say(f"{'held-out loss':<20} {metrics['guard']['ratio']:.2f}x of the base prior's")
