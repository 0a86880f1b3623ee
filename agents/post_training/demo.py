"""Demonstration: the shipped Dimsum prior steered toward clutter and toward feasible placement, with a report."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from agents.configuration.composition import config_text
from agents.post_training.report import (
    PHYSICS_TIMEOUT,
    SAMPLE_SEED,
    Measured,
    draw_scenes,
    measure_prior,
    number_rows,
    write_report,
)
from agents.post_training.run_files import METRICS_NAME
from agents.priors.prior import ScenePrior
from rewards import reward_label
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import TrainingError
from scene_envs.files import read_sealed, write_json
from scene_envs.workers import Task, WorkerPool

RUNS: Mapping[str, Sequence[str]] = {"clutter": ["recipe=demo_clutter"], "feasible": ["recipe=demo_feasible"]}
"""The two runs: their names, which are their folders and columns of the report, and their keys of ``post-train``."""


def run_demo(
    output: str | Path = "runs/demo",
    seed: int = 0,
    workers: int = 2,
    *,
    device: str = "auto",
    progress: str = "bar",
    scenes: int = 24,
    num_steps: int = 50,
    runs: Mapping[str, Sequence[str]] = RUNS,
) -> dict[str, Any]:
    """Post-train a prior with the keys of each of ``runs`` at the same time, measure all priors on ``scenes`` samples
    from the same noise, and write report.html, metrics.json, pictures and a folder per run, which ``prior=`` loads, to
    ``output``. Both runs together have ``workers`` physics workers. Returns the numbers of metrics.json: those of
    ``measure_prior`` for ``base`` and each run, the metrics of ``runs``, and ``seconds``. A TrainingError, with the
    cause on stderr, if a run failed; a second call resumes the runs.
    """
    from scene_envs.physics import make_pool

    directory, started = Path(output), time.perf_counter()
    keys = [f"seed={seed}", f"workers={-(-workers // len(runs))}", "logger.report_scenes=0"]
    keys += [f"device={device}", f"progress={progress}", "logger.checkpoint_every=1"]  # an interrupt ends runs at once
    tasks = [
        Task((name, [*words, *keys, f"output={directory / name}"]), f"the run {name!r}") for name, words in runs.items()
    ]
    threads = str(max(1, len(os.sched_getaffinity(0)) // len(runs)))
    shares = {"OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
    found: dict[str, Measured] = {}

    def measure(task: Task, status: object) -> None:
        """Measure a finished run, while the other goes on."""
        if status != 0:
            how = f"ended with status {status}; its message stands above" if isinstance(status, int) else status
            raise TrainingError(f"{task.name} {how}")
        name = task.body[0]
        base = _Finished(directory / name).config["prior"]
        for label, tested in {"base": base, name: directory / name}.items():
            if label not in found:
                print(f"measuring {scenes} samples of the prior {label!r}", file=sys.stderr, flush=True)
                prior = cast(ScenePrior, resolve_prior(str(tested), device))
                found[label] = measure_prior(prior, scenes, num_steps=num_steps, seed=seed + SAMPLE_SEED, pool=pool)

    processes = WorkerPool("agents.cli.commands.demo:post_train_aloud", None, workers=len(runs), environment=shares)
    with make_pool(workers, PHYSICS_TIMEOUT) as pool, processes:
        processes.map(tasks, done=measure)
    results = {name: _Finished(directory / name) for name in runs}
    measured = {label: found[label] for label in ("base", *runs)}
    metrics = {
        **{name: part.figures for name, part in measured.items()},
        "runs": {name: run.metrics for name, run in results.items()},
        "seconds": round(time.perf_counter() - started, 1),
        "num_steps": num_steps,
    }
    if left_out := {name: reason for part in measured.values() for name, reason in part.left_out.items()}:
        metrics["left_out"] = left_out
    _write_page(directory, results, measured, left_out)
    write_json(directory / METRICS_NAME, metrics)
    return metrics


class _Finished:
    """Configuration and metrics of a finished run, from its folder."""

    def __init__(self, directory: Path) -> None:
        import yaml

        self.config: dict[str, Any] = yaml.safe_load(read_sealed(directory / "config.yaml"))
        self.metrics: dict[str, Any] = json.loads((directory / METRICS_NAME).read_text(encoding="utf-8"))
        self.curve, self.goal = directory / "curve.png", reward_label(self.config["reward"])
        self.algorithm = self.config["algorithm"]["name"].upper().replace("_", "-")


def _write_page(
    directory: Path, runs: Mapping[str, _Finished], measured: Mapping[str, Measured], left_out: Mapping[str, str]
) -> None:
    """Write the report, and its pictures, to ``directory``."""
    raw = {name: (part.raw, None) for name, part in measured.items()}
    pictures = {"samples": draw_scenes(raw, directory / "samples.png")}
    if "feasible" not in left_out:
        ready = {name: (part.ready, part.is_ready) for name, part in measured.items() if part.ready is not None}
        pictures["ready"] = draw_scenes(ready, directory / "ready.png")
    figures = {name: part.figures for name, part in measured.items()}
    write_report(
        directory / "report.html",
        "demo.html",
        title=f"{measured['base'].raw.scene_type.name.replace('_', ' ').capitalize()}, steered two ways",
        runs=runs,
        figures_of=figures,
        count=int(figures["base"]["scenes"]),
        left_out=left_out,
        pictures=pictures,
        rows=number_rows(figures),
        settings=config_text({name: run.config for name, run in runs.items()}),
    )
