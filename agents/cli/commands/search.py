"""``scene-envs search``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from agents.cli.run_folder import Run
from agents.configuration.composition import ProgressKeys, RewardLimitKeys, composed, named
from agents.planning.settings import SearchConfig

if TYPE_CHECKING:
    from scene_envs.progress import Progress


@composed
@dataclass
class SearchKeys(SearchConfig, RewardLimitKeys, ProgressKeys):
    """Inputs and output of a search.

    Attributes:
        scenes: scenes from which the search starts, one search for each: a scene file, a folder of scene files, the
            folder of a run that holds scenes, or a dataset; empty for fresh samples.
        prior: a shipped name, or the folder of a prior or a run; empty takes the shipped prior of the scenes' type, or
            dimsum_table without scenes.
        objective: reward that the search maximises.
        output: folder for best.safetensors, tree.html, tree.json and pictures; the same command resumes an interrupted
            search.
    """

    scenes: str = ""
    prior: str = ""
    objective: Any = named("feasible_objects", "reward")
    output: str = ""


def run(settings: SearchKeys, run: Run) -> None:
    """Search; the search writes its own metrics and pictures."""
    from agents.planning import run_search
    from agents.utils.interrupts import Terminated
    from rewards.process import close_reward, is_foreign
    from scene_envs.datasets import load_scenes

    search = SearchConfig(**{field.name: getattr(settings, field.name) for field in fields(SearchConfig)})
    scenes = load_scenes(Path(settings.scenes), settings.count) if settings.scenes else None
    prior = settings.prior or ("dimsum_table" if scenes is None else scenes.scene_type.name)
    objective = settings.objective
    if is_foreign(objective):
        objective = settings.running(objective)
    with _search_progress(search.nfe_per_scene, settings.progress) as show:
        try:
            outcome = run_search(prior, objective, config=search, scenes=scenes, output=settings.output, progress=show)
        finally:
            close_reward(objective)
    metrics = outcome.metrics
    run.say(_summary(metrics, search.branching))
    if len(outcome.searches) > 1:
        run.say(f"best scenes of {len(outcome.searches)} searches: {_listed(metrics['searches'])}")
    if len(outcome.searches) > 1 and "start" in metrics:
        run.say(f"they started from: {_listed([plan['start'] for plan in metrics['searches']])}")
    if metrics["saturated"]:
        run.say(
            f"that is beyond objective_scale={metrics['objective_scale']:.4g}, where the search takes a scene for "
            "perfect and ends; raise objective_scale to search on"
        )
    if metrics["below_zero"]:
        low = 2 * metrics["search"]["objective"]
        run.say(
            "that is below 0, where the search tells no scenes apart, so that it was chance; shift the objective, as "
            f"objective='{{name: weighted_sum, rewards: [{metrics['objective']}], offset: {-low:.4g}}}' "
            f"objective_scale={-1.1 * low:.4g}"
        )
    if settings.baseline and "best_of" not in metrics and metrics["stopped"] in (None, "time"):
        run.say("the baseline, as many independent samples, is left out: max_seconds would end before it does")
    if metrics["stopped"] == "time":
        run.say(f"ended after max_seconds={search.max_seconds:g}; the same command with more time goes on")
    run.say(f"written to {run.directory}")
    if metrics["stopped"] in ("interrupt", "terminated"):
        run.write_config()
        raise Terminated if metrics["stopped"] == "terminated" else KeyboardInterrupt


@contextmanager
def _search_progress(nfe_per_scene: int, style: str) -> Iterator[Callable[[str, int, int, float], None]]:
    """A bar, or lines, for each planner in turn; yields the function that advances it.

    The function is called with the planner, the scenes made, the scenes that will be made, and the best value.
    """
    from scene_envs.progress import Progress

    with ExitStack() as stack:
        shown: dict[str, Progress] = {}

        def show(planner: str, done: int, budget: int, best: float) -> None:
            if planner not in shown:
                stack.close()  # the bar of the planner before
                shown.clear()
                shown[planner] = stack.enter_context(Progress(planner, budget, style=style, always=(budget,)))
            text = f"best {best:.3f}, {done * nfe_per_scene} NFE"
            shown[planner].update(done, text, f"{planner}: {done}/{budget} scenes, {text}")

        yield show


def _summary(metrics: Mapping[str, Any], branching: int) -> str:
    """Result of the search, beside the baseline and the start."""
    best_of = f"{_figure(metrics['best_of'])} by as many samples, " if "best_of" in metrics else ""
    first = (
        f"{_figure(metrics['start'])} at the start"
        if "start" in metrics
        else f"{_figure(metrics['first_samples'])} by the best of the first {branching}"
    )
    return (
        f"{metrics['objective']}: {_figure(metrics['search'])} by {metrics['planner']} with {metrics['nfe']} denoiser "
        f"evaluations, {best_of}{first}"
    )


def _listed(plans: list[Mapping[str, Any]]) -> str:
    """The objective of the first sixteen plans and of the last one."""
    return ", ".join(map(_figure, plans[:16])) + (f", ..., {_figure(plans[-1])}" if plans[16:] else "")


def _figure(of: Mapping[str, Any]) -> str:
    return "not scored" if of["objective"] is None else f"{of['objective']:.4g}"
