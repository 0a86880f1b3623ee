"""Degenerate scenes: every function, reward and search gives an answer or an invalid row, and the process lives."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium as gym
import numpy as np
import pytest
import torch

from rewards import evaluate_reward, make_reward
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.physics import equilibrium, feasibility, make_ready, penetration, project, settle
from scene_envs.physics.api import run_kernel, spent, stack
from scene_envs.physics.placement import MAX_PER_OBJECT, MIN_UNITS, PER_OBJECT, PER_PAIR, PER_SCENE
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import BUILT_IN, get_scene_type

pytestmark = pytest.mark.slow

PHYSICS: dict[str, Callable[[SceneBatch], object]] = {
    "penetration": penetration,
    "feasibility": feasibility,
    "equilibrium": equilibrium,
    "settle": lambda batch: settle(batch, duration=0.25),
    "project": project,
    "make_ready": lambda batch: make_ready(batch, duration=0.25, rounds=1),
}
COUNT = 4


def full(name: str, count: int = COUNT, seed: int = 0) -> SceneBatch:
    """A scene of a type's welded objects and ``count`` free ones, upright at the middle of the workspace."""
    scene_type = get_scene_type(name)
    batch = SceneBatch.empty(name, 1)
    free = [c for c in range(scene_type.num_assets) if c not in scene_type.welded_categories]
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    start = int((~batch.is_empty).sum())
    rows = slice(start, start + count)
    low, high = (torch.tensor(corner) for corner in scene_type.workspace)
    translations[0, rows] = (0.5 * (low + high)).float()
    rotations[0, rows] = torch.eye(3)
    categories[0, rows] = torch.from_numpy(np.random.default_rng(seed).choice(free, count))
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def moved(batch: SceneBatch, offsets: torch.Tensor) -> SceneBatch:
    """Free objects moved by ``offsets`` (N, 3) m, or one for all of them."""
    return batch.with_poses(batch.translations + offsets * batch.is_free.unsqueeze(-1), batch.rotations)


def at_one_point(name: str) -> SceneBatch:
    return full(name)


def in_pairs(name: str) -> SceneBatch:
    """Exactly coincident, two of the same asset at a time."""
    batch = full(name)
    categories, slots = batch.categories.clone(), batch.is_free[0].nonzero()[:, 0]
    categories[0, slots[1::2]] = categories[0, slots[::2]]
    offsets = torch.zeros_like(batch.translations)
    offsets[0, slots, 0] = 0.02 * (torch.arange(len(slots)) // 2).float()
    return moved(SceneBatch.from_parts(batch.translations, batch.rotations, categories, batch.scene_type), offsets)


def nested(name: str) -> SceneBatch:
    """A tower of objects 5 mm apart, each inside the next."""
    batch = full(name)
    offsets = torch.zeros_like(batch.translations)
    offsets[..., 2] = 0.005 * torch.arange(offsets.shape[1])
    return moved(batch, offsets)


def far_outside(name: str) -> SceneBatch:
    return moved(full(name), torch.tensor([10.0, -10.0, 10.0]))


def turned(name: str) -> SceneBatch:
    """At one point, turned by angles so small that faces are nearly parallel."""
    from scipy.spatial.transform import Rotation

    batch = full(name)
    angles = np.logspace(-12, -3, batch.tensor.shape[1])[:, None] * np.random.default_rng(1).normal(size=3)
    rotations = torch.from_numpy(Rotation.from_rotvec(angles).as_matrix()).float()[None]
    return batch.with_poses(batch.translations, torch.where(batch.is_free[..., None, None], rotations, batch.rotations))


SCENES = {f.__name__: f for f in (at_one_point, in_pairs, nested, far_outside, turned)}


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *(("dimsum_table", kind) for kind in SCENES),
        *((scene_type.name, "in_pairs") for scene_type in BUILT_IN if scene_type.name != "dimsum_table"),
    ],
)
def test_every_function_answers(name: str, kind: str) -> None:
    batch = SCENES[kind](name)
    for function in PHYSICS.values():
        result = function(batch)
        after = getattr(result, "batch", batch)
        assert bool(torch.isfinite(after.tensor).all())
        assert torch.equal(after.categories, batch.categories)


