"""Best of N, what planners have in common, and the planners of an example, on small deterministic trees."""

from __future__ import annotations

import copy
import math
import pickle
import sys
from types import ModuleType
from typing import Any

import pytest

from agents.planning import BeamPlanner, BestOfPlanner, GreedyPlanner, MCTSPlanner, list_planners, run_search
from agents.priors.testing import tiny_prior
from scene_envs.errors import InvalidInputError
from tests.helpers.examples import load_example
from tests.helpers.small_plans import near_middle, plan
from tests.helpers.toy_tree import ToyTree, matches, scrambled


def test_best_of_is_the_maximum_of_the_first_level() -> None:
    problem = ToyTree(scrambled, branching=30)
    result = BestOfPlanner(parallel=8).plan(problem, budget=20)
    assert result.values == [scrambled((a,)) for a in range(20)]
    assert result.best_value == max(result.values) == scrambled(result.best_path)
    assert problem.batches == [8, 8, 4]


def test_progress_is_told_of_every_round() -> None:
    seen: list[tuple[int, float]] = []
    result = MCTSPlanner(children=3).plan(ToyTree(scrambled), 12, lambda done, best: seen.append((done, best)))
    assert [done for done, _ in seen] == [3, 6, 9, 12]
    assert seen[-1][1] == result.best_value


def test_a_leaf_as_root_gives_no_plan() -> None:
    result = MCTSPlanner().plan(ToyTree(scrambled, depth=0), budget=5)
    assert result.values == []
    assert math.isnan(result.best_value)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MCTSPlanner(exploration=-1.0), "exploration must be a number >= 0, got -1.0"),
        (lambda: BestOfPlanner(parallel=0), "parallel must be a number >= 1, got 0"),
        (lambda: MCTSPlanner().plan(ToyTree(scrambled), budget=0), "at least 1 expansion, got 0"),
    ],
)
def test_bad_arguments_name_themselves(make: Any, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make()


@pytest.mark.slow
@pytest.mark.parametrize(
    "planner",
    [MCTSPlanner(children=1), GreedyPlanner(children=1), BeamPlanner(width=1, children=1)],
    ids=lambda planner: type(planner).__name__,
)
def test_a_chain_deeper_than_pythons_recursion_is_searched_copied_and_pickled(planner: Any) -> None:
    depth = sys.getrecursionlimit() + 200
    result = planner.plan(ToyTree(lambda path: len(path) / 2 / depth, branching=1, depth=depth), depth)
    assert result.best_path == (0,) * depth
    for again in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert (again.best_path, again.best_value, again.values) == (result.best_path, 0.5, result.values)


# -- examples/planners.py -------------------------------------------------------------------------


@pytest.fixture
def example() -> ModuleType:
    return load_example("planners")


@pytest.mark.parametrize("name", ["uct", "tree_over_steps"])
def test_planners_of_the_example_are_registered_and_search(example: ModuleType, name: str) -> None:
    assert name in list_planners()
    settings: dict[str, Any] = {"budget": 12, "branching": 3, "num_steps": 4, "seed": 3, "slots": 12, "planner": name}
    found, again = (run_search(tiny_prior(), near_middle, baseline=False, **settings).search for _ in range(2))
    assert len(found.values) == 12
    assert found.best_value == max(found.values)
    assert again.values == found.values


@pytest.mark.parametrize("parallel", [1, 4])
def test_uct_finds_what_brute_force_finds_and_a_known_optimum_sooner(example: ModuleType, parallel: int) -> None:
    problem = ToyTree(scrambled, branching=3, depth=4, broken=frozenset({(0,)}))
    paths = [path for path in problem.all_paths() if path[0] != 0]
    result = example.UCTPlanner(parallel=parallel).plan(problem, budget=10_000)
    assert len(result.values) == len(paths) + 1  # every state once, and then it stops
    assert result.best_value == max(map(scrambled, paths)) == scrambled(result.best_path)
    target = (2, 0, 3, 1, 2)
    problem = ToyTree(matches(target), branching=4, depth=5)
    result = example.UCTPlanner(exploration=0.2, parallel=parallel).plan(problem, budget=80)
    assert result.best_path == target
    assert problem.batches[0] == parallel


def test_a_tree_over_steps_begins_midway_and_counts_the_steps_it_takes(example: ModuleType) -> None:
    result, env = plan(example.TreeOverStepsPlanner(children=2, stops=(0.5,), rounds=2))
    assert len(result.values) == 14
    assert 14 * 2 < env.nfe < 14 * 4  # of two rounds of one state the second begins at step 2 of 4
    with pytest.raises(InvalidInputError, match="takes no steering="):
        example.TreeOverStepsPlanner().plan(ToyTree(scrambled), budget=5)
