"""Overlap against closed forms, scipy and fcl, and on degenerate scenes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from benchmarks.narrowphase import PartFeatures, expected_depths, measured, minkowski_depth, sample
from rewards import evaluate_reward, make_reward
from scene_envs.errors import InvalidInputError
from scene_envs.grammars import get_grammar
from scene_envs.physics import PhysicsPool, equilibrium, feasibility, make_ready, penetration, project, settle
from scene_envs.physics.api import run_kernel, spent, stack
from scene_envs.physics.mujoco import Overlaps
from scene_envs.physics.placement import MAX_PER_OBJECT, MIN_UNITS, PER_OBJECT, PER_PAIR, PER_SCENE, PlacedParts
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import BUILT_IN, get_scene_type
from tests.helpers.simple_scenes import SIDE, scene, turned


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


def test_engines_agree_on_two_equal_objects_at_one_pose() -> None:
    kind = get_scene_type("restaurant_low_clutter")
    movable = [index for index in range(len(kind.assets)) if index not in kind.welded_categories]
    batch = SceneBatch.empty(kind, len(movable))
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    slots, turn = slice(len(kind.fixed), len(kind.fixed) + 2), Rotation.random(random_state=1).as_matrix()
    translations[:, slots] = torch.tensor([0.1, 0.2, 1.0])
    rotations[:, slots] = torch.tensor(turn, dtype=torch.float32)
    categories[:, slots] = torch.tensor(movable)[:, None]
    batch = SceneBatch.from_parts(translations, rotations, categories, kind)
    ours, mujoco = (penetration(batch, physics=name).depth.amax(dim=1) for name in ("bullet", "mujoco"))
    assert ours.min() > 1e-3
    torch.testing.assert_close(mujoco, ours, atol=1e-7, rtol=0.0)


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
    assert pair.part_pairs > 1
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


Array = NDArray[np.float64]

CUBE = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
CENTER = (0.0, 0.0, 0.0)
SPIN = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]).as_matrix()
CORNER = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)
UP = Rotation.align_vectors([[0.0, 0.0, 1.0]], [CORNER])[0].as_matrix()
"""The cube stands on a corner."""
EDGE_X = Rotation.from_euler("x", np.pi / 4).as_matrix()
EDGE_Y = Rotation.from_euler("y", np.pi / 4).as_matrix()
"""It stands on an edge along x or y."""
EXACT = 4e-6
"""Largest error of a depth, m."""
KINDS = 11
"""Number of kinds of pairs in a sample, one after the other; those of the first overlap at random."""


def depth_of(
    first: Array, second: Array, translation: tuple[float, ...], turn: Array | None = None, base: Array | None = None
) -> float:
    """Depth of ``first`` at the origin, turned by ``base``, and ``second``, turned by ``turn``; 0 where they do not
    overlap.
    """
    rotation = np.stack([np.eye(3) if base is None else base, np.eye(3) if turn is None else turn])
    poses = np.array([0, 1]), rotation, np.array([CENTER, translation])
    *found, unmeasured = Overlaps([first, second], [[0], [1]])(*poses, np.array([0]), np.array([1]))
    assert [values.shape for values in found] in ([(0,)] * 3, [(1,)] * 3)
    assert len(unmeasured) == 0
    return float(found[2].sum())


Pairs = tuple[Overlaps, list[Array], PlacedParts, int]


@pytest.fixture(scope="module")
def pairs() -> Pairs:
    """Pairs of library parts, polytopes and slivers in every kind of contact: their overlaps, parts, poses, number."""
    parts, placed, names = sample(660, seed=5)
    return Overlaps(parts, [[index] for index in range(len(parts))]), parts, placed, len(names)


@pytest.fixture(scope="module")
def depths(pairs: Pairs) -> Array:
    """Depths of those pairs, m."""
    overlaps, _, placed, count = pairs
    return measured(overlaps, placed, np.arange(count), np.arange(count) + count)


@pytest.mark.parametrize(
    ("translation", "expected"),
    [
        ((0.9, 0.2, 0.1), 0.1),
        ((0.0, -0.75, 0.3), 0.25),
        ((0.0, 0.0, 0.0), 1.0),
        ((1e-9, 0.0, 0.0), 1.0 - 1e-9),
        ((1.0, 0.3, 0.2), 0.0),  # face on face
        ((1.0, 1.0, 0.2), 0.0),  # edge on edge
        ((1.0, 1.0, 1.0), 0.0),  # corner on corner
        ((3.0, 0.0, 0.0), 0.0),
        ((3.0, 40.0, 500.0), 0.0),
    ],
)
def test_cubes_overlap_by_what_is_common_to_them(translation: tuple[float, ...], expected: float) -> None:
    assert depth_of(CUBE, CUBE, translation) == pytest.approx(expected, abs=EXACT)
    moved = tuple(SPIN @ np.array(translation))
    assert depth_of(CUBE, CUBE, moved, SPIN, SPIN) == pytest.approx(expected, abs=EXACT)


@pytest.mark.parametrize("scale", [0.01, 0.5, 0.999999])
def test_a_cube_inside_a_cube_must_leave_by_its_whole_side(scale: float) -> None:
    assert depth_of(CUBE, scale * CUBE, CENTER) == pytest.approx(0.5 + 0.5 * scale, abs=EXACT)
    assert depth_of(CUBE, scale * CUBE, (0.0, 0.2 - 0.2 * scale, 0.0)) == pytest.approx(0.3 + 0.7 * scale, abs=EXACT)


@pytest.mark.parametrize("push", [0.0, 1e-9, 1e-4, 0.05])
@pytest.mark.parametrize(
    ("turn", "reach", "base", "height"),
    [
        (UP, np.sqrt(0.75), np.eye(3), 0.5),  # corner on face
        (EDGE_X, np.sqrt(0.5), np.eye(3), 0.5),  # edge on face
        (EDGE_X, np.sqrt(0.5), EDGE_Y, np.sqrt(0.5)),  # edge across edge
        (EDGE_X, np.sqrt(0.5), EDGE_X, np.sqrt(0.5)),  # edge along edge
        (UP, np.sqrt(0.75), UP, np.sqrt(0.75)),  # corner on corner
    ],
)
def test_cubes_that_stand_on_each_other_touch(
    turn: Array, reach: float, base: Array, height: float, push: float
) -> None:
    """A push down overlaps by as much where one feature is broad, and by less where a sideways step is shorter."""
    depth = depth_of(CUBE, CUBE, (0.0, 0.0, height + reach - push), turn, base)
    first, second = CUBE @ base.T, CUBE @ turn.T + (0.0, 0.0, height + reach - push)
    assert depth == pytest.approx(max(minkowski_depth(first, second), 0.0), abs=EXACT)
    assert depth <= push + EXACT
    crossing = turn is EDGE_X and base is EDGE_Y
    if crossing or height == 0.5:
        assert depth == pytest.approx(push, abs=EXACT)


@pytest.mark.parametrize("tilt", [0.0, 1e-16, 1e-12, 1e-9, 1e-6, 1e-3])
def test_nearly_parallel_faces_lose_no_depth(tilt: float) -> None:
    turn = Rotation.from_rotvec([0.6 * tilt, 0.8 * tilt, 0.0]).as_matrix()
    second = CUBE @ turn.T + (0.1, 0.2, 0.9)
    assert depth_of(CUBE, CUBE, (0.1, 0.2, 0.9), turn) == pytest.approx(minkowski_depth(CUBE, second), abs=EXACT)


def test_parts_without_thickness() -> None:
    """A plate, a line and a point in a cube need to get to the nearest face; two plates have no depth."""
    plate, line, point = 0.4 * CUBE * (1.0, 1.0, 0.0), 0.4 * CUBE[[0, 4]] * (1.0, 0.0, 0.0), np.zeros((1, 3))
    assert depth_of(CUBE, plate, (0.0, 0.0, 0.1)) == pytest.approx(0.4, abs=EXACT)
    assert depth_of(CUBE, plate, (0.25, 0.0, 0.0)) == pytest.approx(0.45, abs=EXACT)
    assert depth_of(CUBE, line, (0.1, 0.2, 0.0)) == pytest.approx(0.3, abs=EXACT)
    assert depth_of(CUBE, point, (0.0, 0.0, -0.45)) == pytest.approx(0.05, abs=EXACT)
    assert depth_of(plate, plate, CENTER) == pytest.approx(0.0, abs=EXACT)
    assert depth_of(plate, plate, CENTER, EDGE_X) == pytest.approx(0.2 * np.sqrt(0.5), abs=EXACT)
    assert depth_of(point, point, CENTER) == pytest.approx(0.0, abs=EXACT)
    assert depth_of(line, line, (0.0, 0.0, 0.1)) == 0.0


@pytest.mark.slow
def test_every_kind_of_contact_agrees_with_the_minkowski_difference(pairs: Pairs, depths: Array) -> None:
    """Library parts, polytopes and slivers, of which hundreds touch, coincide or are nested; none is missed."""
    _, parts, placed, count = pairs
    expected = np.maximum(expected_depths(parts, placed, np.arange(count), np.arange(count) + count), 0.0)
    assert (expected > 1e-6).mean() > 0.4
    np.testing.assert_allclose(depths, expected, atol=EXACT, rtol=0)
    assert (np.abs(depths - expected) < 1e-7).mean() > 0.8
    assert (depths[expected > EXACT] > 0).all()


@pytest.mark.slow
def test_the_two_parts_are_exchanged(pairs: Pairs, depths: Array) -> None:
    overlaps, _, placed, count = pairs
    exchanged = measured(overlaps, placed, np.arange(count) + count, np.arange(count))
    np.testing.assert_allclose(exchanged, depths, atol=EXACT, rtol=0)


@pytest.mark.slow
def test_both_parts_move_together(pairs: Pairs, depths: Array) -> None:
    overlaps, _, placed, count = pairs
    moved = PlacedParts(placed.part, SPIN @ placed.rotation, placed.translation @ SPIN.T + (0.3, -0.2, 0.4))
    again = measured(overlaps, moved, np.arange(count), np.arange(count) + count)
    np.testing.assert_allclose(again, depths, atol=EXACT, rtol=0)


@pytest.mark.slow
def test_a_pair_does_not_depend_on_the_others(pairs: Pairs, depths: Array) -> None:
    """Bit for bit: alone, and among others in any order."""
    overlaps, _, placed, count = pairs
    for row in range(0, count, 25):
        for rows in ([row], [row, (row + 7) % count], [(row + 301) % count, row]):
            found = measured(overlaps, placed, np.array(rows), np.array(rows) + count)
            assert found.tolist() == depths[rows].tolist()


def test_bodies_at_one_pose_are_all_found() -> None:
    """Six equal cubes at one pose: fifteen pairs, each as deep as a whole side; turned, and two of two kinds."""
    for turn in (np.eye(3), SPIN):
        overlaps = Overlaps([CUBE, 0.5 * CUBE], [[0], [0], [1]])
        pairs = np.triu_indices(6, k=1)
        first, second, depth, _ = overlaps(
            np.zeros(6, dtype=np.int64), np.stack([turn] * 6), np.full((6, 3), 0.3), *pairs
        )
        assert set(zip(first.tolist(), second.tolist(), strict=True)) == set(combinations(range(6), 2))
        np.testing.assert_allclose(depth, 1.0, atol=EXACT)
        poses = np.array([0, 1, 2]), np.stack([turn] * 3), np.zeros((3, 3))
        first, second, depth, _ = overlaps(*poses, *np.triu_indices(3, k=1))
        np.testing.assert_allclose(depth[np.lexsort((second, first))], [1.0, 0.75, 0.75], atol=EXACT)


def test_pairs_that_are_asked_for_are_listed_and_bodies_of_several_parts_list_each() -> None:
    """A body of two cubes side by side, of which both overlap a third one."""
    overlaps = Overlaps([CUBE, CUBE + np.array([1.0, 0.0, 0.0])], [[0], [0, 1]])
    kind, rotation = np.array([1, 0, 0]), np.stack([np.eye(3)] * 3)
    poses = kind, rotation, np.array([CENTER, (0.5, 0.0, 0.9), (0.0, 0.0, 5.0)])
    first, second, depth, _ = overlaps(*poses, *np.triu_indices(3, k=1))
    assert (first.tolist(), second.tolist()) == ([0, 0], [1, 1])
    np.testing.assert_allclose(depth, [0.1, 0.1], atol=EXACT)
    for pairs, count in (([(0, 1), (0, 2)], 2), ([(0, 2), (1, 2)], 0), ([(1, 0)], 2)):
        assert len(overlaps(*poses, *np.array(pairs).T)[2]) == count
    nothing = overlaps(kind[:0], rotation[:0], poses[2][:0], kind[:0], kind[:0])
    assert [values.shape for values in nothing] == [(0,)] * 4


def test_a_scene_with_too_many_pairs_of_parts_is_named_and_others_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scene_envs.physics.mujoco._TOO_MANY", 2)
    poses = np.zeros(5, dtype=np.int64), np.stack([np.eye(3)] * 5), np.zeros((5, 3))
    first, second = np.array([0, 0, 1, 3]), np.array([1, 2, 2, 4])
    found = Overlaps([CUBE], [[0]])(*poses, first, second, np.array([0, 0, 0, 1, 1]))
    assert [values.tolist() for values in found] == [[3], [4], [pytest.approx(1.0, abs=EXACT)], [0]]


@pytest.mark.slow
def test_parts_with_thousands_of_edges_fit_into_memory() -> None:
    """Two spheres of 1,200 corners each: their edges make 13 million pairs."""
    rng = np.random.default_rng(2)
    ball = rng.standard_normal((1200, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    inner = 1.0 + ConvexHull(ball).equations[:, 3].max()
    depth = depth_of(ball, ball, (0.01, 0.0, 0.0), SPIN)
    assert 2.0 - 2.0 * inner - 0.011 <= depth <= 2.0


@pytest.mark.parametrize(("corners", "faces", "edges"), [(CUBE, 6, 12), (CUBE[[0, 1, 2, 4]], 4, 6)])
def test_what_lies_inside_a_part_changes_no_depth(corners: Array, faces: int, edges: int) -> None:
    """Points inside and twice the same corner; the pairs of the benchmark touch faces and edges of the solid alone."""
    more = np.concatenate([corners, corners[:2], corners.mean(axis=0, keepdims=True)])
    for vertices in (corners, more):
        features = PartFeatures.of(vertices)
        assert (len(features.normals), len(features.edge_faces)) == (faces, edges)
    offset = (-0.3, -0.35, -0.2)
    assert depth_of(more, CUBE, offset, SPIN) == pytest.approx(depth_of(corners, CUBE, offset, SPIN), abs=1e-7)


FCL = """
import json, sys
import fcl, numpy as np
for line in sys.stdin:
    shapes = []
    for vertices, faces, rotation, translation in json.loads(line):
        faces = np.array(faces, dtype=np.int32)
        table = np.column_stack([np.full(len(faces), 3, dtype=np.int32), faces]).ravel()
        shape = fcl.Convex(np.array(vertices), len(faces), table)
        shapes.append(fcl.CollisionObject(shape, fcl.Transform(np.array(rotation), np.array(translation))))
    request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)
    print(-fcl.distance(*shapes, request, fcl.DistanceResult()), flush=True)
