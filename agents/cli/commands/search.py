"""``scene-envs search``."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

from agents.configuration.fields import composed, named
from agents.planning.config import SearchConfig

if TYPE_CHECKING:
    from agents.cli.run_folder import Run


@composed
@dataclass(frozen=True)
class SearchKeys(SearchConfig):
    """What to search, and how.

    Attributes:
        prior: a shipped name, or the folder of a prior or a run.
        objective: what the scene should score high on: any reward.
        reward_timeout: seconds that an objective from outside this package, which runs in a process of its own, may
            take for a batch; then its scenes are invalid.
        reward_memory: GiB that such an objective may allocate.
        output: folder for best.safetensors, tree.html, tree.json and pictures; the same command goes on there.
    """

    prior: str = "dimsum_table"
    objective: Any = named("feasible_objects", "reward")
    reward_timeout: float = 60.0
    reward_memory: float = 1.0
    output: str = ""


def run(settings: SearchKeys, run: Run) -> None:
    """Search; the search writes its own metrics and pictures."""
    from rich.console import Console
    from rich.progress import Progress

    from agents.planning import run_search
    from agents.utils.interrupts import Terminated
    from rewards.isolation import close_reward, is_foreign, run_reward

    search = SearchConfig(**{field.name: getattr(settings, field.name) for field in fields(SearchConfig)})
    limits = {"timeout": settings.reward_timeout, "memory": settings.reward_memory}
    objective = settings.objective
    if is_foreign(objective):
        objective = run_reward(objective, seed=settings.seed, workers=settings.workers, **limits)
    with Progress(console=Console(stderr=True)) as bar:
        tasks: dict[str, Any] = {}

        def show(planner: str, done: int, budget: int, best: float) -> None:
            if planner not in tasks:
                tasks[planner] = bar.add_task(planner, total=budget)
            nfe = f"{done * search.nfe_per_scene} NFE"
            bar.update(tasks[planner], completed=done, description=f"{planner}, best {best:.3f}, {nfe}")

        try:
            outcome = run_search(settings.prior, objective, config=search, output=settings.output, progress=show)
        finally:
            close_reward(objective)
    metrics = outcome.metrics
    found, first = (metrics[key]["objective"] for key in ("search", "first_samples"))
    best_of = "" if outcome.best_of is None else f"{metrics['best_of']['objective']:.4g} by as many samples, "
    run.say(
        f"{metrics['objective']}: {found:.4g} by {metrics['planner']} with {metrics['nfe']} denoiser evaluations, "
        f"{best_of}{first:.4g} by the best of the first {search.branching}"
    )
    if len(outcome.searches) > 1:
        found = [plan.best_state.objective for plan in outcome.searches]
        each = ", ".join(f"{objective:.4g}" for objective in found[:16])
        run.say(f"best scenes of {len(found)} searches: {each}" + (f", ..., {found[-1]:.4g}" if found[16:] else ""))
    if metrics["saturated"]:
        run.say(
            f"that is beyond objective_scale={metrics['objective_scale']:.4g}, where the search takes a scene for "
            "perfect and ends; raise objective_scale to search on"
        )
    if metrics["below_zero"]:
        low = 2 * metrics["search"]["objective"]
        run.say(
            "that is below 0, where the search tells no scenes apart, so that it was chance; shift the objective, as "
            f"objective='{{name: normalised, reward: {metrics['objective']}, mean: {low:.4g}, std: {-1.1 * low:.4g}}}' "
            "objective_scale=1"
        )
    if metrics["stopped"] == "time":
        run.say(f"ended after max_seconds={search.max_seconds:g}; the same command with more time goes on")
    run.say(f"written to {run.directory}")
    if metrics["stopped"] in ("interrupt", "terminated"):
        raise Terminated if metrics["stopped"] == "terminated" else KeyboardInterrupt
