"""Search tree: UCB1 selection, virtual visits for batched expansion, closed branches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any


def ucb1(mean: float, visits: int, parent_visits: int, exploration: float) -> float:
    """UCB1: ``mean + exploration * sqrt(ln(parent_visits) / visits)`` (Auer 2002; Kocsis & Szepesvári 2006, Eq. 1).

    Args:
        mean: average value of the child, in [0, 1].
        visits: visits of the child, pending ones included; 0 gives infinity.
        parent_visits: visits of its parent, at least 1.
        exploration: weight of the bound; sqrt(2) is UCB1 as published.

    >>> ucb1(0.5, visits=1, parent_visits=1, exploration=1.0)
    0.5
    """
    if visits == 0:
        return math.inf
    return mean + exploration * math.sqrt(math.log(parent_visits) / visits)


@dataclass(eq=False)
class Node:
    """One state of the search and what was learnt below it.

    Attributes:
        state: the problem's own immutable state.
        value: objective of this state, in [0, 1]; None for a root that was never evaluated.
        parent: the node this one was expanded from, None at the root.
        action: the action that led here, -1 at the root.
        untried: legal actions not yet expanded, in the order they will be.
        children: expanded actions and their nodes.
        visits: evaluations backed up through this node.
        total: sum of the values backed up.
        pending: virtual visits of expansions that are selected and not yet evaluated.
    """

    state: Any
    value: float | None = None
    parent: Node | None = field(default=None, repr=False)
    action: int = -1
    untried: list[int] = field(default_factory=list)
    children: dict[int, Node] = field(default_factory=dict, repr=False)
    visits: int = 0
    total: float = 0.0
    pending: int = 0

    @property
    def path(self) -> tuple[int, ...]:
        """Actions from the root to this node."""
        return () if self.parent is None else (*self.parent.path, self.action)

    @property
    def mean(self) -> float:
        """Average of the values backed up; pending visits count as 0 (the virtual loss)."""
        tries = self.visits + self.pending
        return self.total / tries if tries else 0.0

    @property
    def is_open(self) -> bool:
        """True when some action at or below this node can be selected now."""
        return bool(self.untried) or any(child.is_open for child in self.children.values())

    def walk(self) -> Iterator[Node]:
        """This node and all below it, parents first, children by action."""
        yield self
        for action in sorted(self.children):
            yield from self.children[action].walk()


class Tree:
    """A UCT tree over opaque states.

    Args:
        root: state the search starts from.
        actions: legal actions of the root.
        exploration: weight of the UCB1 bound.

    >>> tree = Tree("root", [0, 1])
    >>> node, action = tree.select()
    >>> child = tree.attach(node, action, "left", value=0.25, actions=[])
    >>> tree.root.visits, tree.root.mean, child.path
    (1, 0.25, (0,))
    """

    def __init__(self, root: Any, actions: Sequence[int], exploration: float = math.sqrt(2.0)) -> None:
        self.root = Node(root, untried=list(actions))
        self.exploration = exploration

    def select(self) -> tuple[Node, int] | None:
        """The next expansion: descend by UCB1 to a node with an untried action and reserve that action.

        Ties go to the lower action. Branches with nothing left to select are skipped. The expansion counts as a
        visit worth 0 along its path until :meth:`attach` or :meth:`release`, so that several can be selected before
        any is evaluated.

        Returns:
            The node and the action to expand there, or None when nothing can be selected.
        """
        if not self.root.is_open:
            return None
        node = self.root
        while not node.untried:
            node = self._best_child(node)
        action = node.untried.pop(0)
        _add_pending(node, 1)
        return node, action

    def attach(self, node: Node, action: int, state: Any, value: float, actions: Sequence[int]) -> Node:
        """Add the result of a selected expansion and back its value up to the root."""
        child = Node(state, value, node, action, list(actions))
        node.children[action] = child
        _add_pending(node, -1)
        current: Node | None = child
        while current is not None:
            current.visits += 1
            current.total += value
            current = current.parent
        return child

    def release(self, node: Node, action: int) -> None:
        """Drop a selected expansion that gave no usable state; its action is not tried again."""
        _add_pending(node, -1)

    def nodes(self) -> list[Node]:
        """All nodes, parents first."""
        return list(self.root.walk())

    def best(self) -> Node:
        """The evaluated node with the highest value; the shallowest, then the first path, among equals."""
        evaluated = [node for node in self.root.walk() if node.value is not None]
        if not evaluated:
            return self.root
        return min(evaluated, key=lambda node: (-(node.value or 0.0), len(node.path), node.path))

    def _best_child(self, node: Node) -> Node:
        tries = max(1, node.visits + node.pending)
        candidates = [child for _, child in sorted(node.children.items()) if child.is_open]
        return max(candidates, key=lambda c: ucb1(c.mean, c.visits + c.pending, tries, self.exploration))


def _add_pending(node: Node | None, amount: int) -> None:
    while node is not None:
        node.pending += amount
        node = node.parent
