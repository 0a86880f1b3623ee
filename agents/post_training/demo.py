"""Demonstration: the shipped Dimsum prior steered toward clutter and toward feasible placement, with a report."""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from agents.post_training.comparison import Measured, draw_side_by_side, measure_prior, number_rows
from agents.post_training.comparison_run import PHYSICS_TIMEOUT, SAMPLE_SEED, say_stage
from agents.post_training.config import PostTrainConfig
from agents.post_training.report import Page, Picture, Section, Tile, write_report
from agents.post_training.run_files import write_metrics
from agents.post_training.side_by_side import post_train_side_by_side
from agents.post_training.trainer import PostTrainResult
from agents.priors.base import ScenePrior
from rewards import reward_label

RUNS = ("clutter", "feasible")
"""Names of the two runs: their folders, and the columns of the report. Their recipes are ``demo_<name>``."""


def run_demo(
    output: str | Path = "runs/demo",
    seed: int = 0,
    workers: int = 2,
    *,
    device: str = "cpu",
    progress: str = "bar",
    scenes: int = 24,
    num_steps: int = 50,
    recipes: Mapping[str, PostTrainConfig] | None = None,
    prior: ScenePrior | None = None,
) -> dict[str, Any]:
    """Post-train a prior in two ways side by side, measure all three priors on fresh samples, and write the report.

    All priors start from the same noise, and every sample is measured. Physics decides which objects are
    simulation-ready.

    Args:
        output: folder for ``report.html``, ``metrics.json``, the pictures, and one folder per run, ``clutter`` and
            ``feasible``, which ``prior=`` loads. An interrupted demonstration is resumed.
        seed: seed of training, from which the seed of the measured samples is derived.
        workers: physics worker processes, of both runs together while they train.
        device: torch device of the networks.
        progress: style of the progress display of both runs, as in :class:`~scene_envs.progress.Progress`.
        scenes: fresh samples measured of each prior.
        num_steps: denoiser evaluations per measured sample.
        recipes: the runs by name, in place of ``configs/recipe/demo_clutter.yaml`` and ``demo_feasible.yaml``.
        prior: prior to start from, in place of the one that the recipes name.

    Returns:
        The numbers of ``metrics.json``: those of ``measure_prior`` for ``base`` and each run, ``runs`` (the metrics of
        each run), and ``seconds``.
    """
    from scene_envs.physics import make_pool

    directory, started = Path(output), time.perf_counter()
    recipes = recipes or {name: PostTrainConfig(recipe=f"demo_{name}") for name in RUNS}
    each = -(-workers // len(recipes))
    configs = {
        name: replace(recipe, output=str(directory / name), seed=seed, workers=each, device=device, progress=progress)
        for name, recipe in recipes.items()
    }
    base = ScenePrior.load(next(iter(configs.values())).prior if prior is None else prior)
    for name, config in configs.items():
        say_stage(config, f"{name}: post-training toward {_goal(config)} with {_algorithm(config)}")
    measured: dict[str, Measured] = {}
    results: dict[str, PostTrainResult] = {}
    with make_pool(workers, PHYSICS_TIMEOUT) as pool, closing(post_train_side_by_side(configs, base)) as runs:
        for name, results[name] in runs:  # the other run goes on while samples are measured
            for label, tested in {"base": base, name: results[name].prior}.items():
                if label not in measured:
                    say_stage(configs[name], f"measuring {scenes} samples of the prior {label!r}")
                    measured[label] = measure_prior(
                        tested, scenes, num_steps=num_steps, seed=seed + SAMPLE_SEED, pool=pool
                    )
    measured = {name: measured[name] for name in ("base", *recipes)}
    results = {name: results[name] for name in recipes}
    metrics = {
        **{name: part.figures for name, part in measured.items()},
        "runs": {name: result.metrics for name, result in results.items()},
        "seconds": round(time.perf_counter() - started, 1),
        "num_steps": num_steps,
    }
    write_report(directory / "report.html", _page(directory, base, results, measured))
    write_metrics(directory, metrics)
    return metrics


def _page(
    directory: Path, base: ScenePrior, results: Mapping[str, PostTrainResult], measured: Mapping[str, Measured]
) -> Page:
    """Content of the report; also writes its pictures to ``directory``."""
    runs = " and ".join(
        f"{_goal(result.config)} ({_algorithm(result.config)}, {len(result.history)} iterations)"
        for result in results.values()
    )
    before = measured["base"].figures
    tiles = []
    for name, result in results.items():
        after, ratio = measured[name].figures, result.metrics["guard"]["ratio"]
        tiles += [
            Tile(f"{name}: objects per scene", f"{after['objects']:.1f}", f"from {before['objects']:.1f}"),
            Tile(f"{name}: feasible as sampled", _share(after), f"of free objects, from {_share(before)}"),
            Tile(f"{name}: held-out loss", f"{ratio:.2f}×", "of the base prior"),
        ]
    raw = draw_side_by_side(measured, directory / "samples.png")
    ready = draw_side_by_side(measured, directory / "ready.png", ready=True)
    count = int(before["scenes"])
    sections = [
        Section(
            "As sampled",
            "The first samples of each prior, untouched. The scenes of a row start from the same noise.",
            [Picture(raw, "Columns: " + ", ".join(measured))],
        ),
        Section(
            "Simulation-ready",
            "The same samples, projected out of penetration and settled. Red objects are not ready: they still move, "
            "penetrate, or have left the workspace.",
            [Picture(ready, "Columns: " + ", ".join(measured))],
        ),
        Section(
            "Numbers", f"Means over {count} samples.", table=number_rows({n: m.figures for n, m in measured.items()})
        ),
        Section(
            "The curves",
            "Reward of each batch, and the held-out pretraining loss over that of the base prior.",
            [
                Picture(result.directory / "curve.png", f"{name}: {_goal(result.config)}")
                for name, result in results.items()
            ],
        ),
    ]
    title = f"{base.scene_type.name.replace('_', ' ').capitalize()}, steered two ways"
    lead = (
        f"One prior, post-trained toward {runs}, each with the pretraining loss on real scenes as regularisation. "
        f"All numbers are means over {count} fresh, seeded samples of each prior; none was selected."
    )
    settings = {
        f"{name}: {key}": value for name, result in results.items() for key, value in result.config.plain().items()
    }
    return Page(title, lead, tiles, sections, settings)


def _share(figures: Mapping[str, float]) -> str:
    share = figures.get("feasible_fraction")
    return "–" if share is None else f"{share:.0%}"


def _goal(config: PostTrainConfig) -> str:
    return reward_label(config.reward)


def _algorithm(config: PostTrainConfig) -> str:
    return config.algorithm.name.upper().replace("_", "-")
