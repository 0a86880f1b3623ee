"""Diffusion tree sampling: a tree over the denoising steps of an inpainting, with branches at a few of the steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from torch import Tensor

from agents.planning.branches import Branches
from agents.planning.ledger import Candidate, PlanResult, Progress, Searchable, SearchBudget, SteeredProblem
from agents.planning.registry import PlannerSettings, check_at_least, register_planner
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch


@dataclass(eq=False)
class _Stop:
    """A node of the tree: a half-denoised scene at a stop; the root is noise."""

    level: int
    x: Tensor | None = None
    parent: _Stop | None = None
    children: list[_Stop] = field(default_factory=list)
    visits: int = 0
    total: float = 0.0

    def back_up(self, value: float) -> None:
        """Add a value to this node and to all its ancestors."""
        node: _Stop | None = self
        while node is not None:
            node.visits, node.total, node = node.visits + 1, node.total + value, node.parent

    def select(self, last: int, exploration: float, widening: float) -> _Stop:
        """The node from which the next scenes branch.

        UCB descends to the first node that has fewer branches than its visits allow, or that is at the last stop.
        """
        node = self
        while node.level < last and len(node.children) >= max(1.0, node.visits**widening):
            weight = exploration * math.sqrt(math.log(max(1, node.visits)))
            node = max(node.children, key=lambda stop: stop.total / stop.visits + weight / math.sqrt(stop.visits))
        return node


@register_planner("tree_over_steps")
@dataclass(frozen=True)
class TreeOverStepsPlanner(PlannerSettings):
    """Diffusion tree sampling (Jain et al. 2025), in rounds of iterated repair.

    The inpaintings of a state form a tree. Its nodes are half-finished scenes at a few stops of the denoising, and its
    leaves are finished scenes. A round continues ``children`` new scenes from one node, chosen by UCB, each with its
    own noise; the steps before that node are not repeated. The value of a node is the mean over the finished scenes
    below it and its own expected scene. After ``rounds`` rounds the best finished scene becomes the current state,
    unless it scores less; in that case the tree grows further.

    Attributes:
        children: scenes per round, one batch of the denoiser; null takes ``branching``.
        stops: shares of the denoising steps at which scenes can be branched from.
        rounds: rounds per current state.
        exploration: weight of the bound.
        widening: exponent of progressive widening: a node of n visits has n^widening branches before the search goes
            below them.
    """

    name: str = "tree_over_steps"
    widens = True
    steers = True
    children: int | None = None
    stops: tuple[float, ...] = (0.5, 0.7)
    rounds: int = 3
    exploration: float = 0.05
    widening: float = 0.5

    def __post_init__(self) -> None:
        check_at_least(self, 1, "children", "rounds")
        check_at_least(self, 0, "exploration", "widening")
        if not self.stops or any(not 0 < a < b for a, b in zip(self.stops, [*self.stops[1:], 1.0], strict=True)):
            raise InvalidInputError(f"planner {self.name}: stops={list(self.stops)} are no increasing shares, in 0..1")

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions below the current state; one that begins at a stop counts as a whole one.

        Raises:
            InvalidInputError: the expansions of ``problem`` cannot be steered.
        """
        steered = SteeredProblem(problem, self.name)
        ledger = SearchBudget(steered, budget, progress)
        state, actions, best = ledger.root, ledger.actions(ledger.root), None
        tree = _Stop(-1)
        while ledger.left and actions:
            for _ in range(self.rounds):
                node = tree.select(len(self.stops) - 1, self.exploration, self.widening)
                taken, actions = actions[: self.children or 1], actions[self.children or 1 :]
                steered.steering = partial(self._branches, node)
                for child in ledger.expand([(state, action) for action in taken]):
                    _grow(node, child)
                    if child.valid and (best is None or child.value > best.value):
                        best = child
            if best is not None and not best.value < state.value and ledger.actions(best):
                state, actions, best, tree = best, ledger.actions(best), None, _Stop(-1)
        return ledger.result()

    def _branches(self, node: _Stop, pairs: Sequence[Any], values: Callable[[SceneBatch], Tensor]) -> Branches:
        x = None if node.x is None else node.x.expand(len(pairs), *node.x.shape)
        return Branches(self.stops, node.level, x, values)


def _grow(node: _Stop, child: Candidate) -> None:
    """Add the stops of a finished scene below ``node``, and its value to these stops and all their ancestors."""
    trace = getattr(child.state, "trace", None) or {}
    for x, promise in zip(trace.get("x", ()), trace.get("promises", ()), strict=True):
        node.children.append(_Stop(node.level + 1, x, node))
        node = node.children[-1]
        node.visits, node.total = 1, float(promise)
    if child.valid:
        node.back_up(child.value)
