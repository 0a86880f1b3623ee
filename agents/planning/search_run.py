"""Search run: a tree of inpaintings and best-of-N at equal NFE, with output files."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from agents.configuration.tree import config_text, plain_tree
from agents.planning.config import SearchConfig
from agents.planning.planners import BestOfPlanner, PlanResult
from agents.planning.search_report import draw_curve, draw_scene
from scene_envs.envs import SearchEnv
from scene_envs.envs.resolvers import resolve_prior
from scene_envs.errors import InvalidInputError, SceneEnvsError
from scene_envs.files import finite, write_json, write_text
from scene_envs.scene import SceneBatch

_PLAIN = (bool, int, float, str, list, dict, type(None))
"""What YAML takes."""

Progress = Callable[[str, int, int, float], None]
"""Called after every round with the planner's name, the expansions so far, the budget and the best Φ so far."""


@dataclass(frozen=True)
class SearchOutcome:
    """Result of a search run.

    Attributes:
        search: the tree search.
        best_of: best of ``budget`` independent samples, the baseline at equal NFE.
        first: the best of the first ``branching`` samples, a batch of one.
        best: the best scene of the search, a batch of one.
        metrics: what ``metrics.json`` holds.
    """

    search: PlanResult
    best_of: PlanResult
    first: SceneBatch
    best: SceneBatch
    metrics: dict[str, Any]


def run_search(
    prior: Any,
    objective: Any = "feasible_objects",
    *,
    config: SearchConfig | None = None,
    output: str | Path | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> SearchOutcome:
    """Search for a scene that scores high, starting from nothing but the prior.

    The root is the scene with fixed welded objects alone, so its children are fresh samples. From there UCT
    regenerates what the objective blames (Pfaff et al. 2025, inference-time search). The same seed and settings give
    the same tree.

    Args:
        prior: a prior, or the name or path of one.
        objective: any reward: name, mapping, function or object.
        config: the settings; or give its fields as keywords.
        output: folder for ``curve.png``, ``before.png``, ``after.png``, ``best.safetensors``, ``metrics.json`` and
            ``config.yaml``, in which functions and objects are left out; None writes nothing.
        progress: told of every round.
        **settings: fields of :class:`SearchConfig`.

    Raises:
        SceneEnvsError: no scene could be scored.
    """
    if config is not None and settings:
        raise InvalidInputError(f"give config= or single settings, not both (got {', '.join(sorted(settings))})")
    config = SearchConfig(**settings) if config is None else config
    started = time.perf_counter()
    env, search = _plan(
        prior, objective, config, config.planner.make(config.branching), config.branching, "search", progress
    )
    searched = time.perf_counter()
    baseline = BestOfPlanner(parallel=max(16, config.branching))
    # A root with as many actions as the budget: the same seeds by path, so the first scenes are the tree's.
    _, best_of = _plan(env.problem.prior, objective, config, baseline, config.budget, "best of N", progress)
    seconds = {"search": searched - started, "best_of": time.perf_counter() - searched}
    if search.tree is None:  # a planner without a tree: its first scenes once more
        first = _plan(env.problem.prior, objective, config, baseline, config.branching, "first", None)[1].best_state
    else:
        first = _best_first(search)
    if first is None or search.best_path == ():
        raise SceneEnvsError(
            f"the objective {objective!r} could not score any of the first {config.branching} samples of the prior; "
            "the log above says why"
        )
    outcome = SearchOutcome(
        search=search,
        best_of=best_of,
        first=env.scene(first),
        best=env.scene(search.best_state),
        metrics=_metrics(objective, env.problem.scale, config, search, best_of, first, seconds),
    )
    if output is not None:
        _write(outcome, config, first, search.best_state, Path(output))
        named = {"prior": prior, "objective": objective, **plain_tree(config)}
        plain = {key: value for key, value in named.items() if isinstance(value, _PLAIN)}
        write_text(Path(output) / "config.yaml", config_text(plain))
    return outcome


def _plan(
    prior: Any,
    objective: Any,
    config: SearchConfig,
    planner: Any,
    branching: int,
    name: str,
    progress: Progress | None,
) -> tuple[SearchEnv, PlanResult]:
    prior = resolve_prior(prior)
    env = SearchEnv(
        scene=prior.scene_type,
        objective=objective,
        branching=branching,
        max_depth=config.max_depth,
        num_steps=config.num_steps,
        prior=prior,
        slots=config.slots,
        mask=config.mask,
        objective_scale=config.objective_scale,
        workers=config.workers,
        prompt=config.prompt,
        guidance=config.guidance,
    )
    try:
        env.reset(seed=config.seed, options={"scene": SceneBatch.empty(prior.scene_type, 1, env.problem.slots)})
        told = None if progress is None else lambda done, best: progress(name, done, config.budget, best)
        return env, planner.plan(env, config.budget, told)
    finally:
        env.close()


def _best_first(search: PlanResult) -> Any:
    """The best state among the children of the root, or None."""
    assert search.tree is not None
    children = [node for _, node in sorted(search.tree.root.children.items())]
    return max(children, key=lambda node: node.value or 0.0).state if children else None


def _metrics(
    objective: Any,
    scale: float,
    config: SearchConfig,
    search: PlanResult,
    best_of: PlanResult,
    first: Any,
    seconds: dict[str, float],
) -> dict[str, Any]:
    return {
        "objective": objective if isinstance(objective, str) else getattr(objective, "__name__", repr(objective)),
        "objective_scale": scale,
        "nfe": len(search.values) * config.nfe_per_scene,
        "first_samples": {"value": first.value, "objective": first.objective},
        "search": {
            "value": search.best_value,
            "objective": search.best_state.objective,
            "path": list(search.best_path),
            "expansions": len(search.values),
            "invalid": sum(map(math.isnan, search.values)),
            "curve": finite(search.curve),
        },
        "best_of": {
            "value": best_of.best_value,
            "objective": best_of.best_state.objective,
            "expansions": len(best_of.values),
            "invalid": sum(map(math.isnan, best_of.values)),
            "curve": finite(best_of.curve),
        },
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
    }


def _write(outcome: SearchOutcome, config: SearchConfig, first: Any, best: Any, output: Path) -> None:
    write_json(output / "metrics.json", outcome.metrics, indent=2)
    outcome.best.save(output / "best.safetensors")
    draw_curve(
        {"tree search": outcome.search.curve, "best of N": outcome.best_of.curve},
        output / "curve.png",
        num_steps=config.nfe_per_scene,
        first=config.branching,
        scale=outcome.metrics["objective_scale"],
        label=str(outcome.metrics["objective"]).replace("_", " "),
    )
    draw_scene(outcome.first, first, output / "before.png")
    draw_scene(outcome.best, best, output / "after.png")
