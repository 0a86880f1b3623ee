"""The rasteriser: what it covers and how far away, by closed forms, and by the rays of MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh

from scene_envs.assets import get_library
from scene_envs.errors import InvalidInputError
from scene_envs.render.raster import Pinhole, visible_triangles
from scene_envs.render.stage import Stage

ALONG = Pinhole(np.eye(4), 50.0, 50.0, 100.0, 50.0, 200, 100)
"""Looks along z with x right and y down: its frame is the world's."""


def rays(camera):
    """(H, W, 3): the points at depth 1 in the middle of each pixel, camera frame."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], axis=-1)


def visible(triangles, camera=ALONG):
    """What the camera sees of triangles (T, 3, 3) in its frame."""
    return visible_triangles(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), camera)


def test_a_sphere_covers_the_disc_that_its_tangent_cone_cuts():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
    faces, depth = visible(sphere.triangles + np.array([0.0, 0.0, 2.0]))
    radius = 50.0 * 0.5 / np.sqrt(2.0**2 - 0.5**2)  # pixels
    rows, columns = np.indices(faces.shape) + 0.5
    distance = np.hypot(columns - 100.0, rows - 50.0)
    assert (faces[distance < radius - 0.1] >= 0).all()
    assert (faces[distance > radius] == -1).all()
    slope = rays(ALONG)
    square = (slope**2).sum(axis=-1)  # |t d - c| = r with c = (0, 0, 2)
    with np.errstate(invalid="ignore"):
        expected = (2.0 - np.sqrt(4.0 - square * (4.0 - 0.25))) / square
    inner = distance < 0.95 * radius
    np.testing.assert_allclose(depth[inner], expected[inner], atol=1e-3)
    assert np.isinf(depth[faces < 0]).all()


def test_a_box_covers_the_rectangle_of_its_front():
    box = trimesh.creation.box((0.8, 0.4, 0.2))
    faces, depth = visible(box.triangles + np.array([0.1, 0.0, 1.1]))
    expected = np.zeros((100, 200), dtype=bool)
    expected[40:60, 85:125] = True  # 50 pixels x (-0.3 ... 0.5, -0.2 ... 0.2), front at 1 m
    np.testing.assert_array_equal(faces >= 0, expected)
    np.testing.assert_allclose(depth[expected], 1.0, rtol=1e-6)


def test_a_floor_that_passes_under_the_camera_is_seen_up_to_the_horizon():
    """The plane y = 1.5, whose triangles reach behind the camera: depth 1.5 / slope below the middle row."""
    a, b, c, d = ([x, 1.5, z] for x, z in ((-1e4, 1e4), (1e4, 1e4), (1e4, -1e4), (-1e4, -1e4)))
    faces, depth = visible(np.array([[a, b, c], [a, c, d]]))
    assert (faces[:50] == -1).all()
    assert (faces[50:] >= 0).all()
    np.testing.assert_allclose(depth[50:], np.tile(1.5 / rays(ALONG)[50:, :1, 1], (1, 200)), rtol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_neighbours_leave_no_gap_and_do_not_overlap(seed):
    """A tilted plane cut into triangles of all shapes, some far thinner than a pixel."""
    rng = np.random.default_rng(seed)
    from scipy.spatial import Delaunay

    flat = np.concatenate([rng.uniform(-9.0, 9.0, (800, 2)), [[-9, -9], [-9, 9], [9, -9], [9, 9]]])
    points = np.column_stack([flat, 3.0 - 0.2 * flat[:, 0]])
    triangles = points[Delaunay(flat).simplices]
    faces, depth = visible(triangles)
    slope = rays(ALONG)
    inside = np.abs(slope[..., 0] * depth) < 8.9
    expected = 3.0 / (1.0 + 0.2 * slope[..., 0])
    assert inside.sum() > 15_000
    assert (faces[inside] >= 0).all()
    np.testing.assert_allclose(depth[inside], expected[inside], rtol=1e-5)
    single = np.concatenate([visible(triangles[k::7])[0].ravel() for k in range(7)])
    assert (single >= 0).sum() == (faces >= 0).sum()  # each pixel belongs to one triangle


def test_colors_are_interpolated_in_the_triangle_and_not_in_the_image():
    """Colours of corners that are linear in the place give the colour of the visible place, also in perspective."""
    stage = Stage(("teapot",))
    stage.place(np.zeros((1, 3)), np.eye(3)[None], np.zeros(1, dtype=np.int64))
    stage._colors, stage._normals = 100.0 + 300.0 * stage._vertices, 0.0 * stage._normals
    camera = Pinhole.at((0.2, -0.15, 0.2), (0.0, 0.0, 0.06), (0.0, 0.0, 1.0), 60.0, 96, 72)
    frame = stage.look(camera)
    rows, columns = np.nonzero(frame.faces >= 0)
    assert len(rows) > 500
    points = rays(camera)[rows, columns] * frame.depth[rows, columns, None]
    faces = frame.faces[rows, columns]
    color = stage.paint(camera, faces, points.astype(np.float32), stage.normals(camera), np.array([0.0, 0.0, 1.0]))
    world = points @ camera.pose[:3, :3].T + camera.pose[:3, 3]
    np.testing.assert_allclose(color, 0.70 * (100.0 + 300.0 * world), atol=0.02)


def test_depths_are_those_of_rays_of_mujoco():
    mesh = get_library(("teapot",))["teapot"].visual
    spec = mujoco.MjSpec()
    vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    spec.add_mesh(name="teapot", uservert=vertices.ravel(), userface=faces.ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="teapot")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    position = (0.3, -0.35, 0.4)
    camera = Pinhole.at(position, (0.0, 0.0, 0.06), (0.0, 0.0, 1.0), 25.0, 48, 36)
    directions = (rays(camera) @ camera.view[:3, :3]).reshape(-1, 3)
    geom, distance = np.empty(len(directions), np.int32), np.empty(len(directions))
    lengths = np.linalg.norm(directions, axis=1)
    unit = (directions / lengths[:, None]).ravel()
    mujoco.mj_multiRay(model, data, position, unit, None, True, -1, geom, distance, None, len(lengths), 10.0)
    stage = Stage(("teapot",))
    stage.place(np.zeros((1, 3)), np.eye(3)[None], np.zeros(1, dtype=np.int64))
    depth = stage.look(camera).depth.ravel()
    hit = geom >= 0
    assert hit.sum() > 300
    assert (hit != np.isfinite(depth)).sum() <= 2  # rays through an edge of the outline
    both = hit & np.isfinite(depth)
    difference = np.abs(depth[both] - (distance / lengths)[both])
    assert np.quantile(difference, 0.99) < 1e-5


def test_a_turned_object_has_its_slot_and_its_light():
    """A book upside down, lit at 60 degrees and from below: the second lamp does not reach the side that is seen."""
    stage = Stage(("book",))
    turn = np.diag([1.0, -1.0, -1.0])
    stage.place(np.array([[9.0, 9.0, 9.0], [0.0, 0.0, 0.0]]), np.stack([np.eye(3), turn]), np.array([1, 0]))
    camera = Pinhole.at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 45.0, 40, 30)
    frame = stage.look(camera)
    assert set(np.unique(frame.slots)) == {-1, 1}
    rows, columns = np.nonzero(frame.slots == 1)
    points = (rays(camera) * frame.depth[..., None])[rows, columns].astype(np.float32)
    faces, normals = frame.faces[rows, columns], stage.normals(camera)
    lights = np.array([[np.sqrt(3.0), 0.0, 1.0], [0.0, 0.0, -1.0]])
    above, below = (stage.paint(camera, faces, points, normals, light) for light in lights)
    np.testing.assert_allclose(below / above, 0.70 / (0.70 + 0.40 * 0.5), rtol=0.01)


def test_a_camera_without_a_direction_is_refused():
    with pytest.raises(InvalidInputError, match="cannot look at"):
        Pinhole.at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 45.0, 4, 4)
    with pytest.raises(InvalidInputError, match="cannot look at"):
        Pinhole.at((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), 45.0, 4, 4)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"fx": 0.0}, "a camera's fx=0.0 must be a positive number"),
        ({"fy": -3.0}, "a camera's fy=-3.0 must be a positive number"),
        ({"near": 0.0}, "a camera's near=0.0 must be a positive number"),
        ({"cx": np.nan}, "a camera's cx=nan must be a finite number"),
        ({"width": 0}, "a camera's width=0 must be at least 1"),
        ({"pose": np.eye(3)}, r"\(4, 4\) rigid motion"),
        ({"pose": np.diag([1.0, 1.0, -1.0, 1.0])}, "rigid motion"),
        ({"pose": np.diag([2.0, 2.0, 2.0, 1.0])}, "rigid motion"),
    ],
)
def test_impossible_cameras_are_refused(values, message):
    with pytest.raises(InvalidInputError, match=message):
        replace(ALONG, **values)
    with pytest.raises(InvalidInputError, match="between 0 and 180 degrees, got fov_y=180"):
        Pinhole.at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 180.0, 4, 4)
