"""Inference-time search: planners and search runs."""

from typing import TYPE_CHECKING

from scene_envs.lazy import lazy_names

if TYPE_CHECKING:
    from agents.planning.beam import BeamPlanner
    from agents.planning.best_of import BestOfPlanner
    from agents.planning.config import SearchConfig
    from agents.planning.evolution import EvolutionPlanner
    from agents.planning.feynman_kac import FeynmanKacPlanner
    from agents.planning.gradient import GradientPlanner
    from agents.planning.greedy import GreedyPlanner
    from agents.planning.journal import Journal
    from agents.planning.ledger import Ledger, PlanResult, Searchable, SearchStoppedError
    from agents.planning.mcts import MCTSPlanner
    from agents.planning.registry import PlannerSettings, list_planners, register_planner
    from agents.planning.search_run import SearchOutcome, run_search
    from agents.planning.session import Session
    from agents.planning.tree_file import SearchRecord, TreeNode

__all__ = [
    "BeamPlanner",
    "BestOfPlanner",
    "EvolutionPlanner",
    "FeynmanKacPlanner",
    "GradientPlanner",
    "GreedyPlanner",
    "Journal",
    "Ledger",
    "MCTSPlanner",
    "PlanResult",
    "PlannerSettings",
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
