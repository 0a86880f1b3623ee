"""Planners on small deterministic trees: best of N, greedy, beam, MCTS, evolution, and an example's."""

from __future__ import annotations

import copy
import math
import pickle
import sys
from dataclasses import dataclass, field, replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from agents.planning import (
    BeamPlanner,
    BestOfPlanner,
    EvolutionPlanner,
    GreedyPlanner,
    MCTSPlanner,
    list_planners,
    run_search,
)
from agents.planning.evolution import spliced
from agents.priors.testing import tiny_prior
from rewards import RewardContext
from scene_envs.errors import InvalidInputError
from scene_envs.scene import CATEGORY, TRANSLATION, SceneBatch
from tests.helpers.examples import load_example
from tests.helpers.small_plans import SLOTS, near_middle, plan
from tests.helpers.toy_tree import Path, ToyTree, matches, scrambled


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
        (lambda: MCTSPlanner(exploration=-1.0), "exploration=-1.0 must be at least 0"),
        (lambda: BestOfPlanner(parallel=0), "parallel=0 must be at least 1"),
        (lambda: MCTSPlanner().plan(ToyTree(scrambled), budget=0), "at least 1 expansion, got 0"),
    ],
)
def test_bad_arguments_name_themselves(make: Any, message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make()


@pytest.mark.slow
@pytest.mark.parametrize(
    "planner",
    [
        MCTSPlanner(children=1),
        GreedyPlanner(children=1),
        BeamPlanner(width=1, children=1),
        EvolutionPlanner(children=1, population=1),
    ],
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


def test_the_planner_of_the_example_is_registered_and_searches(example: ModuleType) -> None:
    assert "uct" in list_planners()
    settings: dict[str, Any] = {"budget": 12, "branching": 3, "num_steps": 4, "seed": 3, "slots": 12, "planner": "uct"}
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


@pytest.mark.slow
@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_the_budget_is_spent_to_the_last_evaluation_and_the_best_is_kept(process: str) -> None:
    planner = EvolutionPlanner(population=3, children=2, crossover=0.8)
    result, env = plan(planner, process)
    assert len(result.values) == 14
    assert env.nfe == 14 * 4
    assert result.curve == sorted(result.curve)
    assert result.best_value == result.curve[-1]
    assert result.best_value == near_middle(env.scene(result.best_state), RewardContext()).value / (SLOTS - 1)
    again, _ = plan(planner, process)
    assert again.values == result.values
    assert torch.equal(again.best_state.scene, result.best_state.scene)


# -- evolution ------------------------------------------------------------------------------------


def row_of_objects(places: torch.Tensor, category: int = 0) -> SceneBatch:
    """Objects at ``places`` (M, 2) behind the fixed ones."""
    batch = SceneBatch.empty("dimsum_table", 1, SLOTS)
    rows = batch.tensor[0, 1 : 1 + len(places)]
    rows[:, CATEGORY] = 0
    rows[:, CATEGORY.start + category] = 1
    rows[:, TRANSLATION] = torch.nn.functional.pad(places, (0, 1))
    return batch


def objects(scene: torch.Tensor) -> set[tuple[float, ...]]:
    """The free objects of a scene (N, D)."""
    return {tuple(row.tolist()) for row in scene[1:] if row[-1] == 0}


NOTHING = torch.zeros(SLOTS, dtype=torch.bool)


@pytest.mark.parametrize("seed", range(5))
def test_a_splice_is_cut_along_a_plane(seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = row_of_objects(torch.from_numpy(rng.uniform(-0.4, 0.4, (6, 2))).float(), 1)
    second = row_of_objects(torch.from_numpy(rng.uniform(-0.4, 0.4, (5, 2))).float(), 2)
    assert objects(spliced(first, first, NOTHING, NOTHING, rng)) == objects(first.tensor[0])
    child = spliced(first, second, NOTHING, NOTHING, rng)
    assert torch.equal(child[0], first.tensor[0, 0])
    parts = objects(child) & objects(first.tensor[0]), objects(child) & objects(second.tensor[0])
    assert parts[0] | parts[1] == objects(child)
    assert all(parts)
    angles = torch.linspace(0, 2 * math.pi, 721)
    normals = torch.stack([angles.cos(), angles.sin()])
    near, far = (torch.tensor([part[:2] for part in sorted(side)]) @ normals for side in parts)
    assert bool((near.amin(0) > far.amax(0)).any())  # some line has all of one on either side


def test_a_splice_leaves_out_what_is_masked_and_what_has_no_slot() -> None:
    places = torch.stack([torch.linspace(0.1, 0.4, SLOTS - 1), torch.zeros(SLOTS - 1)], dim=-1)
    right, left = row_of_objects(places), row_of_objects(-places)
    mask = NOTHING.clone()
    mask[3:] = True
    few = objects(spliced(right, left, mask, ~NOTHING, np.random.default_rng(0)))
    assert few <= objects(right.tensor[0, :3])
    counts = set()
    for seed in range(20):
        child = spliced(right, left, NOTHING, NOTHING, np.random.default_rng(seed))
        counts.add(len(objects(child)))
        if len(objects(child)) == SLOTS - 1:  # full: those next to the cut are left out
            assert min(abs(place[0]) for place in objects(child)) > 0.1
    assert SLOTS - 1 in counts


def test_crossover_makes_other_scenes() -> None:
    crossed, _ = plan(EvolutionPlanner(population=3, children=2, crossover=1.0))
    alone, _ = plan(EvolutionPlanner(population=3, children=2, crossover=0.0))
    assert crossed.values[:3] == alone.values[:3]
    assert crossed.values != alone.values


# -- Feynman-Kac ----------------------------------------------------------------------------------


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_denoised_scenes_become_what_is_inpainted(process: str) -> None:
    prior = tiny_prior(process=process)
    batch = prior.sample(3, num_steps=3, slots=SLOTS)
    mask = torch.zeros(3, SLOTS, dtype=torch.bool)
    mask[:, 4:] = True
    seen: list[SceneBatch] = []

    def guide(step: int, steps: int, denoised: Any, std: torch.Tensor) -> None:
        seen.append(denoised())

    plain = prior.inpaint(batch, mask, num_steps=4)
    guided = prior.inpaint(batch, mask, num_steps=4, guide=guide)
    torch.testing.assert_close(guided.tensor, plain.tensor, atol=0, rtol=0)
    assert len(seen) == 4
    for scenes in seen:
        assert torch.equal(scenes.tensor[:, :4], batch.tensor[:, :4])
    torch.testing.assert_close(seen[-1].tensor, plain.tensor, atol=1e-5, rtol=0)  # the last step is certain
