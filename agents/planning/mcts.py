"""MCTS as published: the planner that makes all children of a leaf at once, and backs up the value of one or of all."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

from agents.planning.ledger import (
    Candidate,
    PlannerSettings,
    PlanResult,
    Progress,
    Searchable,
    SearchBudget,
    register_planner,
    state_value,
)
from scene_envs.errors import Count, Natural, OneOf, at_least


@dataclass(eq=False)
class _Node:
    candidate: Candidate
    parent: _Node | None = None
    children: list[_Node] = field(default_factory=list)
    visits: int = 0
    total: float = 0.0
    closed: bool = False


@register_planner("mcts")
@dataclass(frozen=True)
class MCTSPlanner(PlannerSettings):
    """Monte Carlo tree search of Pfaff et al. (2025), inference-time search.

    An iteration descends to a leaf by ``mean + exploration * sqrt(2 ln(visits of the parent) / visits)``; children
    without a visit come first. It makes all ``children`` of the leaf in one batch, and backs up the value of a random
    child, or of all children. The search stops at a state in which nothing is masked. Objects that are still masked in
    the best state are removed from the result, if the problem has ``without_masked`` and the objective does not fall.

    Attributes:
        exploration: weight of the bound. Values are in [0, 1] and siblings differ by a few hundredths; with the
            textbook value, 1, the bound outweighs these differences and the tree grows in breadth.
        children: number of children of a leaf; null takes ``branching``.
        rollout: value that is backed up: ``random`` for that of one new child, ``all`` for those of all new children.
        seed: seed of the choice of the child, together with the seed of the root.
    """

    name: str = "mcts"
    widens = True
    exploration: Annotated[float, at_least(0)] = 0.1
    children: Count | None = None
    rollout: Annotated[str, OneOf(("random", "all"))] = "all"
    seed: Natural = 0

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the problem's current state."""
        search = SearchBudget(problem, budget, progress)
        rng = search.generator(self.seed)
        root = _Node(search.root)
        while search.left and not root.closed:
            leaf = self._select(root)
            actions = search.actions(leaf.candidate)[: self.children or 1]
            mask = getattr(leaf.candidate.state, "mask", None)
            if not actions and mask is not None and not bool(mask.any()):
                break
            made = search.expand([(leaf.candidate, action) for action in actions])
            leaf.children = [_Node(child, leaf) for child in made if child.valid]
            if not leaf.children:
                _close(leaf)
                continue
            rolled = leaf.children if self.rollout == "all" else [leaf.children[rng.integers(len(leaf.children))]]
            for node in rolled:
                _back_up(node, node.candidate.value)
        return _cleaned(problem, search.result())

    def _select(self, node: _Node) -> _Node:
        while node.children:
            weight = self.exploration * math.sqrt(2.0 * math.log(max(1, node.visits)))
            node = max(
                (child for child in node.children if not child.closed),
                key=lambda c: c.total / c.visits + weight / math.sqrt(c.visits) if c.visits else math.inf,
            )
        return node


def _back_up(node: _Node | None, value: float) -> None:
    while node is not None:
        node.visits += 1
        node.total += value
        node = node.parent


def _close(node: _Node) -> None:
    """Exclude a leaf without children from the search, and every node above it whose children are all closed."""
    current: _Node | None = node
    while current is not None and all(child.closed for child in current.children):
        current.closed = True
        current = current.parent


def _cleaned(problem: Searchable, result: PlanResult) -> PlanResult:
    """``result`` with the masked objects removed from its best state, unless the state then scores less."""
    remove = getattr(problem, "without_masked", None)
    if remove is None or not result.best_path:
        return result
    cleaned = remove(result.best_state)
    value = state_value(problem, cleaned)
    return replace(result, best_state=cleaned, best_value=value) if value >= result.best_value else result
