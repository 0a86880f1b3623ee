"""Projection: closed forms, invariants, and scenes that cannot be solved."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from scene_envs.grammars import get_grammar
from scene_envs.physics import penetration, project
from scene_envs.rotations import yaw_matrix
from scene_envs.scene import SceneBatch

TYPE = "dimsum_table"


def scene_of(*objects: tuple[str, float, float, float]) -> SceneBatch:
    """The table with upright, axis-aligned objects at (x, y, z) m."""
    batch = SceneBatch.empty(TYPE, 1, max(34, len(objects) + 1))
    translations, categories = batch.translations.clone(), batch.categories.clone()
    for slot, (name, *position) in enumerate(objects, start=1):
        translations[0, slot] = torch.tensor(position)
        categories[0, slot] = batch.scene_type.assets.index(name)
    rotations = yaw_matrix(torch.zeros(categories.shape))
    return SceneBatch.from_parts(translations, rotations, categories, TYPE)


def test_two_steamers_share_the_way_apart() -> None:
    """Equal and opposite moves, together as long as the way out of the hulls' Minkowski difference (scipy)."""
    batch = scene_of(("steamer_bottom", -0.11, 0.0, 0.0), ("steamer_bottom", 0.11, 0.0, 0.0))
    hull = batch.scene_type.library["steamer_bottom"].coarse[0].vertices
    difference = (hull[:, None] - (hull + np.array([0.22, 0.0, 0.0]))[None]).reshape(-1, 3)
    way_out = -ConvexHull(difference).equations[:, 3].max()  # from the origin to the nearest face
    result = project(batch)
    moves = (result.batch.translations - batch.translations)[0, 1:3]
    torch.testing.assert_close(moves[0], -moves[1], atol=1e-4, rtol=0)
    assert float(result.moved[0, 1:3].sum()) == pytest.approx(way_out, abs=2e-4)
    assert bool(result.converged[0])


def test_an_object_sunk_into_the_table_rises_onto_it() -> None:
    """The welded table does not move, the plate rises by what it was sunk."""
    result = project(scene_of(("dinner_plate", 0.1, 0.0, -0.005)))
    assert result.batch.translations[0, 0].tolist() == [0.0, 0.0, 0.0]
    assert result.batch.translations[0, 1].tolist() == pytest.approx([0.1, 0.0, 0.0], abs=1e-4)
    assert float(result.moved[0, 1]) == pytest.approx(0.005, abs=1e-4)


def test_scenes_without_overlap_stay_where_they_are() -> None:
    batch = get_grammar(TYPE).sample(np.random.default_rng(0), 5)
    result = project(batch)
    assert bool(result.converged.all())
    assert float(result.moved.max()) < 2e-4


def test_jittered_scenes_come_apart_and_keep_their_rotations() -> None:
    """Everything of 20 scenes moved by 1 cm at random: no pair deeper than 0.1 mm is left."""
    batch = get_grammar(TYPE).sample(np.random.default_rng(1), 20)
    jitter = 0.01 * torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(0))
    batch = batch.with_poses(batch.translations + jitter * batch.is_free.unsqueeze(-1), batch.rotations)
    assert float(penetration(batch).depth.max()) > 5e-3
    result = project(batch)
    assert float(result.converged.float().mean()) >= 0.99
    after = penetration(result.batch)
    assert float(after.depth[result.converged].max()) <= 1e-4
    torch.testing.assert_close(result.batch.rotations, batch.rotations, atol=1e-5, rtol=0)
    assert torch.equal(result.batch.categories, batch.categories)


def test_nested_objects_come_apart() -> None:
    """Three plates at one place end above or beside each other."""
    result = project(scene_of(*[("dinner_plate", 0.0, 0.0, 0.001 * i) for i in range(3)]))
    assert bool(result.converged[0])
    assert float(penetration(result.batch).depth.max()) <= 1e-4


def test_a_rim_that_is_straddled_is_left_on_one_side() -> None:
    """A cup whose body lies across a steamer's thin wall ends wholly on one side of it."""
    result = project(scene_of(("steamer_bottom", 0.0, 0.0, 0.0), ("teacup", 0.115, 0.0, 0.03)))
    assert bool(result.converged[0])
    assert float(penetration(result.batch).depth.max()) <= 1e-4


def test_one_object_in_the_air_is_not_touched() -> None:
    result = project(scene_of(("teapot", 0.0, 0.0, 0.3), ("teacup", 0.2, 0.2, 0.0)))
    assert float(result.moved.max()) == 0.0
