"""Inference-time search: planners and search runs."""

from typing import TYPE_CHECKING

from scene_envs.registry import lazy_names

if TYPE_CHECKING:
    from agents.planning.evolution import EvolutionPlanner
    from agents.planning.gradient import GradientPlanner
    from agents.planning.ledger import (
        PlannerSettings,
        PlanResult,
        Searchable,
        SearchBudget,
        SearchStoppedError,
        list_planners,
        register_planner,
    )
    from agents.planning.mcts import MCTSPlanner
    from agents.planning.output import SearchRecord, TreeNode
    from agents.planning.search_run import SearchOutcome, run_search
    from agents.planning.session import Journal, Session
    from agents.planning.settings import SearchConfig
    from agents.planning.simple import BeamPlanner, BestOfPlanner, GreedyPlanner

__all__ = [
    "BeamPlanner",
    "BestOfPlanner",
    "EvolutionPlanner",
    "GradientPlanner",
    "GreedyPlanner",
    "Journal",
    "MCTSPlanner",
    "PlanResult",
    "PlannerSettings",
    "SearchBudget",
    "SearchConfig",
    "SearchOutcome",
    "SearchRecord",
    "SearchStoppedError",
    "Searchable",
    "Session",
    "TreeNode",
    "list_planners",
    "register_planner",
    "run_search",
]

__getattr__ = lazy_names(__name__, __file__)
