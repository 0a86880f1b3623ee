"""Demonstration: the shipped Dimsum prior steered toward clutter and toward feasible placement, with a report."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from agents.post_training.report import (
    PHYSICS_TIMEOUT,
    SAMPLE_SEED,
    Measured,
    Page,
    Picture,
    Section,
    Tile,
    draw_side_by_side,
    measure_prior,
    number_rows,
    ready_section,
    write_report,
)
from agents.post_training.run_files import METRICS_NAME, write_metrics
from agents.priors.prior import ScenePrior
from rewards import reward_label
from scene_envs.envs.scoring import resolve_prior
from scene_envs.errors import TrainingError
from scene_envs.files import read_sealed

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
    keys += [f"device={device}", f"progress={progress}"]
    commands = {name: [*words, *keys, f"output={directory / name}"] for name, words in runs.items()}
    base: ScenePrior | None = None
    results: dict[str, _Finished] = {}
    measured: dict[str, Measured] = {}
    with make_pool(workers, PHYSICS_TIMEOUT) as pool, _post_training(commands) as processes:
        for name, process in processes.items():
            if status := process.wait():
                raise TrainingError(f"the run {name!r} ended with status {status}; its message stands above")
            results[name] = run = _Finished(directory / name)
            base = cast(ScenePrior, resolve_prior(run.config["prior"], device)) if base is None else base
            for label, tested in {"base": base, name: ScenePrior.load(directory / name).to(base.device)}.items():
                if label not in measured:  # the other run goes on while samples are measured
                    print(f"measuring {scenes} samples of the prior {label!r}", file=sys.stderr, flush=True)
                    measured[label] = measure_prior(
                        tested, scenes, num_steps=num_steps, seed=seed + SAMPLE_SEED, pool=pool
                    )
    assert base is not None
    metrics = {
        **{name: part.figures for name, part in measured.items()},
        "runs": {name: run.metrics for name, run in results.items()},
        "seconds": round(time.perf_counter() - started, 1),
        "num_steps": num_steps,
    }
    if left_out := _left_out(measured):
        metrics["left_out"] = left_out
    write_report(directory / "report.html", _page(directory, base, results, measured))
    write_metrics(directory, metrics)
    return metrics


class _Finished:
    """Configuration and metrics of a finished run, from its folder."""

    def __init__(self, directory: Path) -> None:
        import yaml

        self.config: dict[str, Any] = yaml.safe_load(read_sealed(directory / "config.yaml"))
        self.metrics: dict[str, Any] = json.loads((directory / METRICS_NAME).read_text(encoding="utf-8"))
        self.goal = reward_label(self.config["reward"])
        self.algorithm = self.config["algorithm"]["name"].upper().replace("_", "-")


@contextmanager
def _post_training(commands: Mapping[str, Sequence[str]]) -> Iterator[dict[str, subprocess.Popen[str]]]:
    """Context in which ``scene-envs post-train`` runs with each list of keys, and with an equal part of the cores. Runs
    that are not finished at the end of the context save and end.
    """
    threads = str(max(1, len(os.sched_getaffinity(0)) // len(commands)))
    paths = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    environment = {"PYTHONPATH": paths, "PYTHONSAFEPATH": "1", "OMP_NUM_THREADS": threads, "MKL_NUM_THREADS": threads}
    processes: dict[str, subprocess.Popen[str]] = {}
    readers: list[threading.Thread] = []
    try:
        for name, words in commands.items():
            processes[name] = process = subprocess.Popen(
                [sys.executable, "-m", "agents.cli", "post-train", *words], env=os.environ | environment, text=True,
                errors="replace", stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches this process alone, which then ends the others
            )  # fmt: skip
            readers.append(threading.Thread(target=_pass_on, args=(name, process), daemon=True))
            readers[-1].start()
        yield processes
    finally:
        for process in processes.values():
            process.terminate()
        for process, reader in zip(processes.values(), readers, strict=True):
            process.wait()
            reader.join()


def _pass_on(name: str, process: subprocess.Popen[str]) -> None:
    """Print each line that a process writes on stderr, with the name of its run."""
    for line in process.stdout or ():
        print(f"{name}: {line}", end="", file=sys.stderr, flush=True)


def _page(
    directory: Path, base: ScenePrior, results: Mapping[str, _Finished], measured: Mapping[str, Measured]
) -> Page:
    """Content of the report; also writes its pictures to ``directory``."""
    runs = " and ".join(
        f"{run.goal} ({run.algorithm}, {run.metrics['iterations']} iterations)" for run in results.values()
    )
    before = measured["base"].figures
    tiles = []
    for name, run in results.items():
        after, ratio = measured[name].figures, run.metrics["guard"]["ratio"]
        tiles += [
            Tile(f"{name}: objects per scene", f"{after['objects']:.1f}", f"from {before['objects']:.1f}"),
            Tile(f"{name}: feasible as sampled", _share(after), f"of free objects, from {_share(before)}"),
            Tile(f"{name}: held-out loss", f"{ratio:.2f}×", "of the base prior"),
        ]
    raw = draw_side_by_side(measured, directory / "samples.png")
    columns, ready, left_out = "Columns: " + ", ".join(measured), [], _left_out(measured)
    if "feasible" not in left_out:
        ready = [Picture(draw_side_by_side(measured, directory / "ready.png", ready=True), columns)]
    count = int(before["scenes"])
    sections = [
        Section(
            "As sampled",
            "The first samples of each prior, untouched. The scenes of a row start from the same noise.",
            [Picture(raw, columns)],
        ),
        ready_section(ready, left_out),
        Section(
            "Numbers", f"Means over {count} samples.", table=number_rows({n: m.figures for n, m in measured.items()})
        ),
        Section(
            "The curves",
            "Reward of each batch, and the held-out pretraining loss over that of the base prior.",
            [Picture(directory / name / "curve.png", f"{name}: {run.goal}") for name, run in results.items()],
        ),
    ]
    title = f"{base.scene_type.name.replace('_', ' ').capitalize()}, steered two ways"
    lead = (
        f"One prior, post-trained toward {runs}, each with the pretraining loss on real scenes as regularisation. "
        f"All numbers are means over {count} fresh, seeded samples of each prior; none was selected."
    )
    settings = {f"{name}: {key}": value for name, run in results.items() for key, value in run.config.items()}
    return Page(title, lead, tiles, sections, settings)


def _left_out(measured: Mapping[str, Measured]) -> dict[str, str]:
    return {name: reason for part in measured.values() for name, reason in part.left_out.items()}


def _share(figures: Mapping[str, float]) -> str:
    share = figures.get("feasible_fraction")
    return "–" if share is None else f"{share:.0%}"
