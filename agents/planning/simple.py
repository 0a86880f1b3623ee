"""Planners that need no more than a budget: best of N, beam search and greedy repair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from agents.planning.ledger import (
    Candidate,
    Member,
    PlannerSettings,
    PlanResult,
    Progress,
    Searchable,
    SearchBudget,
    best_different,
    register_planner,
)
from scene_envs.errors import Count


@register_planner("best_of")
@dataclass(frozen=True)
class BestOfPlanner(PlannerSettings):
    """Best of N independent samples: expands every action of the root once, in order, and nothing else.

    This is the baseline of a search at equal NFE. The root needs at least ``budget`` actions. If the problem seeds
    children by their path, the first samples are the same as with any other planner.

    Attributes:
        parallel: number of scenes per batch of the denoiser; large batches cost less per scene.
    """

    name: str = "best_of"
    widens = True
    parallel: Count = 64

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions, or as many as the root has actions."""
        search = SearchBudget(problem, budget, progress)
        actions = search.actions(search.root)[:budget]
        for start in range(0, len(actions), self.parallel):
            search.expand([(search.root, action) for action in actions[start : start + self.parallel]])
        return search.result()


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
    width: Count = 3
    children: Count | None = None

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
    children: Count | None = None

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
