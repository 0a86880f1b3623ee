"""Penetration depth of convex parts: closed forms, the hull of the Minkowski difference, and FCL agree."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from benchmarks.narrowphase import minkowski_depth, sample
from scene_envs.physics.collision import PenetrationDepth
from scene_envs.physics.parts import PartFeatures
from scene_envs.physics.placement import PlacedParts

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


def depth_of(
    first: Array, second: Array, translation: tuple[float, ...], turn: Array | None = None, base: Array | None = None
) -> float:
    """Depth of ``first`` at the origin, turned by ``base``, and ``second``, turned by ``turn``."""
    rotation = np.stack([np.eye(3) if base is None else base, np.eye(3) if turn is None else turn])
    placed = PlacedParts(np.array([0, 1]), rotation, np.array([CENTER, translation]))
    depth, direction = PenetrationDepth([first, second])(placed, np.array([0]), np.array([1]))
    assert np.linalg.norm(direction[0]) == pytest.approx(1.0, abs=1e-12)
    return float(depth[0])


@pytest.fixture(scope="module")
def pairs() -> tuple[list[Array], PlacedParts, list[str]]:
    """Pairs of library parts, polytopes and slivers in every kind of contact."""
    return sample(1000, seed=5)


@pytest.fixture(scope="module")
def depths(pairs: tuple[list[Array], PlacedParts, list[str]]) -> tuple[Array, Array]:
    """Depth and direction of those pairs."""
    parts, placed, names = pairs
    rows = np.arange(len(names))
    return PenetrationDepth(parts)(placed, rows, rows + len(rows))


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
        ((3.0, 0.0, 0.0), -2.0),
        ((3.0, 40.0, 500.0), -499.0),
    ],
)
def test_cubes_overlap_by_what_is_common_to_them(translation: tuple[float, ...], expected: float) -> None:
    assert depth_of(CUBE, CUBE, translation) == pytest.approx(expected, abs=1e-12)
    moved = tuple(SPIN @ np.array(translation))
    assert depth_of(CUBE, CUBE, moved, SPIN, SPIN) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("scale", [0.01, 0.5, 0.999999])
def test_a_cube_inside_a_cube_must_leave_by_its_whole_side(scale: float) -> None:
    assert depth_of(CUBE, scale * CUBE, CENTER) == pytest.approx(0.5 + 0.5 * scale, abs=1e-12)
    assert depth_of(CUBE, scale * CUBE, (0.0, 0.2 - 0.2 * scale, 0.0)) == pytest.approx(0.3 + 0.7 * scale, abs=1e-12)


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
    assert depth == pytest.approx(max(minkowski_depth(first, second), 0.0), abs=1e-12)
    assert depth <= push + 1e-12
    crossing = turn is EDGE_X and base is EDGE_Y
    if crossing or height == 0.5:
        assert depth == pytest.approx(push, abs=1e-12)


@pytest.mark.parametrize("tilt", [0.0, 1e-16, 1e-12, 1e-9, 1e-6, 1e-3])
def test_nearly_parallel_faces_lose_no_depth(tilt: float) -> None:
    turn = Rotation.from_rotvec([0.6 * tilt, 0.8 * tilt, 0.0]).as_matrix()
    second = CUBE @ turn.T + (0.1, 0.2, 0.9)
    assert depth_of(CUBE, CUBE, (0.1, 0.2, 0.9), turn) == pytest.approx(minkowski_depth(CUBE, second), abs=1e-12)


def test_parts_without_thickness() -> None:
    """A plate, a line and a point in a cube need to get to the nearest face; two plates have no depth."""
    plate, line, point = 0.4 * CUBE * (1.0, 1.0, 0.0), 0.4 * CUBE[[0, 4]] * (1.0, 0.0, 0.0), np.zeros((1, 3))
    assert depth_of(CUBE, plate, (0.0, 0.0, 0.1)) == pytest.approx(0.4, abs=1e-12)
    assert depth_of(CUBE, plate, (0.25, 0.0, 0.0)) == pytest.approx(0.45, abs=1e-12)
    assert depth_of(CUBE, line, (0.1, 0.2, 0.0)) == pytest.approx(0.3, abs=1e-12)
    assert depth_of(CUBE, point, (0.0, 0.0, -0.45)) == pytest.approx(0.05, abs=1e-12)
    assert depth_of(plate, plate, CENTER) == pytest.approx(0.0, abs=1e-12)
    assert depth_of(plate, plate, CENTER, EDGE_X) == pytest.approx(0.2 * np.sqrt(0.5), abs=1e-12)
    assert depth_of(point, point, CENTER) == pytest.approx(0.0, abs=1e-12)
    assert depth_of(line, line, (0.0, 0.0, 0.1)) <= 0.0


@pytest.mark.slow
def test_every_kind_of_contact_agrees_with_the_minkowski_difference(
    pairs: tuple[list[Array], PlacedParts, list[str]], depths: tuple[Array, Array]
) -> None:
    """Library parts, polytopes and slivers, of which hundreds touch, coincide or are nested."""
    parts, placed, names = pairs
    corners = [parts[p] @ r.T + t for p, r, t in zip(placed.part, placed.rotation, placed.translation, strict=True)]
    expected = np.array([minkowski_depth(corners[row], corners[row + len(names)]) for row in range(len(names))])
    assert (expected > 1e-6).mean() > 0.4
    np.testing.assert_allclose(np.maximum(depths[0], 0.0), np.maximum(expected, 0.0), atol=1e-11, rtol=0)


@pytest.mark.slow
def test_moving_along_the_direction_by_the_depth_separates(
    pairs: tuple[list[Array], PlacedParts, list[str]], depths: tuple[Array, Array]
) -> None:
    parts, placed, names = pairs
    depth, direction = depths
    for row in range(0, len(names), 7):
        first, second = (
            parts[placed.part[i]] @ placed.rotation[i].T + placed.translation[i] for i in (row, row + len(names))
        )
        gap = (second @ direction[row]).min() - (first @ direction[row]).max()
        assert gap == pytest.approx(-depth[row], abs=1e-12)


@pytest.mark.slow
def test_the_two_parts_are_exchanged(
    pairs: tuple[list[Array], PlacedParts, list[str]], depths: tuple[Array, Array]
) -> None:
    parts, placed, names = pairs
    rows = np.arange(len(names))
    exchanged, _ = PenetrationDepth(parts)(placed, rows + len(rows), rows)
    np.testing.assert_allclose(np.maximum(exchanged, 0.0), np.maximum(depths[0], 0.0), atol=1e-12, rtol=0)


@pytest.mark.slow
def test_both_parts_move_together(
    pairs: tuple[list[Array], PlacedParts, list[str]], depths: tuple[Array, Array]
) -> None:
    parts, placed, names = pairs
    rows = np.arange(len(names))
    moved = PlacedParts(placed.part, SPIN @ placed.rotation, placed.translation @ SPIN.T + (0.3, -0.2, 0.4))
    depth, _ = PenetrationDepth(parts)(moved, rows, rows + len(rows))
    np.testing.assert_allclose(np.maximum(depth, 0.0), np.maximum(depths[0], 0.0), atol=1e-12, rtol=0)


@pytest.mark.slow
def test_a_pair_does_not_depend_on_the_others(
    pairs: tuple[list[Array], PlacedParts, list[str]], depths: tuple[Array, Array]
) -> None:
    """Bit for bit: alone, in another order, and many times over."""
    parts, placed, names = pairs
    solver = PenetrationDepth(parts)
    count = len(names)
    order = np.random.default_rng(0).permutation(count)
    depth, direction = solver(placed, order, order + count)
    assert (depth == depths[0][order]).all()
    assert (direction == depths[1][order]).all()
    for row in range(0, count, 11):
        alone = np.array([row])
        depth, direction = solver(placed, alone, alone + count)
        assert depth[0] == depths[0][row]
        assert (direction[0] == depths[1][row]).all()
    again, _ = solver(placed, np.full(500, order[0]), np.full(500, order[0] + count))
    assert (again == depths[0][order[0]]).all()


def test_no_pairs_and_poses_that_are_none() -> None:
    """NaN and infinity come back as NaN for that pair alone."""
    rotation = np.stack([np.eye(3)] * 4)
    rotation[2, 0, 0] = np.nan
    translation = np.array([CENTER, (0.9, 0.0, 0.0), CENTER, (np.inf, 0.0, 0.0)])
    placed = PlacedParts(np.zeros(4, dtype=np.int64), rotation, translation)
    solver = PenetrationDepth([CUBE])
    depth, direction = solver(placed, np.array([0, 0, 3, 0]), np.array([1, 2, 3, 3]))
    assert depth[0] == pytest.approx(0.1, abs=1e-12)
    assert np.isnan(depth[1:]).all()
    assert np.isnan(direction[1:]).all()
    nothing = np.empty(0, dtype=np.int64)
    assert [part.shape for part in solver(placed, nothing, nothing)] == [(0,), (0, 3)]


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
def test_features_are_those_of_the_solid(corners: Array, faces: int, edges: int) -> None:
    """No diagonals of flat faces; points inside and twice the same corner change nothing."""
    for vertices in (corners, np.concatenate([corners, corners[:2], corners.mean(axis=0, keepdims=True)])):
        features = PartFeatures.of(vertices)
        assert len(features.corners) == len(corners)
        assert len(features.normals) == faces
        assert len(features.edge_point) == edges
        assert (features.normals @ corners.T <= features.offsets[:, None] + 1e-12).all()
        ends = np.einsum("ei,ei->e", features.edge_point, features.edge_outward)
        assert (features.edge_outward @ corners.T <= ends[:, None] + 1e-12).all()


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
def test_generic_pairs_agree_with_fcl(
    pairs: tuple[list[Array], PlacedParts, list[str]], depths: tuple[Array, Array]
) -> None:
    """In another process, because FCL may abort the one it runs in. It iterates to 1e-6 of a length."""
    pytest.importorskip("fcl")
    parts, placed, names = pairs
    rows = [row for row, name in enumerate(names) if name == "overlapping at random"][:150]
    lines = []
    for row in rows:
        sides = []
        for item in (row, row + len(names)):
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
    assert np.percentile(np.abs(found - depths[0][rows][: len(found)]), 90) < 1e-6
