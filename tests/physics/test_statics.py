"""Objects at rest without simulation: the same objects stay in place when they are simulated."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from scene_envs.grammars import get_grammar
from scene_envs.physics import FeasibilityResult, equilibrium, feasibility, make_ready, settle
from scene_envs.physics.bullet import BulletEngine
from scene_envs.physics.motion import Physics, physics_of
from scene_envs.physics.placement import ObjectPairs, Objects
from scene_envs.physics.statics import Rest, surrounds
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE, scene, turned

TYPES = (
    "breakfast_table_low_clutter", "breakfast_table_high_clutter", "dimsum_table", "living_room_shelf", "pantry_shelf",
    "restaurant_low_clutter", "restaurant_high_clutter",
)  # fmt: skip


def simulated(batch: SceneBatch, monkeypatch: pytest.MonkeyPatch, **options: Any) -> FeasibilityResult:
    """The verdict when every object is simulated, with fine parts."""

    def nothing(self: Physics, objects: Objects, pairs: ObjectPairs, duration: float) -> Rest:
        return Rest(np.zeros(len(objects), bool), np.zeros(len(objects)), np.zeros(len(objects)))

    support = physics_of(batch.scene_type, "bullet").statics
    with monkeypatch.context() as patch:
        patch.setattr(Physics, "rest", nothing)
        patch.setattr(support, "needs_fine", lambda objects, pairs: support.hollow[objects.category])
        return feasibility(batch, **options)


def simulations(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A list that grows by the number of free objects whenever something is simulated."""
    counts: list[int] = []
    real = BulletEngine.simulate

    def spy(self: BulletEngine, objects: Objects, *rest: Any) -> Any:
        counts.append(int((~objects.fixed).sum()))
        return real(self, objects, *rest)

    monkeypatch.setattr(BulletEngine, "simulate", spy)
    return counts


