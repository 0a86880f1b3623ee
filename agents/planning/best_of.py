"""Best of N: the planner that draws independent samples."""

from __future__ import annotations

from dataclasses import dataclass

from agents.planning.ledger import PlanResult, Progress, Searchable, SearchBudget
from agents.planning.registry import PlannerSettings, check_at_least, register_planner


@register_planner("best_of")
@dataclass(frozen=True)
class BestOfPlanner(PlannerSettings):
    """Best of N independent samples: expands every action of the root once, in order, and nothing else.

    This is the baseline of a search at equal NFE. The root needs at least ``budget`` actions. If the problem seeds
    children by their path, the first samples are the same as with any other planner.

    Attributes:
        parallel: number of scenes per batch of the denoiser.
    """

    name: str = "best_of"
    widens = True
    parallel: int = 16

    def __post_init__(self) -> None:
        check_at_least(self, 1, "parallel")

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions, or as many as the root has actions."""
        search = SearchBudget(problem, budget, progress)
        actions = search.actions(search.root)[:budget]
        for start in range(0, len(actions), self.parallel):
            search.expand([(search.root, action) for action in actions[start : start + self.parallel]])
        return search.result()
