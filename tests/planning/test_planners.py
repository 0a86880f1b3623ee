"""UCT on small deterministic trees: closed forms, brute force, known optimum."""

from __future__ import annotations

import copy
import math
import pickle
import sys
from typing import Any

import pytest

from agents.planning import BeamPlanner, BestOfPlanner, GreedyPlanner, MCTSPlanner, UCTPlanner
from agents.planning.tree import Node, Tree, ucb1
from scene_envs.errors import InvalidInputError
from tests.helpers.toy_tree import ToyTree, matches, scrambled


def test_ucb1_is_the_closed_form() -> None:
    assert ucb1(0.25, visits=4, parent_visits=20, exploration=math.sqrt(2)) == pytest.approx(
        0.25 + math.sqrt(2 * math.log(20) / 4)
    )
    assert ucb1(0.25, visits=0, parent_visits=20, exploration=1.0) == math.inf
    assert ucb1(0.25, visits=4, parent_visits=20, exploration=0.0) == 0.25


def test_selection_takes_the_highest_bound() -> None:
    tree = Tree("root", [0, 1], exploration=0.5)
    for value in (0.2, 0.9):
        node, action = tree.select()
        tree.attach(node, action, f"child {action}", value, actions=[0, 1])
    bounds = [ucb1(c.mean, c.visits, tree.root.visits, 0.5) for c in tree.root.children.values()]
    assert bounds[1] > bounds[0]
    assert tree.select()[0].path == (1,)


def test_visits_and_means_are_those_of_the_subtree() -> None:
    result = UCTPlanner(exploration=0.7).plan(ToyTree(scrambled), budget=50)
    nodes = result.tree.nodes()
    assert result.tree.root.visits == 50 == len(nodes) - 1
    for node in nodes[1:]:
        below = [n.value for n in node.walk()]
        assert node.visits == len(below)
        assert node.mean == pytest.approx(sum(below) / len(below))
        assert node.value == scrambled(node.path)
    assert all(node.pending == 0 for node in nodes)


@pytest.mark.parametrize("parallel", [1, 4])
def test_a_budget_for_the_whole_tree_finds_what_brute_force_finds(parallel: int) -> None:
    problem = ToyTree(scrambled, branching=3, depth=4)
    paths = problem.all_paths()
    result = UCTPlanner(parallel=parallel).plan(problem, budget=10_000)
    assert len(result.values) == len(paths)  # every state once, and then it stops
    assert {node.path for node in result.tree.nodes()[1:]} == set(paths)
    assert result.best_value == max(map(scrambled, paths)) == scrambled(result.best_path)


def test_a_known_optimum_is_found_with_a_fraction_of_the_tree() -> None:
    target = (2, 0, 3, 1, 2)
    problem = ToyTree(matches(target), branching=4, depth=5)
    result = UCTPlanner(exploration=0.2).plan(problem, budget=60)
    assert len(problem.all_paths()) == 1364
    assert result.best_path == target == result.best_state
    assert result.best_value == 1.0
    assert result.curve == sorted(result.curve)
    assert result.curve[-1] == 1.0


def test_exploitation_goes_down_the_better_branch() -> None:
    result = UCTPlanner(exploration=0.1).plan(ToyTree(lambda p: 0.9 if p[0] == 1 else 0.1, depth=6), budget=60)
    visits = {action: child.visits for action, child in result.tree.root.children.items()}
    assert visits[1] == 58
    assert visits[0] == visits[2] == 1


@pytest.mark.parametrize("parallel", [1, 8])
def test_the_same_search_gives_the_same_tree(parallel: int) -> None:
    trees = [UCTPlanner(parallel=parallel).plan(ToyTree(scrambled), budget=70) for _ in range(2)]
    first, second = [[(n.path, n.value, n.visits, n.total) for n in t.tree.nodes()] for t in trees]
    assert first == second
    assert trees[0].values == trees[1].values


def test_virtual_loss_spreads_a_batch_over_branches() -> None:
    tree = Tree((), [0, 1], exploration=0.2)
    for value in (0.5, 0.49):
        node, action = tree.select()
        tree.attach(node, action, (action,), value, actions=[0, 1])
    chosen = [tree.select()[0].path for _ in range(2)]
    assert chosen == [(0,), (1,)]
    assert tree.root.pending == 2