@pytest.mark.slow
@pytest.mark.parametrize("name", TYPES)
def test_generated_scenes_stand_as_simulation_says(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As generated and with 2 mm of noise: at most one verdict in a hundred differs from simulating everything."""
    clean = get_grammar(name).sample(np.random.default_rng(0), 2)
    noise = torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(0))
    noise *= torch.tensor([0.002, 0.002, 0.0004]) * clean.is_free.unsqueeze(-1)
    batch = SceneBatch.concatenate([clean, clean.with_poses(clean.translations + noise, clean.rotations)])
    quick, slow = feasibility(batch), simulated(batch, monkeypatch)
    assert int((quick.feasible != slow.feasible).sum()) <= max(1, 0.01 * int(batch.is_free.sum()))


def test_gaps_close_and_overlaps_open_from_the_lowest_object_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """0.3 mm under the first box, 0.4 mm under the second, 0.2 mm of overlap under the third; nothing is simulated."""
    counts = simulations(monkeypatch)
    heights = np.cumsum([0.0003, SIDE + 0.0004, SIDE - 0.0002])
    result = feasibility(scene(*[("cube", 0.0, 0.0, float(height)) for height in heights]))
    assert result.displacement[0, 1:4].tolist() == pytest.approx([0.0003, 0.0007, 0.0005], abs=1e-6)
    assert counts == []


@pytest.mark.parametrize(("shift", "stands"), [(0.03, True), (0.044, True), (0.051, False), (0.06, False)])
def test_a_box_on_a_box_tips_when_its_centre_leaves_the_edge(
    shift: float, stands: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The edge is half a side away; close to it the simulation decides."""
    counts = simulations(monkeypatch)
    result = feasibility(scene(("cube", 0.0, 0.0, 0.0), ("cube", shift, 0.0, SIDE)), duration=0.5)
    assert bool(result.feasible[0, 2]) is stands
    assert bool(counts) is (shift > 0.045)


@pytest.mark.parametrize(("shift", "rests"), [(0.006, True), (0.015, True), (0.03, True), (0.3, False)])
def test_contacts_round_the_centre_of_mass_carry_a_bowl(
    shift: float, rests: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bowl stands on the rim of another one, off its middle: 24 contacts of parts, none of which carries it alone.
    Simulation with all parts says the same; 0.3 m aside it falls freely.
    """
    counts = simulations(monkeypatch)
    batch = scene(("bowl", 0.0, 0.0, 0.0), ("bowl", shift, 0.0, 0.1))
    result = feasibility(batch)
    assert counts == []
    assert bool(result.feasible[0, 2]) is rests
    assert simulated(batch, monkeypatch).feasible.tolist() == result.feasible.tolist()


def test_what_falls_close_by_others_falls_freely(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bowl falls past one that stands beside it, within its bounding box and 8 mm from its wall: g (dt^2) n (n+1)/2
    in n = 48 steps; over its rim both are simulated.
    """
    counts = simulations(monkeypatch)
    aside = 0.228 / np.sqrt(2.0)
    result = feasibility(scene(("bowl", 0.0, 0.0, 0.0), ("bowl", aside, aside, 0.08)), physics="bullet")
    assert counts == []
    assert float(result.displacement[0, 2]) == pytest.approx(9.81 / 480**2 * 48 * 49 / 2, abs=1e-5)
    assert bool(result.feasible[0, 1])
    assert not bool(feasibility(scene(("bowl", 0.0, 0.0, 0.0), ("bowl", 0.15, 0.0, 0.12))).feasible[0, 2])
    assert max(counts) == 2


def test_what_is_carried_shifts_the_balance() -> None:
    """A post stands on a box that overhangs by 40 mm; two boxes on its far side tip it."""
    overhang = [("cube", 0.0, 0.0, 0.0), ("cube", 0.04, 0.0, SIDE)]
    light = feasibility(scene(*overhang, ("post", 0.04, 0.0, 2 * SIDE)), duration=0.3)
    heavy = feasibility(scene(*overhang, ("cube", 0.08, 0.0, 2 * SIDE), ("cube", 0.08, 0.0, 3 * SIDE)), duration=0.3)
    assert light.counts.tolist() == [3]
    assert not bool(heavy.feasible[0, 2])


def test_a_falling_post_knocks_over_the_next_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A post leans, 2 cm away from one that stands by itself; the second simulation has both, the third post is out."""
    counts = simulations(monkeypatch)
    posts = [("post", 0.0, 0.0, 0.003), ("post", 0.09, 0.0, 0.0), ("post", 0.5, 0.0, 0.0)]
    tilt = Rotation.from_euler("y", 0.25).as_matrix()
    result = equilibrium(turned(scene(*posts), 1, tilt), duration=0.6)
    assert counts == [1, 2]
    assert (result.rotation[0, 1:4] > 0.3).tolist() == [True, True, False]
    assert float(result.displacement[0, 3]) < 1e-6


def test_what_falls_onto_an_object_at_rest_is_not_missed() -> None:
    """A box falls 8 cm onto another one's overhang; the centre of mass of the two is past the edge."""
    batch = scene(("cube", 0.0, 0.0, 0.0), ("cube", 0.04, 0.0, SIDE), ("cube", 0.085, 0.0, 2 * SIDE + 0.08))
    assert feasibility(batch[:1], duration=0.02).feasible[0, 1:3].tolist() == [True, True]
    assert not bool(feasibility(batch, duration=0.4).feasible[0, 2])


def test_cutlery_and_mugs_on_a_table_need_no_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Feet of several parts, on a surface that is larger than they are."""
    batch = SceneBatch.empty("breakfast_table_high_clutter", 1)
    translations, categories, rotations = batch.translations.clone(), batch.categories.clone(), batch.rotations.clone()
    for slot, name in enumerate(("fork", "knife", "dinner_spoon", "mug", "bowl", "plate"), start=1):
        translations[0, slot, 1] = 0.2 * slot - 0.7
        rotations[0, slot] = torch.eye(3)
        categories[0, slot] = batch.scene_type.assets.index(name)
    batch = SceneBatch.from_parts(translations, rotations, categories, batch.scene_type)
    expected = simulated(batch, monkeypatch)
    counts = simulations(monkeypatch)
    assert torch.equal(feasibility(batch).feasible, expected.feasible)
    assert int(expected.counts) == 6
    assert counts == []


def test_settled_stacks_touch_exactly() -> None:
    """Gaps of 2 mm close to nothing: what is at rest is put where it belongs."""
    result = settle(scene(("cube", 0.0, 0.0, 0.002), ("cube", 0.0, 0.0, SIDE + 0.004)))
    assert result.batch.translations[0, 1:3, 2].tolist() == pytest.approx([0.0, SIDE], abs=1e-6)


@pytest.mark.parametrize(("shift", "holds"), [(0.03, True), (0.048, False)])
def test_a_stack_that_only_just_stands_is_not_ready(shift: float, holds: bool) -> None:
    """The upper box stands with its centre 2 mm from the edge; gravity that leans by 0.12 rad takes it 4 mm further."""
    batch = scene(("cube", 0.0, 0.0, 0.0), ("cube", shift, 0.0, SIDE))
    assert feasibility(batch, duration=2.0).feasible[0, 1:3].tolist() == [True, True]
    assert make_ready(batch, rounds=1).ready[0, 1:3].tolist() == [True, holds]


def test_points_all_round_are_those_whose_hull_is_5_mm_away() -> None:
    """SciPy's hull of random points, some twice, has its nearest edge 5 mm or more from the origin inside it."""
    rng, found = np.random.default_rng(0), []
    for count in rng.integers(3, 30, 400).tolist():
        points = rng.choice([0.006, 0.01, 0.03]) * rng.normal(size=(count, 2)) + rng.normal(0.0, 0.01, 2)
        found.append(surrounds(np.repeat(points, 2, axis=0)))
        assert found[-1] == bool(ConvexHull(points).equations[:, 2].max() < -5e-3)
    assert 100 < sum(found) < 300
