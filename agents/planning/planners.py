"""Planners over the public methods of a search environment, with a budget in expansions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from agents.planning.tree import Node, Tree
from scene_envs.errors import InvalidInputError

Progress = Callable[[int, float], None]
"""Called after every round with the expansions so far and the best value so far."""


_ROOT: tuple[int, ...] = ()


class Searchable(Protocol):
    """Protocol of the trees that a planner searches, such as ``scene_envs.envs.SearchEnv``.

    States are immutable. A state with an attribute ``valid`` that is False could not be scored: it is counted and
    left out of the tree.
    """

    def clone_state(self) -> Any:
        """The current state, the root of the plan."""
        ...

    def legal_actions(self, state: Any) -> Sequence[int]:
        """Actions that can be expanded from ``state``; none at a leaf."""
        ...

    def expand_batch(self, pairs: Sequence[tuple[Any, int]]) -> Sequence[Any]:
        """The child of every (state, action) pair."""
        ...

    def evaluate(self, state: Any) -> float:
        """The objective of ``state``, in [0, 1]."""
        ...


@dataclass
class PlanResult:
    """Result of a planner.

    Attributes:
        best_state: the state with the highest objective.
        best_value: its objective.
        best_path: the actions that lead to it from the root.
        values: objective of every expansion in the order they were made; NaN where it failed.
        tree: the search tree, for planners that keep one.
    """

    best_state: Any
    best_value: float
    best_path: tuple[int, ...]
    values: list[float]
    tree: Tree | None = field(default=None, repr=False)

    @property
    def curve(self) -> list[float]:
        """Best objective after each expansion; failed ones leave it as it was."""
        best, curve = -math.inf, []
        for value in self.values:
            best = max(best, value) if math.isfinite(value) else best
            curve.append(best)
        return curve


@dataclass(frozen=True)
class UCTPlanner:
    """Upper confidence bounds applied to trees (Kocsis & Szepesvári 2006), for states that score themselves.

    Every state of the search MDP is a whole scene, so its objective is its value and there are no random rollouts:
    one iteration selects by UCB1, expands one action, evaluates the child and backs its value up. A branch whose
    actions are all spent is closed; the search ends early when the tree is.

    Args:
        exploration: weight of the UCB1 bound. sqrt(2) is the textbook value for independent values over the whole of
            [0, 1]; siblings of one scene differ by a few hundredths, hence the smaller default.
        parallel: expansions selected before any is evaluated, by virtual loss: they become one batch of the
            denoiser. Every value of ``parallel`` gives its own tree, the same one each time.
    """

    exploration: float = 0.05
    parallel: int = 1

    def __post_init__(self) -> None:
        if not (math.isfinite(self.exploration) and self.exploration >= 0):
            raise InvalidInputError(f"exploration must be a number >= 0, got {self.exploration}")
        if self.parallel < 1:
            raise InvalidInputError(f"parallel must be at least 1, got {self.parallel}")

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions on the tree below the problem's current state."""
        _check_budget(budget)
        root = problem.clone_state()
        tree = Tree(root, problem.legal_actions(root), self.exploration)
        values: list[float] = []
        while len(values) < budget:
            selected = _select_up_to(tree, min(self.parallel, budget - len(values)))
            if not selected:
                break
            states = problem.expand_batch([(node.state, action) for node, action in selected])
            for (node, action), state in zip(selected, states, strict=True):
                value = _value(problem, state)
                values.append(value)
                if math.isfinite(value):
                    tree.attach(node, action, state, value, problem.legal_actions(state))
                else:
                    tree.release(node, action)
            if progress is not None:
                progress(len(values), tree.best().value or 0.0)
        best = tree.best()
        return PlanResult(best.state, math.nan if best.value is None else best.value, best.path, values, tree)


@dataclass(frozen=True)
class BestOfPlanner:
    """Best of N independent samples: expands the root alone, every action once, in order.

    The baseline of a tree search at equal NFE. Give it a root with at least ``budget`` actions; when the problem
    seeds children by their path, its first samples are those of the tree search.

    Args:
        parallel: expansions per batch of the denoiser.
    """

    parallel: int = 16

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions, or as many as the root has actions."""
        _check_budget(budget)
        root = problem.clone_state()
        actions = list(problem.legal_actions(root))[:budget]
        best_state, best_value, best_path = root, -math.inf, _ROOT
        values: list[float] = []
        for start in range(0, len(actions), self.parallel):
            chunk = actions[start : start + self.parallel]
            states = problem.expand_batch([(root, action) for action in chunk])
            for action, state in zip(chunk, states, strict=True):
                value = _value(problem, state)
                values.append(value)
                if value > best_value:
                    best_state, best_value, best_path = state, value, (action,)
            if progress is not None:
                progress(len(values), best_value)
        return PlanResult(best_state, best_value if values else math.nan, best_path, values)


def _value(problem: Searchable, state: Any) -> float:
    """The objective of ``state``, NaN when it could not be scored."""
    return float(problem.evaluate(state)) if getattr(state, "valid", True) else math.nan


def _select_up_to(tree: Tree, count: int) -> list[tuple[Node, int]]:
    selected: list[tuple[Node, int]] = []
    while len(selected) < count and (choice := tree.select()) is not None:
        selected.append(choice)
    return selected


def _check_budget(budget: int) -> None:
    if budget < 1:
        raise InvalidInputError(f"a plan needs a budget of at least 1 expansion, got {budget}")
