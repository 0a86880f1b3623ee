"""UCT: upper confidence bounds applied to trees of whole scenes."""

from __future__ import annotations

from dataclasses import dataclass

from agents.planning.ledger import Candidate, PlanResult, Progress, Searchable, SearchBudget
from agents.planning.registry import PlannerSettings, check_at_least, register_planner
from agents.planning.tree import Node, Tree


@register_planner("uct")
@dataclass(frozen=True)
class UCTPlanner(PlannerSettings):
    """Upper confidence bounds applied to trees (Kocsis & Szepesvári 2006), for states that score themselves.

    Every state of the search MDP is a whole scene, so its objective is its value, and there are no random rollouts. One
    iteration selects by UCB1, expands one action, evaluates the child and backs its value up. A branch is closed when
    all its actions are tried; the search ends early when the root is closed. A child that holds the same scene as
    another node, or that scores less than its parent by more than ``max_loss``, is added, but the search does not
    continue below it.

    Attributes:
        exploration: weight of the UCB1 bound. The textbook value sqrt(2) is for independent values over the whole of
            [0, 1]; siblings of one scene differ by a few hundredths, so the default is smaller.
        parallel: number of expansions that are selected, by virtual loss, before any is evaluated; they are one batch
            of the denoiser. Each number gives its own tree, and the same tree each time. null takes ``branching``.
        children: number of children of a state before the search goes below them; null takes ``branching``.
        widening: exponent of progressive widening: a state of n visits may have n^widening children; 0 for no widening.
        max_loss: most by which the value of a child may be below its parent's; the search does not go below a worse
            child. 1 excludes no child, except repeated scenes.
    """

    name: str = "uct"
    widens = True
    exploration: float = 0.05
    parallel: int | None = None
    children: int | None = None
    widening: float = 0.5
    max_loss: float = 1.0

    def __post_init__(self) -> None:
        check_at_least(self, 1, "parallel", "children")
        check_at_least(self, 0, "exploration", "widening", "max_loss")

    def plan(self, problem: Searchable, budget: int, progress: Progress | None = None) -> PlanResult:
        """Spend up to ``budget`` expansions on the tree below the problem's current state."""
        ledger = SearchBudget(problem, budget, progress)
        tree = Tree(ledger.root.state, ledger.actions(ledger.root), self.exploration, self.children, self.widening)
        seen = {ledger.root.fingerprint}
        while ledger.left:
            selected = _select_up_to(tree, min(self.parallel or 1, ledger.left))
            if not selected:
                break
            parents = [Candidate(node.state, node.value or 0.0, node.path) for node, _ in selected]
            children = ledger.expand([(parent, action) for parent, (_, action) in zip(parents, selected, strict=True)])
            if not children:
                for node, action in selected:
                    tree.release(node, action)
                break
            for (node, action), child in zip(selected, children, strict=True):
                if not child.valid:
                    tree.release(node, action)
                    continue
                pruned = child.fingerprint in seen or child.value < (node.value or 0.0) - self.max_loss
                seen.add(child.fingerprint)
                tree.attach(node, action, child.state, child.value, () if pruned else ledger.actions(child))
        return ledger.result(tree)


def _select_up_to(tree: Tree, count: int) -> list[tuple[Node, int]]:
    selected: list[tuple[Node, int]] = []
    while len(selected) < count and (choice := tree.select()) is not None:
        selected.append(choice)
    return selected
