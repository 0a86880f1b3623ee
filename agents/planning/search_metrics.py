"""Figures of a search run: the content of ``metrics.json``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from agents.planning.config import SearchConfig
from agents.planning.ledger import PlanResult
from scene_envs.envs import SearchState
from scene_envs.files import finite


def loss_of(plan: PlanResult) -> float:
    """Minus the best value of a plan; infinity if no scene could be scored."""
    return -plan.best_value if math.isfinite(plan.best_value) else math.inf


def search_metrics(
    objective: Any,
    scale: float,
    config: SearchConfig,
    searches: Sequence[PlanResult],
    best_of: PlanResult | None,
    firsts: dict[int, SearchState],
    seconds: dict[str, float],
    stopped: str,
    spent: int,
    from_scenes: bool,
) -> dict[str, Any]:
    """The figures of a run.

    Args:
        objective: the objective of the search.
        scale: objective at Φ = 1.
        config: the settings.
        searches: all plans.
        best_of: the baseline; None without one.
        firsts: best of the first samples of each search, or the scene it started from, by the seed of the search.
        seconds: duration of the search and the baseline.
        stopped: reason for which the run ended early; empty if it did not.
        spent: number of scenes generated.
        from_scenes: whether the searches started from given scenes.
    """
    search = min(searches, key=loss_of)
    first = firsts[search.best_state.seed]
    metrics = {
        "objective": objective if isinstance(objective, str) else getattr(objective, "__name__", repr(objective)),
        "objective_scale": scale,
        "saturated": search.best_state.objective > scale,
        "below_zero": search.best_state.objective < 0,
        "planner": config.planner.name,
        "stopped": stopped or None,
        "nfe": spent * config.nfe_per_scene,
        "start" if from_scenes else "first_samples": _of_state(first),
        "search": _of_plan(search),
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
    }
    if len(searches) > 1:
        metrics["searches"] = [
            _of_plan(plan) | ({"start": _of_state(firsts[plan.best_state.seed])} if from_scenes else {})
            for plan in searches
        ]
    if best_of is not None:
        metrics["best_of"] = _of_plan(best_of)
    return metrics


def _of_state(state: SearchState) -> dict[str, float | None]:
    return {"value": state.value, "objective": state.objective} if state.valid else {"value": None, "objective": None}


def _of_plan(plan: PlanResult) -> dict[str, Any]:
    return {
        **_of_state(plan.best_state),
        "path": list(plan.best_path),
        "expansions": len(plan.values),
        "invalid": sum(map(math.isnan, plan.values)),
        "curve": finite(plan.curve),
    }
