"""Overlap: closed forms and scipy agree."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.physics import penetration
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE, scene, turned


def minkowski_depth(first: np.ndarray, second: np.ndarray) -> float:
    """Depth of two convex bodies from their corners, by the hull of the Minkowski difference (scipy)."""
    difference = (first[:, None] - second[None]).reshape(-1, 3)
    return float(-ConvexHull(difference).equations[:, 3].max())


@pytest.mark.parametrize("depth", [1e-4, 0.003, 0.02])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_two_boxes_overlap_by_what_they_were_pushed(depth: float, axis: int) -> None:
    offset = [0.0, 0.0, 0.5]
    offset[axis] += SIDE - depth
    result = penetration(scene(("cube", 0.0, 0.0, 0.5), ("cube", *offset)))
    (pair,) = result.pairs[0]
    assert pair.slots == (1, 2)
    assert pair.depth == pytest.approx(depth, abs=1e-6)
    assert pair.total == pytest.approx(depth, abs=1e-6)
    assert result.depth[0, :3].tolist() == pytest.approx([0.0, depth, depth], abs=1e-6)
    assert result.depth[0, 3:].max() == 0.0


def test_edges_that_cross_are_measured_exactly() -> None:
    """Two boxes whose edges cross: the least depth is along the cross product, which no face plane sees."""
    turn = Rotation.from_euler("xyz", [np.pi / 4, 0.0, 0.0]).as_matrix()
    other = Rotation.from_euler("xyz", [0.0, np.pi / 4, 0.0]).as_matrix()
    batch = turned(turned(scene(("cube", 0.0, 0.0, 0.5), ("cube", 0.0, 0.0, 0.63)), 1, turn), 2, other)
    corners = batch.scene_type.library["cube"].fine[0].vertices
    poses = zip(batch.rotations[0, 1:3].double().numpy(), batch.translations[0, 1:3].double().numpy(), strict=True)
    first, second = (corners @ r.T + t for r, t in poses)
    assert float(penetration(batch).depth[0, 1]) == pytest.approx(minkowski_depth(first, second), abs=1e-6)


def test_random_box_pairs_agree_with_the_minkowski_difference() -> None:
    generator = np.random.default_rng(0)
    corners = scene().scene_type.library["cube"].fine[0].vertices
    for turn in Rotation.random(20, random_state=0):
        shift = generator.uniform(-0.05, 0.05, 3)
        batch = turned(
            scene(("cube", 0.0, 0.0, 1.0), ("cube", *(shift + np.array([0.0, 0.0, 1.0])))), 2, turn.as_matrix()
        )
        rotation = batch.rotations[0, 2].double().numpy()
        placed = corners @ rotation.T + batch.translations[0, 2].double().numpy()
        expected = minkowski_depth(corners + np.array([0.0, 0.0, 1.0]), placed)
        assert float(penetration(batch).depth[0, 1]) == pytest.approx(max(expected, 0.0), abs=1e-5)


@pytest.mark.parametrize("name", ["cube", "post", "bowl"])
def test_two_objects_at_one_pose_overlap_by_a_whole_part(name: str) -> None:
    """The shortest way out is the least width of a part, for the bowl that of its floor."""
    turn = Rotation.from_euler("xyz", [0.4, -0.2, 0.9]).as_matrix()
    batch = turned(turned(scene((name, 0.1, 0.0, 0.5), (name, 0.1, 0.0, 0.5)), 1, turn), 2, turn)
    parts = batch.scene_type.library[name].fine
    expected = max(minkowski_depth(part.vertices, part.vertices) for part in parts)
    assert float(penetration(batch).depth[0, 1]) == pytest.approx(expected, abs=1e-6)


def test_what_lies_inside_a_bowl_does_not_overlap_it() -> None:
    result = penetration(scene(("bowl", 0.0, 0.0, 0.0), ("post", 0.0, 0.0, 0.01)))
    assert float(result.depth.max()) < 1e-6


def test_a_wall_pushed_through_counts_once_per_pair_and_part_by_part_in_the_total() -> None:
    """A box across the rim of a bowl overlaps several of its wedges."""
    result = penetration(scene(("bowl", 0.0, 0.0, 0.0), ("cube", 0.105, 0.0, 0.05)))
    pair = next(pair for pair in result.pairs[0] if pair.slots == (1, 2))
    assert pair.part_pairs > 2
    assert pair.total > pair.depth
    assert float(result.total_per_geometry[0]) >= float(result.total_per_pair[0])
    assert float(result.total_per_pair[0]) == pytest.approx(sum(pair.depth for pair in result.pairs[0]), rel=1e-6)


def test_objects_of_the_same_scene_only_and_welded_pairs_never() -> None:
    welded_twice = scene(("floor", 0.0, 0.0, 0.0))
    result = penetration(SceneBatch.concatenate([welded_twice, scene(("cube", 0.0, 0.0, 0.0))]))
    assert [len(pairs) for pairs in result.pairs] == [0, 0]


def test_slots_are_a_set() -> None:
    """Permuting slots permutes depths."""
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(3), 1)
    jitter = 0.01 * torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(0))
    batch = batch.with_poses(batch.translations + jitter * batch.is_free.unsqueeze(-1), batch.rotations)
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(1))
    shuffled = SceneBatch(batch.tensor[:, order], batch.scene_type)
    torch.testing.assert_close(penetration(shuffled).depth, penetration(batch).depth[:, order], atol=1e-7, rtol=0)


def test_a_pose_that_is_not_one_names_scene_and_slot() -> None:
    batch = scene(("cube", 0.0, 0.0, 0.0), ("cube", 0.5, 0.0, 0.0))
    batch.tensor[0, 2, 1] = float("nan")  # behind the constructor's back
    with pytest.raises(InvalidInputError, match="scene 0, slot 2"):
        penetration(batch)
    batch = scene(("cube", 0.0, 0.0, 0.0), ("cube", 0.5, 0.0, 0.0))
    batch.tensor[0, 1, 3] = 2.0
    with pytest.raises(InvalidInputError, match=r"scene 0, slot 1.*rotation"):
        penetration(batch)
