"""``scene-envs demo``."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass

from agents.cli.run_folder import Run
from agents.configuration.composition import DeviceKeys, ProgressKeys
from scene_envs.errors import Natural, Seed


@dataclass
class DemoConfig(DeviceKeys, ProgressKeys):
    """The demonstration.

    Attributes:
        output: folder for report.html, samples.png, ready.png, metrics.json and the two runs, clutter and feasible.
        seed: seed of training and of the samples.
        workers: physics worker processes.
    """

    output: str = "runs/demo"
    seed: Seed = 0
    workers: Natural = 2


def run(settings: DemoConfig, run: Run) -> None:
    """Post-train twice, compare, report."""
    from agents.post_training.demo import RUNS, run_demo
    from agents.post_training.report import number_rows

    metrics = run_demo(**vars(settings))
    for label, *cells in number_rows({name: metrics[name] for name in ("base", *RUNS)}):
        run.say(f"{label:<40} " + "  ".join(f"{cell:>14}" for cell in cells))
    run.say(f"open {run.directory / 'report.html'}; scene-envs sample prior={run.directory / 'feasible'} draws more")


class _Named(io.StringIO):
    """Stream to stderr with the name of a run before each line."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._name, self._line, self._stderr = name, "", sys.stderr

    def write(self, text: str) -> int:
        *lines, self._line = (self._line + text).split("\n")
        print(*(f"{self._name}: {line}\n" for line in lines), sep="", end="", file=self._stderr, flush=True)
        return len(text)


def post_train_aloud(run: tuple[str, Sequence[str]]) -> int:
    """Exit status of ``scene-envs post-train`` for a name and keys; each line that it prints begins with the name."""
    from agents.cli.main import main

    name, words = run
    with redirect_stderr(_Named(name)) as stream, redirect_stdout(stream):
        return main(["post-train", *words])