"""


@pytest.mark.slow
def test_generic_pairs_agree_with_fcl(pairs: Pairs, depths: Array) -> None:
    """In another process, because FCL may abort the one it runs in. It iterates to 1e-6 of a length."""
    pytest.importorskip("fcl")
    _, parts, placed, count = pairs
    rows = list(range(0, count, KINDS))[:150]  # those that overlap at random
    lines = []
    for row in rows:
        sides = []
        for item in (row, row + count):
            corners = parts[placed.part[item]]
            hull = ConvexHull(corners)
            triangles = hull.simplices.copy()
            edges = corners[triangles[:, 1:]] - corners[triangles[:, :1]]
            inward = np.einsum("ei,ei->e", np.cross(edges[:, 0], edges[:, 1]), hull.equations[:, :3]) < 0
            triangles[inward] = triangles[inward][:, ::-1]
            kept, local = np.unique(triangles, return_inverse=True)
            faces = local.reshape(-1, 3).tolist()
            sides.append(
                [corners[kept].tolist(), faces, placed.rotation[item].tolist(), placed.translation[item].tolist()]
            )
        lines.append(json.dumps(sides))
    run = subprocess.run(
        [sys.executable, "-c", FCL], input="\n".join(lines), capture_output=True, text=True, timeout=120, check=False
    )
    found = np.array([float(line) for line in run.stdout.split()])
    assert len(found) >= 50, run.stderr  # it may have aborted since
    assert np.percentile(np.abs(found - depths[rows][: len(found)]), 90) < 1e-6


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


def nearly_parallel(name: str) -> SceneBatch:
    """At one point, turned by angles so small that faces are nearly parallel."""
    from scipy.spatial.transform import Rotation

    batch = full(name)
    angles = np.logspace(-12, -3, batch.tensor.shape[1])[:, None] * np.random.default_rng(1).normal(size=3)
    rotations = torch.from_numpy(Rotation.from_rotvec(angles).as_matrix()).float()[None]
    return batch.with_poses(batch.translations, torch.where(batch.is_free[..., None, None], rotations, batch.rotations))


SCENES = {f.__name__: f for f in (at_one_point, in_pairs, nested, far_outside, nearly_parallel)}


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dimsum_table", "restaurant_high_clutter"])
def test_the_simulation_of_coincident_pairs_is_bounded(name: str) -> None:
    """What a scene spends exceeds its budget by twelve steps of its objects at most, and the results say so."""
    batch = in_pairs(name)
    rows = run_kernel("settle", batch, {"duration": 1.0, "iterations": 35}, PhysicsPool(0))
    assert PER_SCENE <= float(spent(rows)) <= PER_SCENE + 12 * COUNT
    assert not bool(settle(batch).finished)
    assert not bool(equilibrium(batch, duration=1.0).valid)
    result = make_ready(batch)
    assert not bool(result.finished)
    assert int(result.counts) == 0
    assert bool(torch.isfinite(result.batch.tensor).all())


@pytest.mark.slow
def test_ordinary_scenes_finish() -> None:
    clean = get_grammar("dimsum_table").sample(np.random.default_rng(0), 1)
    noise = 0.01 * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(0))
    batch = clean.with_poses(clean.translations + noise * clean.is_free.unsqueeze(-1), clean.rotations)
    units = stack(run_kernel("units", batch, {}, PhysicsPool(0)), batch, "units", shape=())
    free = batch.is_free.sum(dim=-1).double()
    assert torch.equal(units, PER_SCENE + PER_OBJECT * free + PER_PAIR * free * (free - 1) / 2)
    assert bool(settle(batch).finished.all())
    result = make_ready(batch)
    assert bool(result.finished.all())
    assert torch.equal(result.counts, batch.is_free.sum(dim=-1))


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("function", [penetration, feasibility, equilibrium, settle, project, make_ready])
def test_a_pose_that_is_not_finite_is_refused(function: Callable[[SceneBatch], object]) -> None:
    batch = full("dimsum_table")
    batch.tensor[0, 3, 1] = float("nan")
    with pytest.raises(InvalidInputError, match="scene 0, slot 3 holds a pose that is not finite"):
        function(batch)


@pytest.mark.slow
def test_search_goes_on_from_a_degenerate_scene() -> None:
    """The environment's own steps, with an objective that asks for physics."""
    env = gym.make("scene_envs:SceneEnvs/Search-v0", scene="dimsum_table", objective="feasible_objects", num_steps=2)
    env.reset(seed=0, options={"scene": at_one_point("dimsum_table")})
    value = env.step(0)[1]
    assert np.isfinite(value)
    env.close()


@pytest.mark.slow
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
    assert stack(run_kernel("units", few, {}, PhysicsPool(0)), few, "units", shape=()).item() == PER_SCENE + units
