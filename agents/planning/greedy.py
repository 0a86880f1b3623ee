"""Greedy repair: the planner that repeatedly inpaints the best state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from agents.planning.ledger import Candidate, PlanResult, Progress, Searchable, SearchBudget
from agents.planning.registry import PlannerSettings, check_at_least, register_planner


@register_planner("greedy")
@dataclass(frozen=True)
class GreedyPlanner(PlannerSettings):
    """Iterated repair of one state.

    A round takes the next ``children`` inpaintings of the current state. The best of them becomes the current state
    unless it scores less. A child with the same score becomes the current state, because its mask regenerates other
    slots. If the current state has no action left, the best earlier state with an action left replaces it.

    Attributes:
        children: number of inpaintings per round, one batch of the denoiser; null takes ``branching``.
    """

    name: str = "greedy"
    widens = True
    children: int | None = None

    def __post_init__(self) -> None:
        check_at_least(self, 1, "children")

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state."""
        search, count = SearchBudget(problem, budget, progress), self.children or 1
        # earlier states and the current one (last), each with its remaining actions
        trail: list[tuple[Candidate, Sequence[int]]] = [(search.root, search.actions(search.root))]
        while search.left and trail:
            state, actions = trail.pop()
            if not actions:
                continue
            children = search.expand([(state, action) for action in actions[:count]])
            trail.append((state, actions[count:]))
            scored = [child for child in children if child.valid]
            best = max(scored, key=lambda child: child.value, default=None)
            if best is not None and not best.value < state.value:
                trail.append((best, search.actions(best)))
        return search.result()
