"""Inference-time search: trees, planners and search runs."""

from typing import TYPE_CHECKING

from scene_envs.lazy import lazy_names

if TYPE_CHECKING:
    from agents.planning.config import PlannerSettings, SearchConfig, list_planners, register_planner
    from agents.planning.planners import BestOfPlanner, PlanResult, Searchable, UCTPlanner
    from agents.planning.search_run import SearchOutcome, run_search
    from agents.planning.tree import Node, Tree

__all__ = [
    "BestOfPlanner",
    "Node",
    "PlanResult",
    "PlannerSettings",
    "SearchConfig",
    "SearchOutcome",
    "Searchable",
    "Tree",
    "UCTPlanner",
    "list_planners",
    "register_planner",
    "run_search",
]

__getattr__ = lazy_names(
    __name__,
    {
        "agents.planning.config": ("PlannerSettings", "SearchConfig", "list_planners", "register_planner"),
        "agents.planning.planners": ("BestOfPlanner", "PlanResult", "Searchable", "UCTPlanner"),
        "agents.planning.search_run": ("SearchOutcome", "run_search"),
        "agents.planning.tree": ("Node", "Tree"),
    },
)
