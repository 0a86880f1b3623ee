"""Search tree: UCB1 selection, progressive widening, virtual visits for batched expansion, closed branches."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
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


@dataclass(eq=False, slots=True)
class Node:
    """One state of the search, with the statistics of the search below it.

    Attributes:
        state: the problem's own immutable state.
        value: objective of this state, in [0, 1]; None for a root that was never evaluated.
        parent: node from which this one was expanded, None at the root.
        action: action that led to this node, -1 at the root.
        path: actions from the root to this node.
        actions: legal actions of the state, in the order of expansion.
        tried: number of actions that were expanded or are reserved.
        children: expanded actions and their nodes.
        open_children: children below which something can be selected.
        visits: evaluations backed up through this node.
        total: sum of the values that were backed up.
        pending: virtual visits of expansions that are selected and not yet evaluated.
    """

    state: Any
    value: float | None = None
    parent: Node | None = field(default=None, repr=False)
    action: int = -1
    path: tuple[int, ...] = ()
    actions: Sequence[int] = ()
    tried: int = 0
    children: dict[int, Node] = field(default_factory=dict, repr=False)
    open_children: int = 0
    visits: int = 0
    total: float = 0.0
    pending: int = 0

    @property
    def mean(self) -> float:
        """Average of the values backed up; pending visits count as 0 (the virtual loss)."""
        tries = self.visits + self.pending
        return self.total / tries if tries else 0.0

    @property
    def is_open(self) -> bool:
        """True when some action at or below this node can be selected now."""
        return self.tried < len(self.actions) or self.open_children > 0

    def walk(self) -> Iterator[Node]:
        """This node and all below it, parents first, children by action."""
        left = [self]
        while left:
            node = left.pop()
            yield node
            left += [node.children[action] for action in sorted(node.children, reverse=True)]


_OWN = tuple(entry.name for entry in fields(Node) if entry.name not in ("parent", "children"))
"""Fields of a node that refer to no other node."""


class Tree:
    """A UCT tree over opaque states. An expansion costs the comparison of the children of each node on its path.

    Args:
        root: state from which the search starts.
        actions: legal actions of the root.
        exploration: weight of the UCB1 bound.
        children: number of children that a node gets before the search goes below them; None for all its actions.
        widening: progressive widening (Coulom 2007; Chaslot et al. 2008): a node of n visits may have n^widening
            children if that is more than ``children``; 0 for no widening.

    >>> tree = Tree("root", [0, 1])
    >>> node, action = tree.select()
    >>> child = tree.attach(node, action, "left", value=0.25, actions=[])
    >>> tree.root.visits, tree.root.mean, child.path
    (1, 0.25, (0,))
    """

    def __init__(
        self,
        root: Any,
        actions: Sequence[int],
        exploration: float = math.sqrt(2.0),
        children: int | None = None,
        widening: float = 0.0,
    ) -> None:
        self.root = Node(root, actions=actions)
        self.exploration, self.children, self.widening = exploration, children, widening
        self._best = self.root

    def __getstate__(self) -> dict[str, Any]:
        """Nodes as a flat list, each with the number of its parent.

        Pickling and copying then need no recursion, however deep the tree is.
        """
        nodes = self.nodes()
        number = {id(node): index for index, node in enumerate(nodes)}
        rows = [
            (None if node.parent is None else number[id(node.parent)], {name: getattr(node, name) for name in _OWN})
            for node in nodes
        ]
        return {**self.__dict__, "root": rows, "_best": number[id(self._best)]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        nodes: list[Node] = []
        for parent, own in state["root"]:
            node = Node(**own, parent=None if parent is None else nodes[parent])
            if node.parent is not None:
                node.parent.children[node.action] = node
            nodes.append(node)
        self.__dict__.update(state | {"root": nodes[0], "_best": nodes[state["_best"]]})

    def select(self) -> tuple[Node, int] | None:
        """The next expansion: descend by UCB1 to a node that takes another child, and reserve its next action.

        Ties go to the lower action. Branches with nothing left to select are skipped. The expansion counts as a
        visit worth 0 along its path until :meth:`attach` or :meth:`release`, so that several can be selected before
        any is evaluated.

        Returns:
            The node and the action to expand there, or None when nothing can be selected.
        """
        if not self.root.is_open:
            return None
        node = self.root
        while not self._takes_another_child(node):
            node = self._best_child(node)
        action = node.actions[node.tried]
        node.tried += 1
        _close(node)
        _add_pending(node, 1)
        return node, action

    def attach(self, node: Node, action: int, state: Any, value: float, actions: Sequence[int]) -> Node:
        """Add the result of a selected expansion and back its value up to the root."""
        child = Node(state, value, node, action, (*node.path, action), actions)
        node.children[action] = child
        if child.is_open:
            _open(node)
        _add_pending(node, -1)
        current: Node | None = child
        while current is not None:
            current.visits += 1
            current.total += value
            current = current.parent
        if self._best.value is None or _rank(child) < _rank(self._best):
            self._best = child
        return child

    def release(self, node: Node, action: int) -> None:
        """Drop a selected expansion that gave no usable state; its action is not tried again."""
        _add_pending(node, -1)

    def nodes(self) -> list[Node]:
        """All nodes, parents first."""
        return list(self.root.walk())

    def best(self) -> Node:
        """The evaluated node with the highest value; among equals, the shallowest, then the one with the first path."""
        return self._best

    def _takes_another_child(self, node: Node) -> bool:
        if node.tried >= len(node.actions):
            return False
        if self.children is None or node.open_children == 0:
            return True
        allowed = float(self.children)
        if self.widening:
            allowed = max(allowed, (node.visits + node.pending) ** self.widening)
        return node.tried < allowed

    def _best_child(self, node: Node) -> Node:
        tries = max(1, node.visits + node.pending)
        weight = self.exploration * math.sqrt(math.log(tries))
        best, highest = None, -math.inf
        for child in node.children.values():
            if child.tried >= len(child.actions) and not child.open_children:  # closed; this loop costs most
                continue
            visits = child.visits + child.pending
            bound = child.total / visits + weight / math.sqrt(visits) if visits else math.inf
            if best is None or bound > highest or (bound == highest and child.action < best.action):
                best, highest = child, bound
        assert best is not None
        return best


def _rank(node: Node) -> tuple[float, int, tuple[int, ...]]:
    return -(node.value or 0.0), len(node.path), node.path


def _close(node: Node) -> None:
    """Subtract a node that has closed from the open children of its parent, and so on towards the root."""
    current: Node | None = node
    while current is not None and not current.is_open and current.parent is not None:
        current = current.parent
        current.open_children -= 1


def _open(node: Node) -> None:
    """Add an open child to ``node``; if ``node`` was closed, add it to its parent, and so on towards the root."""
    current: Node | None = node
    while current is not None:
        was_open = current.is_open
        current.open_children += 1
        current = None if was_open else current.parent


def _add_pending(node: Node | None, amount: int) -> None:
    while node is not None:
        node.pending += amount
        node = node.parent