def test_batches_are_filled() -> None:
    problem = ToyTree(scrambled, branching=4, depth=6)
    UCTPlanner(parallel=4).plan(problem, budget=40)
    assert problem.batches == [4] * 10


def test_states_that_cannot_be_evaluated_are_left_out() -> None:
    problem = ToyTree(scrambled, branching=2, depth=2, broken=frozenset({(0,)}))
    result = UCTPlanner().plan(problem, budget=100)
    assert {n.path for n in result.tree.nodes()[1:]} == {(1,), (1, 0), (1, 1)}
    assert sum(map(math.isnan, result.values)) == 1
    assert result.tree.root.visits == 3
    assert result.curve[-1] == result.best_value == max(map(scrambled, [(1,), (1, 0), (1, 1)]))


def test_best_of_is_the_maximum_of_the_first_level() -> None:
    problem = ToyTree(scrambled, branching=30)
    result = BestOfPlanner(parallel=8).plan(problem, budget=20)
    assert result.values == [scrambled((a,)) for a in range(20)]
    assert result.best_value == max(result.values) == scrambled(result.best_path)
    assert problem.batches == [8, 8, 4]


def test_first_samples_of_both_planners_agree() -> None:
    uct = UCTPlanner(parallel=2).plan(ToyTree(scrambled, branching=4), budget=20)
    best_of = BestOfPlanner().plan(ToyTree(scrambled, branching=20), budget=20)
    assert uct.values[:4] == best_of.values[:4]


def test_progress_is_told_of_every_round() -> None:
    seen: list[tuple[int, float]] = []
    result = UCTPlanner(parallel=3).plan(ToyTree(scrambled), 12, lambda done, best: seen.append((done, best)))
    assert [done for done, _ in seen] == [3, 6, 9, 12]
    assert seen[-1][1] == result.best_value


def test_a_leaf_as_root_gives_no_plan() -> None:
    result = UCTPlanner().plan(ToyTree(scrambled, depth=0), budget=5)
    assert result.values == []
    assert math.isnan(result.best_value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: UCTPlanner(exploration=-1.0), "exploration must be a number >= 0, got -1.0"),
        (lambda: UCTPlanner(parallel=0), "parallel must be a number >= 1, got 0"),
        (lambda: UCTPlanner().plan(ToyTree(scrambled), budget=0), "at least 1 expansion, got 0"),
    ],
)
def test_bad_arguments_name_themselves(make, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make()


def test_equal_values_prefer_the_shallowest_first_path() -> None:
    tree = Tree((), [0, 1])
    for _ in range(2):
        node, action = tree.select()
        tree.attach(node, action, (action,), 0.5, actions=[])
    assert tree.best().path == (0,)
    assert isinstance(tree.best(), Node)


@pytest.mark.slow
@pytest.mark.parametrize(
    "planner",
    [UCTPlanner(parallel=1), MCTSPlanner(children=1), GreedyPlanner(children=1), BeamPlanner(width=1, children=1)],
    ids=lambda planner: type(planner).__name__,
)
def test_a_chain_deeper_than_pythons_recursion_is_searched_copied_and_pickled(planner: Any) -> None:
    depth = sys.getrecursionlimit() + 200
    result = planner.plan(ToyTree(lambda path: len(path) / 2 / depth, branching=1, depth=depth), depth)
    assert result.best_path == (0,) * depth
    for again in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert (again.best_path, again.best_value, again.values) == (result.best_path, 0.5, result.values)


def test_a_tree_is_pickled_with_its_statistics_and_goes_on_as_it_was() -> None:
    problem = ToyTree(scrambled, branching=3, depth=4)
    tree = UCTPlanner(exploration=0.3, parallel=2).plan(problem, 40).tree
    assert tree is not None
    again = pickle.loads(pickle.dumps(tree))
    named = ("path", "value", "visits", "total", "pending", "tried", "open_children", "action")
    for node, other in zip(tree.nodes(), again.nodes(), strict=True):
        assert [getattr(node, name) for name in named] == [getattr(other, name) for name in named]
        assert list(node.children) == list(other.children)
    assert again.best().path == tree.best().path
    for _ in range(3):  # the same expansions are chosen next
        node, action = tree.select() or (None, None)
        twin, same = again.select() or (None, None)
        assert (node and node.path, action) == (twin and twin.path, same)
