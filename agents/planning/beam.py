"""Beam search: the planner that inpaints the best few states in each round."""

from __future__ import annotations

from dataclasses import dataclass

from agents.planning.ledger import Member, PlanResult, Progress, Searchable, SearchBudget, best_different
from agents.planning.registry import PlannerSettings, check_at_least, register_planner


@register_planner("beam")
@dataclass(frozen=True)
class BeamPlanner(PlannerSettings):
    """Beam search in which parents compete with their children.

    A round expands ``children`` inpaintings of each of the ``width`` best states. Expanded states compete with the new
    ones, and are inpainted again while they are among the best. If two states have equal values, the newer one is kept.
    A scene is in the beam only once.

    Attributes:
        width: number of states that are kept.
        children: number of inpaintings per state and round; null takes ``branching``.
    """

    name: str = "beam"
    widens = True
    width: int = 3
    children: int | None = None

    def __post_init__(self) -> None:
        check_at_least(self, 1, "width", "children")

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state."""
        search, count = SearchBudget(problem, budget, progress), self.children or 1
        beam: list[Member] = [(search.root, search.actions(search.root))]
        while search.left and beam:
            children = search.expand([(state, action) for state, actions in beam for action in actions[:count]])
            pool = [(child, search.actions(child)) for child in reversed(children) if child.valid]
            pool += [(state, actions[count:]) for state, actions in beam if state.valid or not pool]
            beam = best_different(pool, self.width)
        return search.result()
