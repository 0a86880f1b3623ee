"""Framing of picture cameras and lamps: visible supports and objects, also without a hand-set camera."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from scene_envs import scene_types
from scene_envs.assets.shapes import winding_number
from scene_envs.datasets import to_union
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.render import picture_camera
from scene_envs.render.raster import Pinhole
from scene_envs.render.stage import (
    Frame,
    contact_shade,
    fit_camera,
    frame_scene_type,
    light_camera,
    scene_type_of_one,
    soft_shadow,
)
from scene_envs.scene_types import Camera, FixedObject, SceneType, get_scene_type, union_scene_type

BUILT_IN = [scene_type.name for scene_type in scene_types.BUILT_IN]


def in_image(points, camera):
    """(P, 2): x and y in -1..1 across the image, and depth (m), by the textbook."""
    position, target = np.array(camera.position), np.array(camera.target)
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, camera.up)
    right /= np.linalg.norm(right)
    offset = np.asarray(points) - position
    depth = offset @ forward
    slope = np.tan(np.radians(camera.fov_y) / 2.0)
    across = offset @ right / depth / (slope * camera.width / camera.height)
    return np.stack([across, offset @ np.cross(right, forward) / depth / slope], axis=1), depth


def fixed_vertices(scene_type):
    vertices = []
    for fixed in scene_type.fixed:
        rotation = np.reshape(fixed.rotation, (3, 3))
        vertices += [
            p.vertices @ rotation.T + np.array(fixed.translation) for p in scene_type.library[fixed.asset].fine
        ]
    return np.concatenate(vertices)


def own_type(name, fixed=(), workspace=((-0.15, -0.30, -0.42), (0.15, 0.30, 0.62)), assets=("teacup", "shelf")):
    camera = Camera((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    welded = tuple({f.asset for f in fixed})
    return SceneType(name, assets, 5, workspace, welded, tuple(fixed), camera)


@pytest.mark.parametrize("name", BUILT_IN)
@pytest.mark.parametrize(("width", "height"), [(480, 360), (200, 400), (900, 300)])
def test_the_support_is_seen_whole_and_fills_the_picture(name, width, height):
    scene_type = get_scene_type(name)
    camera = picture_camera(scene_type, width, height)
    points = frame_scene_type(scene_type).points
    places, depth = in_image(points, camera)
    assert (depth > 0).all()
    assert np.abs(places).max() <= 0.951
    assert (np.ptp(places, axis=0) >= 1.899).any()  # from border to border in one direction
    vertices = fixed_vertices(scene_type)
    top = vertices if "shelf" in name else vertices[vertices[:, 2] > vertices[:, 2].max() - 0.03]
    assert np.abs(in_image(top, camera)[0]).max() <= 0.951


@pytest.mark.parametrize("name", BUILT_IN)
def test_the_lamp_sees_everything_that_the_picture_shows(name):
    scene_type = get_scene_type(name)
    camera = light_camera(scene_type)
    x, y, depth = camera.pose[:3, :3].T @ (frame_scene_type(scene_type).points - camera.pose[:3, 3]).T
    assert np.abs(2.0 * (camera.fx * x / depth + camera.cx) / camera.width - 1.0).max() < 1.0
    assert np.abs(2.0 * (camera.fy * y / depth + camera.cy) / camera.height - 1.0).max() < 1.0
    assert (depth > 0).all()


@pytest.mark.parametrize("yaw", [0.0, 90.0, 180.0, 270.0])
def test_a_shelf_is_seen_from_its_open_side_whichever_way_it_faces(yaw):
    a = np.radians(yaw)
    rotation = (np.cos(a), -np.sin(a), 0.0, np.sin(a), np.cos(a), 0.0, 0.0, 0.0, 1.0)
    framing = frame_scene_type(own_type(f"shelf_{yaw}", [FixedObject("shelf", rotation=rotation)]))
    open_side = np.array([np.cos(a), np.sin(a), 0.0])
    assert framing.to_camera @ open_side > 0.8
    assert framing.to_light @ open_side > 0.3  # the lamp shines into it
    assert 0.1 < framing.to_camera[2] < 0.5


def test_a_vessel_is_looked_into_from_above_and_open_ground_at_an_angle():
    crate = own_type(
        "crate", [FixedObject("fruit_bowl")], ((-0.1, -0.1, 0.0), (0.1, 0.1, 0.12)), ("apple_gala", "fruit_bowl")
    )
    assert frame_scene_type(crate).to_camera[2] > 0.75
    ground = own_type("ground", (), ((-1.0, -2.0, 0.5), (1.0, 2.0, 1.5)), ("teacup",))
    framing = frame_scene_type(ground)
    assert framing.ground == 0.5
    assert 0.5 < framing.to_camera[2] < 0.8
    assert framing.to_camera[0] > abs(framing.to_camera[1])  # the longer side lies across the picture
    corners = [[x, y, 0.5] for x in (-1, 1) for y in (-2, 2)]
    assert np.abs(in_image(corners, picture_camera(ground))[0]).max() <= 0.951


def test_fitted_cameras_are_as_near_as_they_can_be():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3)) * [1.0, 0.3, 0.2]
    toward = np.array([0.48, -0.6, 0.64])
    position, target = fit_camera(points, toward, 40.0, 1.5, 0.1)
    np.testing.assert_allclose(np.cross(position - target, toward), 0.0, atol=1e-9)
    camera = Camera(tuple(position), tuple(target), (0.0, 0.0, 1.0), 150, 100, 40.0)
    places = in_image(points, camera)[0]
    assert np.abs(places).max() == pytest.approx(0.9)
    assert places[:, 0].max() == pytest.approx(0.9)
    assert places[:, 0].min() == pytest.approx(-0.9)


def test_wrong_arguments_are_named():
    with pytest.raises(UnknownNameError, match="did you mean 'dimsum_table'"):
        picture_camera("dimsum_tabel")
    with pytest.raises(InvalidInputError, match="height=0"):
        picture_camera("dimsum_table", 10, 0)


@pytest.mark.parametrize("name", ["dimsum_table", "pantry_shelf", "breakfast_table_low_clutter"])
def test_a_table_among_rooms_is_seen_from_near(name):
    """In a union with a room its support fills the picture as it does in a type of its own, and is the whole of it."""
    union = union_scene_type([name, "restaurant_low_clutter"])
    scene = to_union(get_grammar(name).sample(np.random.default_rng(0), 1), union)
    parts = (scene.translations[0].numpy(), scene.rotations[0].numpy(), scene.categories[0].numpy())
    seen = scene_type_of_one(union, *parts)
    camera = picture_camera(seen)
    own = get_scene_type(name)
    vertices = fixed_vertices(own)
    top = vertices if "shelf" in name else vertices[vertices[:, 2] > vertices[:, 2].max() - 0.03]
    places, depth = in_image(top, camera)
    assert (depth > 0).all()
    assert np.abs(places).max() <= 0.951
    assert np.ptp(places, axis=0).max() > 1.2
    objects = scene.translations[0][~scene.is_empty[0]].numpy()
    assert np.abs(in_image(objects, camera)[0]).max() <= 1.0
    assert np.dot(frame_scene_type(seen).to_camera, frame_scene_type(own).to_camera) > 0.9


def test_rooms_and_types_with_a_support_of_their_own_keep_their_view():
    for name in ("restaurant_low_clutter", "dimsum_table"):
        scene = get_grammar(name).sample(np.random.default_rng(0), 1)
        parts = (scene.translations[0].numpy(), scene.rotations[0].numpy(), scene.categories[0].numpy())
        assert scene_type_of_one(scene.scene_type, *parts) is scene.scene_type


def looking_down(height, depth):
    """A camera ``height`` m above the origin, 90 degree field of view, and the points that it sees at ``depth``."""
    depth = np.asarray(depth, dtype=np.float32)
    rows, columns = depth.shape
    pose = np.eye(4)
    pose[:3] = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, height]]
    camera = Pinhole(pose, columns / 2, rows / 2, columns / 2, rows / 2, columns, rows)
    slots = np.where(np.isfinite(depth), 0, -1)
    rays = camera.rays(np.arange(columns) + 0.5, np.arange(rows)[:, None] + 0.5)
    return Frame(depth, slots, slots, camera), rays * np.where(np.isfinite(depth), depth, 0.0)[..., None]


UP = np.array([0.0, 0.0, -1.0], dtype=np.float32)
"""Normal of a floor in the frame of a camera that looks down."""


def test_rays_of_a_plane_lie_in_it_and_span_the_field_of_view():
    frame, points = looking_down(2.0, np.full((40, 40), 2.0))
    np.testing.assert_allclose(points[..., 2], 2.0)
    world = points @ frame.camera.pose[:3, :3].T + frame.camera.pose[:3, 3]
    np.testing.assert_allclose(world[0, 0], [-1.95, 1.95, 0.0], atol=1e-6)
    np.testing.assert_allclose(world[-1, -1], [1.95, -1.95, 0.0], atol=1e-6)
    np.testing.assert_allclose(frame.camera.view @ frame.camera.pose, np.eye(4), atol=1e-12)


def test_a_camera_of_another_size_has_the_same_view():
    frame, _ = looking_down(2.0, np.full((40, 40), 2.0))
    place = np.array([0.3, -0.4, 0.5, 1.0])
    for size in ((40, 40), (160, 80)):
        camera = frame.camera.resized(*size)
        x, y, z, _ = camera.view @ place
        column, row = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
        np.testing.assert_allclose([column / size[0], row / size[1]], [0.5 + 0.1, 0.5 + 0.4 / 3.0])


def test_a_block_between_lamp_and_floor_shades_what_is_under_it_only():
    floor = np.full((80, 80), 2.0)
    frame, points = looking_down(2.0, floor)
    lamp_depth = floor.copy()
    lamp_depth[30:50, 30:50] = 1.0  # the lamp stands at the camera and sees a block that the frame does not
    light, _ = looking_down(2.0, lamp_depth)
    shadow = soft_shadow(points.reshape(-1, 3) + 0.008 * UP, frame.camera, light, 0.004).reshape(80, 80)
    assert (shadow[34:46, 34:46] == 1.0).all()
    assert (shadow[:26] == 0.0).all()
    assert (shadow[:, 54:] == 0.0).all()
    assert shadow.sum() == pytest.approx(20 * 20, rel=0.1)


def test_a_surface_does_not_shadow_itself_and_the_backdrop_stays_bright():
    depth = np.full((40, 40), 2.0)
    depth[:, :10] = np.inf
    frame, points = looking_down(2.0, depth)
    assert (soft_shadow(points[:, 10:].reshape(-1, 3) + 0.008 * UP, frame.camera, frame, 0.004) == 0.0).all()
    assert (contact_shade(points, np.broadcast_to(UP, points.shape), frame.camera)[:, :8] == 0.0).all()


def test_corners_are_shaded_and_open_floor_is_not():
    depth = np.full((200, 200), 0.4)
    depth[:, 100:] = 0.36  # a step 4 cm high
    frame, points = looking_down(0.4, depth)
    shade = contact_shade(points, np.broadcast_to(UP, points.shape), frame.camera)
    assert shade[100, 94:98].mean() > 0.05
    assert shade[100, :60].max() < 1e-3
    assert shade[100, 104:].max() < 1e-3


def test_the_winding_number_counts_how_often_a_surface_encloses_a_point():
    box = trimesh.creation.box((1.0, 2.0, 3.0)).triangles
    inside, outside = np.array([0.3, -0.9, 1.2]), np.array([0.6, 0.0, 0.0])
    assert winding_number(box, inside) == pytest.approx(1.0)
    assert winding_number(box, outside) == pytest.approx(0.0, abs=1e-12)
    assert winding_number(box[:, ::-1], inside) == pytest.approx(-1.0)
    assert winding_number(np.concatenate([box, box]), inside) == pytest.approx(2.0)
    cube = trimesh.creation.box((1.0, 1.0, 1.0))
    half = cube.triangles[cube.face_normals[:, 2] < 0.5]  # without its top, a sixth of what its middle sees
    assert winding_number(half, np.zeros(3)) == pytest.approx(5.0 / 6.0)
