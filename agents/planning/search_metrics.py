"""Figures of a search run: what ``metrics.json`` holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from agents.planning.config import SearchConfig
from agents.planning.ledger import PlanResult
from scene_envs.envs import SearchState
from scene_envs.files import finite


def loss_of(plan: PlanResult) -> float:
    """Less for a better plan; the most where nothing could be scored."""
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
        objective: what was searched for.
        scale: objective at Φ = 1.
        config: the settings.
        searches: all plans.
        best_of: the baseline; None without one.
        firsts: by the seed of a search, the best of its first samples, or the scene it started from.
        seconds: of the search and of the baseline.
        stopped: why it ended early; empty where it did not.
        spent: scenes generated.
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