@pytest.mark.parametrize("name", ["dimsum_table", "restaurant_high_clutter"])
def test_the_simulation_of_coincident_pairs_is_bounded(name: str) -> None:
    """What a scene spends exceeds its budget by twelve steps of its objects at most, and the results say so."""
    batch = in_pairs(name)
    rows = run_kernel("settle", batch, {"duration": 1.0, "iterations": 35}, None)
    assert PER_SCENE <= float(spent(rows)) <= PER_SCENE + 12 * COUNT
    assert not bool(settle(batch).finished)
    assert not bool(equilibrium(batch, duration=1.0).valid)
    result = make_ready(batch)
    assert not bool(result.finished)
    assert int(result.counts) == 0
    assert bool(torch.isfinite(result.batch.tensor).all())


def test_ordinary_scenes_finish() -> None:
    clean = get_grammar("dimsum_table").sample(np.random.default_rng(0), 1)
    noise = 0.01 * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(0))
    batch = clean.with_poses(clean.translations + noise * clean.is_free.unsqueeze(-1), clean.rotations)
    units = stack(run_kernel("units", batch, {}, None), batch, "units", shape=())
    free = batch.is_free.sum(dim=-1).double()
    assert torch.equal(units, PER_SCENE + PER_OBJECT * free + PER_PAIR * free * (free - 1) / 2)
    assert bool(settle(batch).finished.all())
    result = make_ready(batch)
    assert bool(result.finished.all())
    assert torch.equal(result.counts, batch.is_free.sum(dim=-1))


@pytest.mark.parametrize("kind", SCENES)
def test_every_reward_answers_or_is_invalid(kind: str) -> None:
    batch = SCENES[kind]("dimsum_table")
    for reward in (
        make_reward("object_count"),
        make_reward("feasible_objects"),
        make_reward("clip", reward="feasible_objects", high=3.0),
    ):
        output = evaluate_reward(reward, batch, strict=True)
        assert output.valid is None or bool(output.valid.all())
        assert bool(torch.isfinite(output.value).all())


@pytest.mark.parametrize("function", [penetration, feasibility, equilibrium, settle, project, make_ready])
def test_a_pose_that_is_not_finite_is_refused(function: Callable[[SceneBatch], object]) -> None:
    batch = full("dimsum_table")
    batch.tensor[0, 3, 1] = float("nan")
    with pytest.raises(InvalidInputError, match="scene 0, slot 3 holds a pose that is not finite"):
        function(batch)


def test_search_goes_on_from_a_degenerate_scene() -> None:
    """The environment's own steps, with an objective that asks for physics."""
    env = gym.make("scene_envs:SceneEnvs/Search-v0", scene="dimsum_table", objective="feasible_objects", num_steps=2)
    env.reset(seed=0, options={"scene": at_one_point("dimsum_table")})
    value = env.step(0)[1]
    assert np.isfinite(value)
    env.close()


@pytest.mark.parametrize(
    ("objects", "units"), [(1, MAX_PER_OBJECT), (2, MIN_UNITS), (5, MIN_UNITS), (8, 8 * PER_OBJECT + 28 * PER_PAIR)]
)
def test_scenes_of_few_objects_may_take_as_many_units_as_larger_ones(objects: int, units: float) -> None:
    dimsum = get_grammar("dimsum_table").sample(np.random.default_rng(0), 1)
    kept = dimsum.is_free.cumsum(dim=-1) <= objects
    few = SceneBatch.from_parts(
        dimsum.translations,
        dimsum.rotations,
        dimsum.categories.masked_fill(dimsum.is_free & ~kept, dimsum.scene_type.num_assets),
        dimsum.scene_type,
    )
    assert stack(run_kernel("units", few, {}, None), few, "units", shape=()).item() == PER_SCENE + units
