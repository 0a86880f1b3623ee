"""Evolution and Feynman-Kac steering: splices, resampling against closed forms, denoiser evaluations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from agents.planning import EvolutionPlanner, FeynmanKacPlanner, GreedyPlanner
from agents.planning.evolution import spliced
from agents.planning.feynman_kac import Particles, systematic
from agents.priors.testing import tiny_prior
from rewards import RewardContext
from scene_envs.errors import InvalidInputError
from scene_envs.scene import CATEGORY, TRANSLATION, SceneBatch
from tests.helpers.small_plans import SLOTS, near_middle, plan
from tests.helpers.toy_tree import ToyTree, scrambled


@pytest.mark.slow
@pytest.mark.parametrize(
    "planner",
    [EvolutionPlanner(population=3, children=2, crossover=0.8), FeynmanKacPlanner(particles=4, begin=0.0)],
    ids=lambda planner: planner.name,
)
@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_the_budget_is_spent_to_the_last_evaluation_and_the_best_is_kept(planner: Any, process: str) -> None:
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


def test_systematic_resampling_gives_every_particle_its_share() -> None:
    weights = np.random.default_rng(0).dirichlet(np.full(7, 0.5))
    grid = (np.arange(7000) + 0.5) / 7000
    counts = np.array([np.bincount(systematic(3.0 * weights, uniform), minlength=7) for uniform in grid])
    np.testing.assert_allclose(counts.mean(axis=0), 7 * weights, atol=1e-3)
    assert bool((np.abs(counts - 7 * weights) < 1).all())
    rows = systematic(weights, 0.3)
    assert rows[rows].tolist() == rows.tolist()  # who goes on keeps its place
    assert systematic(np.ones(5), 0.999).tolist() == [0, 1, 2, 3, 4]


def test_particles_follow_the_tilted_distribution() -> None:
    count, size, strength = 40_000, 0.1, 6.0
    rng, place = np.random.default_rng(1), np.zeros(40_000)
    particles = Particles(["a"] * count, {"a": np.random.default_rng(2)}, lambda values: values, 4, 0.0, strength)
    assert particles.at(5) == [0, 1, 2, 3]
    for step in range(4):
        place = place + size * rng.choice([-1.0, 1.0], count)
        now = torch.from_numpy(place)
        rows = particles(step, 5, lambda now=now: now)
        place = place[rows.numpy()]
    assert particles(4, 5, lambda: None) is None
    # p(steps) exp(strength * place) of independent steps of ±size
    assert place.mean() == pytest.approx(4 * size * math.tanh(strength * size), abs=0.005)
    assert place.var() == pytest.approx(4 * size**2 / math.cosh(strength * size) ** 2, rel=0.05)


def test_particles_give_way_to_those_of_their_own_parent() -> None:
    rngs = {parent: np.random.default_rng(0) for parent in "ab"}
    values = torch.tensor([0.0, 0.1, 1.0, 0.9, 0.0])
    rows = Particles(list("aabab"), rngs, lambda _: values, 1, 0.0, 1000.0)(0, 2, lambda: None)
    assert rows.tolist() == [3, 3, 2, 3, 2]


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_without_strength_particles_are_greedy_repair(process: str) -> None:
    steered, _ = plan(FeynmanKacPlanner(particles=3, strength=0.0), process)
    greedy, _ = plan(GreedyPlanner(children=3), process)
    assert steered.values == greedy.values


def test_a_problem_that_cannot_be_steered_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="expand_batch of ToyTree takes no steering="):
        FeynmanKacPlanner().plan(ToyTree(scrambled), budget=5)


@pytest.mark.parametrize("process", ["mixed", "continuous"])
def test_denoised_scenes_become_what_is_inpainted(process: str) -> None:
    prior = tiny_prior(process=process)
    batch = prior.sample(3, num_steps=3, slots=SLOTS)
    mask = torch.zeros(3, SLOTS, dtype=torch.bool)
    mask[:, 4:] = True
    seen: list[SceneBatch] = []

    def watch(step: int, steps: int, denoised: Any) -> torch.Tensor | None:
        seen.append(denoised())
        return torch.tensor([0, 0, 2]) if step == 2 else None

    plain = prior.inpaint(batch, mask, num_steps=4)
    for scenes in (prior.inpaint(batch, mask, num_steps=4, watch=lambda *_: None), plain):
        torch.testing.assert_close(scenes.tensor, plain.tensor, atol=0, rtol=0)
    taken = prior.inpaint(batch, mask, num_steps=4, watch=watch)
    assert len(seen) == 4
    for scenes in seen:
        assert torch.equal(scenes.tensor[:, :4], batch.tensor[:, :4])
    torch.testing.assert_close(seen[-1].tensor, taken.tensor, atol=1e-5, rtol=0)  # the last step is certain
    assert torch.equal(taken.tensor[[0, 2]], plain.tensor[[0, 2]])
    assert not torch.equal(taken.tensor[1], plain.tensor[1])
