"""Semantic renders of all scene types: the paper's cameras, class colours, geometry."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from scene_envs.render import render
from scene_envs.rotations import yaw_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type

pytest.importorskip("pybullet")

FOCAL = 240.0 / np.tan(np.radians(22.5))  # pixels, for 480 rows and 45 degrees
# Right, down and forward in the world frame, and the position (m), as the paper has them.
FROM_ABOVE = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
AT_A_SHELF = [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]]
CAMERAS = {
    "breakfast_table_low_clutter": (FROM_ABOVE, (0.0, 0.0, 1.5)),
    "breakfast_table_high_clutter": (FROM_ABOVE, (0.0, 0.0, 1.5)),
    "dimsum_table": (FROM_ABOVE, (0.0, 0.0, 1.7)),
    "living_room_shelf": (AT_A_SHELF, (1.2, 0.0, 0.1)),
    "pantry_shelf": (AT_A_SHELF, (1.2, 0.0, 0.1)),
    "restaurant_low_clutter": (FROM_ABOVE, (0.0, 0.0, 13.0)),
    "restaurant_high_clutter": (FROM_ABOVE, (0.0, 0.0, 13.0)),
}
# Where an object hides nothing of itself behind the fixed one.
IN_SIGHT = {"b": (0.1, -0.12, 0.03), "d": (0.1, -0.12, 0.03), "l": (0.45, 0.1, 0.02), "p": (0.45, 0.1, 0.02)}
YAW = 0.6


def one_object_each(scene_type, assets, place):
    """A scene per asset, with the fixed objects and that asset alone."""
    batch = SceneBatch.empty(scene_type, len(assets), slots=4)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    rotations = torch.where(batch.is_empty[..., None, None], yaw_matrix(torch.tensor(YAW)), batch.rotations)
    for scene, asset in enumerate(assets):
        translations[scene, 3], categories[scene, 3] = torch.tensor(place), scene_type.assets.index(asset)
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def outline(points, camera):
    """First column and row, last column and row (pixels) of points (P, 3) in a pinhole camera."""
    axes, position = camera
    right, down, forward = np.array(axes) @ (points - np.array(position)).T
    pixels = np.stack([320.0 + FOCAL * right / forward, 240.0 + FOCAL * down / forward], axis=1)
    return np.clip([pixels.min(axis=0), pixels.max(axis=0)], 0.0, (640.0, 480.0))


def colors_of(image):
    codes = np.unique(image.astype(np.int64) @ [1 << 16, 1 << 8, 1])
    return {(code >> 16, code >> 8 & 255, code & 255) for code in codes.tolist()}


def outline_of_color(image, color):
    rows, columns = np.nonzero((image == np.array(color, dtype=np.uint8)).all(axis=-1))
    return np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_objects_are_where_the_pinhole_equations_put_them(name):
    scene_type = get_scene_type(name)
    free = [asset for asset in scene_type.assets if asset not in {fixed.asset for fixed in scene_type.fixed}]
    assets = free[:: max(1, len(free) // 4)][:5]
    place = IN_SIGHT.get(name[0], (1.3, -2.1, 0.0))
    images = render(one_object_each(scene_type, assets, place), style="semantic")
    assert images.shape == (len(assets), 480, 640, 3)
    turn = yaw_matrix(torch.tensor(YAW, dtype=torch.float64)).numpy()
    for asset, image in zip(assets, images, strict=True):
        model = scene_type.library[asset]
        points = np.asarray(model.visual.vertices) @ turn.T + np.array(place)
        found = outline_of_color(image, model.color)
        np.testing.assert_allclose(found, outline(points, CAMERAS[name]), atol=1.5, err_msg=asset)
        present = {(255, 255, 255), model.color, *(scene_type.library[fixed.asset].color for fixed in scene_type.fixed)}
        assert colors_of(image) == present


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_the_fixed_object_is_drawn_where_it_is(name):
    scene_type = get_scene_type(name)
    (fixed,) = scene_type.fixed
    image = render(SceneBatch.empty(scene_type, 1), style="semantic")[0]
    model = scene_type.library[fixed.asset]
    points = np.asarray(model.visual.vertices) + np.array(fixed.translation)
    np.testing.assert_allclose(outline_of_color(image, model.color), outline(points, CAMERAS[name]), atol=1.5)
    assert colors_of(image) == {model.color, (255, 255, 255)}


def test_welded_objects_of_a_room_are_drawn_at_their_own_poses():
    room = get_scene_type("restaurant_low_clutter")
    height = -0.785 - float(room.library["shelf"].bounds[0, 2])
    for asset, place in (("cafe_table", (2.0, 1.0, 0.0)), ("shelf", (-4.0, 2.0, height))):
        image = render(one_object_each(room, [asset], place), style="semantic")[0]
        model = room.library[asset]
        points = np.asarray(model.visual.vertices) @ yaw_matrix(torch.tensor(YAW)).numpy().T + np.array(place)
        expected = outline(points, CAMERAS[room.name])
        np.testing.assert_allclose(outline_of_color(image, model.color), expected, atol=1.5)


@pytest.mark.parametrize("name", CAMERAS)
def test_every_asset_of_a_scene_type_has_a_color_of_its_own(name):
    colors = [asset.color for asset in get_scene_type(name).library]
    assert len(set(colors)) == len(colors)
    assert (255, 255, 255) not in colors  # the background
