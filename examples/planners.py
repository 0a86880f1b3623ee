"""A planner that a user adds to ``scene-envs search``: UCT.

    scene-envs search planner=./examples/planners.py:uct prior=dimsum_table output=runs/uct

``python examples/planners.py planner=uct ...`` is the same command. All keys of ``search`` are accepted; those of the
planner are the attributes of the dataclass. It is ahead in no table of benchmarks/search.md, so the package does not
have it. It shows how a planner uses the :class:`~agents.planning.SearchBudget` of a plan, which spends the budget and
keeps the best state.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated

from agents.cli import main
from agents.planning import PlannerSettings, PlanResult, Searchable, SearchBudget, register_planner
from agents.planning.ledger import Candidate, Progress
from scene_envs.errors import Count, at_least


@dataclass(eq=False)
class Node:
    """A state in the tree of UCT; ``pending`` counts the expansions below it that are chosen and not yet evaluated."""

    candidate: Candidate
    actions: Sequence[int]
    parent: Node | None = None
    children: list[Node] = field(default_factory=list)
    tried: int = 0
    visits: int = 0
    pending: int = 0
    total: float = 0.0
    open_children: int = 0

    @property
    def is_open(self) -> bool:
        """Whether an action at this node, or below it, can be chosen."""
        return self.tried < len(self.actions) or self.open_children > 0

    def line(self) -> Iterator[Node]:
        """This node and all nodes above it."""
        node: Node | None = self
        while node is not None:
            yield node
            node = node.parent

    def closed(self) -> None:
        """Subtract this node, if it has closed, from the open children of its parent, and so on towards the root."""
        for node in self.line():
            if node.is_open or node.parent is None:
                return
            node.parent.open_children -= 1

    def add(self, child: Node) -> None:
        """Add a child that was evaluated."""
        self.children.append(child)
        if child.is_open:
            for node in self.line():
                was_open = node.is_open
                node.open_children += 1
                if was_open:
                    break
        for node in child.line():
            node.visits, node.total = node.visits + 1, node.total + child.candidate.value


@register_planner("uct")
@dataclass(frozen=True)
class UCTPlanner(PlannerSettings):
    """Upper confidence bounds applied to trees (Kocsis & Szepesvári 2006), for states that score themselves.

    Every state is a whole scene, so its objective is its value and there are no random rollouts. One iteration descends
    by mean + exploration * sqrt(ln(visits of the parent) / visits), expands one action, evaluates the child and backs
    its value up. The search does not continue below a child that holds the scene of another node.

    Attributes:
        exploration: weight of the bound. The textbook value sqrt(2) is for independent values over the whole of [0, 1];
            siblings of one scene differ by a few hundredths, so the default is smaller.
        parallel: number of expansions that are chosen before any is evaluated, as one batch of the denoiser; each
            counts as a visit of value 0 until then (virtual loss). null takes ``branching``.
        children: number of children of a state before the search goes below them; null takes ``branching``.
        widening: exponent of progressive widening (Coulom 2007): a state of n visits may have n^widening children; 0
            for no widening.
        max_loss: largest amount by which the value of a child may be below its parent's; the search does not continue
            below a worse child.
    """

    name: str = "uct"
    widens = True
    exploration: Annotated[float, at_least(0)] = 0.05
    parallel: Count | None = None
    children: Count | None = None
    widening: Annotated[float, at_least(0)] = 0.5
    max_loss: Annotated[float, at_least(0)] = 1.0

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions on the tree below the problem's current state."""
        ledger = SearchBudget(problem, budget, progress)
        root = Node(ledger.root, ledger.actions(ledger.root))
        seen = {ledger.root.fingerprint}
        while ledger.left:
            chosen: list[tuple[Node, int]] = []
            while root.is_open and len(chosen) < min(self.parallel or 1, ledger.left):
                chosen.append(self.choose(root))
            made = ledger.expand([(node.candidate, action) for node, action in chosen])
            if not made:
                break
            for (node, _), child in zip(chosen, made, strict=False):
                for above in node.line():
                    above.pending -= 1
                if child.valid:
                    worse = node.parent is not None and child.value < node.candidate.value - self.max_loss
                    again = worse or child.fingerprint in seen
                    seen.add(child.fingerprint)
                    node.add(Node(child, () if again else ledger.actions(child), node))
        return ledger.result()

    def choose(self, node: Node) -> tuple[Node, int]:
        """The next expansion: the node that the bounds lead to, and its next action, which is reserved."""
        while not self.takes_another_child(node):
            weight = self.exploration * math.sqrt(math.log(max(1, node.visits + node.pending)))
            node = max((child for child in node.children if child.is_open), key=partial(bound, weight))
        action = node.actions[node.tried]
        node.tried += 1
        node.closed()
        for above in node.line():
            above.pending += 1
        return node, action

    def takes_another_child(self, node: Node) -> bool:
        """Whether the search expands ``node`` and not a node below it."""
        if node.tried >= len(node.actions) or self.children is None or node.open_children == 0:
            return node.tried < len(node.actions)
        wide = (node.visits + node.pending) ** self.widening if self.widening else 0.0
        return node.tried < max(self.children, wide)


def bound(weight: float, node: Node) -> tuple[float, int]:
    """Upper confidence bound of a node; among equal bounds the lower action comes first."""
    tries = node.visits + node.pending
    return node.total / tries + weight / math.sqrt(tries) if tries else math.inf, -node.candidate.path[-1]


if __name__ == "__main__":
    sys.exit(main(["search", *sys.argv[1:]]))
