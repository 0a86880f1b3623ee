"""Inference-time search: trees, planners and search runs."""

from agents.planning.planners import BestOfPlanner, PlanResult, Searchable, UCTPlanner
from agents.planning.search_run import SearchConfig, SearchOutcome, run_search
from agents.planning.tree import Node, Tree

__all__ = [
    "BestOfPlanner",
    "Node",
    "PlanResult",
    "SearchConfig",
    "SearchOutcome",
    "Searchable",
    "Tree",
    "UCTPlanner",
    "run_search",
]
