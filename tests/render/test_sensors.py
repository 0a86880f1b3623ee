"""Images of sensors: by the rays of trimesh, by each other, and for cameras that see nothing or too much."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from trimesh.ray.ray_triangle import ray_triangle_id

from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import get_grammar
from scene_envs.render import Pinhole, observe, picture_camera, render
from scene_envs.render.pictures import MODES
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, get_scene_type


class Boxes:
    """The boxes of triangles, as trimesh asks them which meet a box; its own tree needs one more package."""

    def __init__(self, mesh):
        self.low, self.high, self.bounds = mesh.triangles.min(axis=1), mesh.triangles.max(axis=1), mesh.bounds.ravel()

    def intersection(self, bounds):
        return np.flatnonzero((self.low <= bounds[3:]).all(axis=1) & (self.high >= bounds[:3]).all(axis=1))


def drawn(name, count=1, seed=0):
    return get_grammar(name).sample(np.random.default_rng(seed), count)


def placed(batch):
    """All visual meshes of the one scene as one mesh, and the slot of each triangle."""
    meshes, slots = [], []
    for slot in np.flatnonzero(~batch.is_empty[0].numpy()):
        mesh = batch.scene_type.library[int(batch.categories[0, slot])].visual
        turn, shift = batch.rotations[0, slot].double().numpy(), batch.translations[0, slot].double().numpy()
        meshes.append(trimesh.Trimesh(np.asarray(mesh.vertices) @ turn.T + shift, mesh.faces, process=False))
        slots += [slot] * len(mesh.faces)
    mesh = trimesh.util.concatenate(meshes)
    kept = trimesh.triangles.nondegenerate(mesh.triangles)
    mesh.update_faces(kept)
    return mesh, np.array(slots)[kept]


def own_camera(name):
    """A camera with two focal lengths and a principal point off the middle of its image, rolled by 20 degrees."""
    camera = picture_camera(name, 160, 120)
    view = Pinhole.at(camera.position, camera.target, camera.up, camera.fov_y, 160, 120)
    a = np.radians(20.0)
    roll = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    pose = view.pose.copy()
    pose[:3, :3] = pose[:3, :3] @ roll
    return Pinhole(pose, 190.0, 230.0, 71.5, 66.25, 160, 120)


def away_from_outlines(image):
    """Pixels whose eight neighbours show the same value, or values that are nearly the same."""
    same = np.ones(image.shape[:2], dtype=bool)
    for down in (-1, 0, 1):
        for across in (-1, 0, 1):
            other = np.roll(image, (down, across), axis=(0, 1))
            same &= np.isclose(image, other, atol=1e-5).reshape(*image.shape[:2], -1).all(axis=-1)
    same[[0, -1]] = same[:, [0, -1]] = False
    return same


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dimsum_table", "pantry_shelf", "restaurant_low_clutter"])
def test_depth_normals_and_masks_are_those_of_rays_of_trimesh(name):
    batch, camera = drawn(name), own_camera(name)
    (view,) = observe(batch, [camera])
    mesh, slot_of = placed(batch)
    mesh.apply_transform(np.linalg.inv(camera.pose))
    inner = away_from_outlines(view["instance"][0]) & (view["instance"][0] >= 0)
    rows, columns = np.nonzero(inner)
    chosen = np.random.default_rng(0).permutation(len(rows))[:120]
    rows, columns = rows[chosen], columns[chosen]
    # The textbook: a pixel with its middle at (u, v) looks along ((u - cx) / fx, (v - cy) / fy, 1)
    rays = np.stack([(columns + 0.5 - 71.5) / 190.0, (rows + 0.5 - 66.25) / 230.0, np.ones(len(rows))], axis=1)
    face, ray, points = ray_triangle_id(mesh.triangles, np.zeros((len(rays), 3)), rays, tree=Boxes(mesh))
    order = np.lexsort((points[:, 2], ray))
    ray, first = np.unique(ray[order], return_index=True)
    nearest, face = points[order, 2][first], face[order][first]
    assert len(ray) == len(rows) == 120
    depth, normals = view["depth"][0][rows, columns], view["normals"][0][rows, columns]
    off = np.abs(depth - nearest) > 1e-3
    np.testing.assert_array_equal(off, False)
    np.testing.assert_array_equal(view["instance"][0][rows, columns], slot_of[face])
    expected = mesh.face_normals[face]
    expected *= -np.sign(np.einsum("pk,pk->p", expected, rays))[:, None]
    expected = expected @ camera.pose[:3, :3].T
    flat = away_from_outlines(view["normals"][0])[rows, columns]  # rays through an edge may meet either triangle
    assert flat.sum() > 40
    np.testing.assert_allclose(normals[flat], expected[flat], atol=1e-4)
    assert (np.abs(normals - expected).max(axis=1) < 1e-4).mean() > 0.97


def test_the_images_of_a_view_agree():
    batch = drawn("dimsum_table", 2)
    cameras = [replace(batch.scene_type.camera, width=160, height=120), own_camera("dimsum_table")]
    for view, camera in zip(observe(batch, cameras, MODES), cameras, strict=True):
        shape = (2, camera.height, camera.width)
        seen = view["instance"] >= 0
        assert view["rgb"].shape == view["semantic"].shape == view["normals"].shape == (*shape, 3)
        assert view["depth"].dtype == view["normals"].dtype == np.float32
        np.testing.assert_array_equal(seen, np.isfinite(view["depth"]))
        np.testing.assert_array_equal(seen, view["category"] < batch.scene_type.num_assets)
        np.testing.assert_allclose(np.linalg.norm(view["normals"], axis=-1), seen, atol=1e-5)
        np.testing.assert_array_equal(view["rgb"], render(batch, camera=camera))
        colors = np.array([asset.color for asset in batch.scene_type.library] + [(255, 255, 255)])
        np.testing.assert_array_equal(view["semantic"], colors[view["category"]])
        for scene in range(2):
            categories = np.append(batch.categories[scene].numpy(), batch.scene_type.num_assets)
            np.testing.assert_array_equal(view["category"][scene], categories[view["instance"][scene]])
            for slot, box in enumerate(view["boxes"][scene]):
                rows, columns = np.nonzero(view["instance"][scene] == slot)
                found = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1] if len(rows) else [0] * 4
                assert box.tolist() == found


def test_a_depth_image_is_a_plane_of_points_in_the_world():
    """Points of the depth image, carried to the world by the pose, lie on the table where its colour is seen."""
    batch, camera = SceneBatch.empty("dimsum_table", 1), own_camera("dimsum_table")
    (view,) = observe(batch, [camera], ["depth", "normals"])
    up = view["normals"][0, ..., 2] > 0.999
    rows, columns = np.nonzero(up)
    assert len(rows) > 2000
    z = view["depth"][0][up]
    points = np.stack([(columns + 0.5 - 71.5) / 190.0 * z, (rows + 0.5 - 66.25) / 230.0 * z, z, np.ones(len(z))])
    height = (camera.pose @ points)[2]
    assert set(height.round(5).tolist()) <= {0.0, -0.0005}  # its rim is half a millimetre lower


def test_lens_and_place_say_the_same_as_intrinsics_and_pose():
    batch = drawn("breakfast_table_low_clutter")
    camera = replace(batch.scene_type.camera, width=64, height=48)
    focal = 24.0 / np.tan(np.radians(camera.fov_y / 2.0))
    pose = np.eye(4)
    # Right, down and forward of the paper's camera above a table
    pose[:3] = np.stack([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], camera.position], axis=1)
    first, second = observe(batch, [camera, Pinhole(pose, focal, focal, 32.0, 24.0, 64, 48)], ["depth", "instance"])
    np.testing.assert_allclose(first["depth"], second["depth"], atol=1e-5)
    assert (first["instance"] != second["instance"]).sum() <= 2


def test_no_scenes_give_no_images():
    (view,) = observe(SceneBatch.empty("dimsum_table", 0), modes=MODES)
    assert view["rgb"].shape == (0, 480, 640, 3)
    assert view["boxes"].shape[::2] == (0, 4)


def test_a_camera_inside_an_object_is_refused_and_one_in_its_hollow_is_not():
    batch = SceneBatch.empty("breakfast_table_low_clutter", 1)
    library = batch.scene_type.library
    table = library["breakfast_table"].visual
    top = table.bounds[1, 2] + batch.translations[0, 0, 2].item()
    inside = Camera((0.1, 0.05, top - 0.005), (0.1, 0.05, -1.0), (1.0, 0.0, 0.0), 32, 24)
    with pytest.raises(InvalidInputError, match=r"camera 1 at .* is inside the 'breakfast_table' in slot 0 of scene 0"):
        observe(batch, [batch.scene_type.camera, inside], ["depth"])
    under = Camera((0.1, 0.05, top - 0.3), (0.1, 0.05, 1.0), (1.0, 0.0, 0.0), 32, 24)  # within its bounding box
    assert np.isfinite(observe(batch, [under], ["depth"])[0]["depth"]).any()


def test_a_camera_that_looks_away_is_told():
    batch = SceneBatch.empty("dimsum_table", 2)
    away = Camera((0.0, 0.0, 2.0), (0.0, 0.0, 3.0), (1.0, 0.0, 0.0), 16, 12)
    with pytest.warns(UserWarning, match=r"camera 1 at \[0.0, 0.0, 2.0\] sees no object of 2 scenes"):
        views = observe(batch, [batch.scene_type.camera, away], ["depth"])
    assert np.isinf(views[1]["depth"]).all()


def test_wrong_arguments_are_named():
    batch = SceneBatch.empty("dimsum_table", 1)
    with pytest.raises(UnknownNameError, match="unknown image mode 'dept'; did you mean 'depth'"):
        observe(batch, modes=["dept"])
    with pytest.raises(InvalidInputError, match="cannot look at"):
        observe(batch, [Camera((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))])
    with pytest.raises(InvalidInputError, match="width=0"):
        observe(batch, [replace(get_scene_type("dimsum_table").camera, width=0)])
