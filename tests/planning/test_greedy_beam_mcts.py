"""Greedy repair, beam search and MCTS as published, on small trees."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch

from agents.planning import BeamPlanner, EvolutionPlanner, GreedyPlanner, MCTSPlanner
from tests.helpers.toy_tree import Path, ToyTree, matches, scrambled

PLANNERS = [
    BeamPlanner(children=3),
    EvolutionPlanner(children=3, population=3),
    GreedyPlanner(children=3),
    MCTSPlanner(children=3),
]


@pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: planner.name)
def test_every_planner_keeps_its_account(planner) -> None:
    problem = ToyTree(scrambled, branching=20, depth=6, broken=frozenset({(0,), (1, 0), (2, 1)}))
    result = planner.plan(problem, budget=50)
    assert sum(problem.batches) == len(result.values) == 50
    assert result.best_value == max(value for value in result.values if math.isfinite(value))
    assert result.best_value == scrambled(result.best_path)
    assert result.best_path == result.best_state
    again = planner.plan(ToyTree(scrambled, branching=20, depth=6, broken=problem.broken), budget=50)
    assert again.values[0] != again.values[0]  # (0,) has no score
    assert again.best_path == result.best_path


@pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: planner.name)
def test_every_planner_ends_at_the_largest_value_and_at_the_end_of_the_tree(planner) -> None:
    found = planner.plan(ToyTree(lambda path: 1.0 if path == (1,) else 0.5, branching=3), budget=500)
    assert (found.best_path, len(found.values)) == ((1,), 3)
    whole = planner.plan(ToyTree(scrambled, branching=3, depth=1), budget=500)
    assert sorted(whole.values) == sorted(scrambled((action,)) for action in range(3))


@pytest.mark.slow
@pytest.mark.parametrize("planner", PLANNERS, ids=lambda planner: planner.name)
def test_a_chain_may_be_longer_than_the_stack(planner) -> None:
    result = planner.plan(ToyTree(lambda path: len(path) / 1201, branching=1, depth=1200), budget=1200)
    assert len(result.best_path) == 1200


def test_greedy_climbs_where_every_step_pays() -> None:
    target = (2, 0, 1, 2, 1)
    result = GreedyPlanner(children=3).plan(ToyTree(matches(target), branching=3, depth=5), budget=15)
    assert (result.best_path, result.best_value) == (target, 1.0)


def test_greedy_takes_equals_and_leaves_worse_ones() -> None:
    values = {(0,): 0.5, (1,): 0.4, (0, 0): 0.5, (0, 1): 0.3, (0, 0, 0): 0.2, (0, 0, 1): 0.2, (0, 0, 2): 0.6}
    problem = ToyTree(lambda path: values.get(path, 0.1), branching=4, depth=5)
    result = GreedyPlanner(children=2).plan(problem, budget=8)
    assert result.values == [0.5, 0.4, 0.5, 0.3, 0.2, 0.2, 0.6, 0.1]


def test_greedy_goes_back_from_a_dead_end() -> None:
    values = {(0,): 0.5, (0, 0): 0.6, (1,): 0.1, (0, 1): 0.8}
    problem = ToyTree(lambda path: values.get(path, 0.0), branching=2, depth=2)
    assert GreedyPlanner(children=1).plan(problem, budget=10).best_path == (0, 1)


def test_a_beam_finds_what_greed_misses() -> None:
    def value(path: Path) -> float:  # the better first step leads nowhere
        return {(0,): 0.5, (1,): 0.4}.get(path[:1], 0.1) if len(path) == 1 else 0.9 if path == (1, 2) else 0.2

    problem = ToyTree(value, branching=3, depth=2)
    assert BeamPlanner(width=2, children=3).plan(problem, budget=9).best_path == (1, 2)
    assert GreedyPlanner(children=3).plan(problem, budget=6).best_path == (0,)


@dataclass(frozen=True)
class Twin:
    """A state whose scene is the same whatever the action."""

    path: Path = ()

    @property
    def fingerprint(self) -> int:
        return len(self.path)


class TwinTree(ToyTree):
    """Children of one depth all hold the same scene."""

    def clone_state(self) -> Twin:
        return Twin()

    def legal_actions(self, state):
        return super().legal_actions(state.path)

    def expand_batch(self, pairs):
        self.batches.append(len(pairs))
        return [Twin((*state.path, action)) for state, action in pairs]

    def evaluate(self, state: Twin) -> float:
        return self.value(state.path)


def test_the_same_scene_is_searched_once() -> None:
    beam = TwinTree(lambda path: 0.5, branching=3, depth=9)
    BeamPlanner(width=3, children=3).plan(beam, budget=12)
    assert beam.batches[:2] == [3, 3 + 0]  # one scene of depth 1, and the root has no action left


def test_mcts_expands_all_children_of_the_leaf_of_the_highest_bound() -> None:
    problem = ToyTree(scrambled, branching=3, depth=9)
    result = MCTSPlanner(children=3, rollout="all", exploration=0.0).plan(problem, budget=9)
    first = [scrambled((action,)) for action in range(3)]
    best = int(np.argmax(first))
    assert problem.batches == [3, 3, 3]
    assert result.values[:6] == [*first, *(scrambled((best, action)) for action in range(3))]


def test_mcts_backs_up_one_random_child_and_tries_its_siblings_next() -> None:
    problem = ToyTree(scrambled, branching=3, depth=9)
    planner = MCTSPlanner(children=3, rollout="random", exploration=1.0)
    values = planner.plan(problem, budget=9).values
    grown = [path for path in problem.all_paths()[:12] if scrambled(path) in values and len(path) == 2]
    assert len({path[0] for path in grown}) == 2  # both siblings without a visit come before any other leaf
    assert replace(planner, seed=1).plan(problem, budget=30).values != planner.plan(problem, budget=30).values


@dataclass(frozen=True)
class Masked:
    """A state with a mask."""

    value: float
    path: Path = ()
    mask: torch.Tensor = field(default_factory=lambda: torch.ones(2, dtype=torch.bool))


class MaskedTree:
    """The second child of the root has nothing masked."""

    def clone_state(self) -> Masked:
        return Masked(0.0)

    def legal_actions(self, state: Masked) -> range:
        return range(3 if bool(state.mask.any()) else 0)

    def expand_batch(self, pairs):
        children = [Masked(0.1 * (action + 1), (*state.path, action)) for state, action in pairs]
        return [replace(c, mask=torch.zeros(2, dtype=torch.bool)) if c.path == (1,) else c for c in children]

    def evaluate(self, state: Masked) -> float:
        return state.value

    def without_masked(self, state: Masked) -> Masked:
        return replace(state, value=state.value + 0.05, mask=torch.zeros(2, dtype=torch.bool))


def test_mcts_stops_where_nothing_is_masked_and_removes_what_is() -> None:
    result = MCTSPlanner(children=3, exploration=1.0).plan(MaskedTree(), budget=1000)
    assert len(result.values) < 1000
    assert not bool(result.best_state.mask.any())
    assert result.best_value == pytest.approx(0.35)
