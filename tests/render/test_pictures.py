"""Pictures of scenes: class colours, positions, occlusion, batches, galleries and semantic maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_envs.errors import InvalidInputError
from scene_envs.render import gallery, observe, picture_camera, render
from scene_envs.rotations import yaw_matrix
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, get_scene_type

DIMSUM = get_scene_type("dimsum_table")


def scene(*objects, slots=8):
    """One scene with the table and ``objects`` (name, x, y, z, yaw)."""
    translations, categories = torch.zeros(1, slots, 3), torch.full((1, slots), DIMSUM.num_assets)
    yaws = torch.zeros(1, slots)
    categories[0, 0] = DIMSUM.assets.index("cafe_table")
    for slot, (name, x, y, z, yaw) in enumerate(objects, start=1):
        categories[0, slot] = DIMSUM.assets.index(name)
        translations[0, slot], yaws[0, slot] = torch.tensor([x, y, z]), yaw
    return SceneBatch.from_parts(translations, yaw_matrix(yaws), categories, DIMSUM)


def semantic(batch, camera=None):
    return observe(batch, None if camera is None else [camera], ["semantic"])[0]["semantic"]


def color(name):
    return np.array(DIMSUM.library[name].color, dtype=np.uint8)


def where(image, name):
    """(row, column) of the pixels that show ``name`` in a semantic image."""
    return np.argwhere((image == color(name)).all(axis=-1))


@pytest.mark.slow
def test_semantic_images_have_class_colors_and_nothing_else():
    batch = scene(("teapot", 0.2, 0.1, 0, 0), ("dinner_plate", -0.3, 0.0, 0, 0))
    image = semantic(batch)[0]
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    found = {tuple(value) for value in np.unique(image.reshape(-1, 3), axis=0).tolist()}
    assert found == {(255, 255, 255), *(DIMSUM.library[n].color for n in ("cafe_table", "teapot", "dinner_plate"))}


def test_objects_appear_where_a_pinhole_camera_puts_them():
    x, y = 0.3, -0.2
    pixels = where(semantic(scene(("dinner_plate", x, y, 0.0, 0.4)))[0], "dinner_plate")
    focal = 240.0 / np.tan(np.radians(22.5))  # pixels
    depth = 1.7 - 0.011  # m, to the middle of the plate
    # The camera looks down with -x up in the image, so +x is down and +y is right.
    expected = [240.0 + focal * x / depth, 320.0 + focal * y / depth]
    np.testing.assert_allclose(pixels.mean(axis=0) + 0.5, expected, atol=1.5)
    diameter = pixels.max(axis=0) - pixels.min(axis=0) + 1
    np.testing.assert_allclose(diameter, focal * 0.27 / 1.68, atol=2.5)


def test_nearer_objects_hide_farther_ones():
    image = semantic(scene(("teacup", 0, 0, 0, 0), ("serving_dish", 0, 0, 0.3, 0)))[0]
    assert len(where(image, "serving_dish")) > 0
    assert len(where(image, "teacup")) == 0


def test_pictures_do_not_depend_on_slot_order_or_on_what_was_drawn_before():
    batch = scene(("teapot", 0.2, 0.1, 0, 0.3), ("teapot", -0.2, 0.1, 0, 1.0), ("teacup", 0.0, -0.3, 0, 2.0))
    first = render(batch, width=80, height=60)
    render(scene(*[("teapot", 0.1 * k, 0.3, 0, 0) for k in range(5)]), width=16, height=12)
    again = render(SceneBatch(batch.tensor.flip(1), DIMSUM), width=80, height=60)
    np.testing.assert_array_equal(first, again)


@pytest.mark.slow
def test_batches_are_drawn_scene_by_scene():
    scenes = [scene(("teapot", 0.2, 0.1, 0, 0)), scene(), scene(("teacup", 0.2, 0.1, 0, 0))]
    together = render(SceneBatch.concatenate(scenes), width=64, height=48)
    assert together.shape == (3, 48, 64, 3)
    for index, single in enumerate(scenes):
        np.testing.assert_array_equal(together[index], render(single, width=64, height=48)[0])


def test_objects_cast_shadows_on_the_table():
    steamers = [("steamer_bottom", 0.0, 0.0, 0.091 * k, 0) for k in range(3)]
    with_stack, without = (render(s, width=160, height=120)[0].astype(int) for s in (scene(*steamers), scene()))
    camera = picture_camera(DIMSUM)
    (image,) = semantic(scene(*steamers), replace(camera, width=160, height=120))
    on_table = (image == color("cafe_table")).all(axis=-1)
    darker = (without - with_stack).min(axis=-1) > 12
    assert (darker & on_table).sum() > 100


def test_highlighted_objects_turn_red_and_others_keep_their_color():
    batch = scene(("dinner_plate", 0.0, 0.3, 0, 0), ("dinner_plate", 0.0, -0.3, 0, 0))
    mask = torch.zeros(1, 8, dtype=torch.bool)
    mask[0, 1] = True
    plain, marked = (render(batch, width=160, height=120, highlight=h)[0].astype(int) for h in (None, mask))
    changed = np.argwhere((plain != marked).any(axis=-1))
    assert len(changed) > 50
    assert (np.ptp(changed, axis=0) < 60).all()  # one plate, not two
    row, column = changed.mean(axis=0).astype(int)
    red, green, blue = marked[row, column]
    assert red > green + 40
    assert red > blue + 40


def test_an_own_camera_is_used():
    away = Camera(position=(0, 0, 1.7), target=(0, 0, 5.0), up=(1, 0, 0), width=20, height=10)
    with pytest.warns(UserWarning, match=r"camera 0 at \[0.0, 0.0, 1.7\] sees no object of 1 scenes"):
        image = semantic(scene(), away)
    assert image.shape == (1, 10, 20, 3)
    assert (image == 255).all()


def test_an_empty_batch_gives_no_images():
    assert render(SceneBatch.empty(DIMSUM, 0), width=20, height=10).shape == (0, 10, 20, 3)


def test_wrong_arguments_are_named():
    with pytest.raises(InvalidInputError, match="width=0"):
        render(scene(), width=0)
    with pytest.raises(InvalidInputError, match=r"\(1, 8\); got \(1, 3\)"):
        render(scene(), highlight=torch.zeros(1, 3, dtype=torch.bool))


def test_gallery_tiles_row_by_row_and_keeps_pixels():
    images = np.stack([np.full((30, 40, 3), 10 * k, np.uint8) for k in range(5)])
    page = np.asarray(gallery(images, columns=2, gap=6))
    assert page.shape == (3 * 36 + 6, 2 * 46 + 6, 3)
    np.testing.assert_array_equal(page[6:36, 52:92], images[1])
    np.testing.assert_array_equal(page[42:72, 6:46], images[2])
    assert (page[78:108, 52:92] == 255).all()


def test_gallery_writes_captions_below_their_images():
    images = np.full((2, 60, 80, 3), 255, np.uint8)
    page = np.asarray(gallery(images, columns=2, captions=["one", ""], gap=4))
    ink = np.argwhere((page < 128).all(axis=-1))
    assert len(ink) > 0
    assert ink[:, 0].min() >= 64  # below the image
    assert ink[:, 1].max() < 84  # of the first one


def test_gallery_says_what_is_wrong():
    image = np.zeros((4, 4, 3), np.uint8)
    with pytest.raises(InvalidInputError, match="at least one image"):
        gallery([])
    with pytest.raises(InvalidInputError, match="one size"):
        gallery([image, np.zeros((4, 5, 3), np.uint8)])
    with pytest.raises(InvalidInputError, match="2 captions, got 1"):
        gallery([image, image], captions=["a"])
    with pytest.raises(InvalidInputError, match="columns"):
        gallery([image], columns=0)


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
    images = semantic(one_object_each(scene_type, assets, place))
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
    image = semantic(SceneBatch.empty(scene_type, 1))[0]
    model = scene_type.library[fixed.asset]
    points = np.asarray(model.visual.vertices) + np.array(fixed.translation)
    np.testing.assert_allclose(outline_of_color(image, model.color), outline(points, CAMERAS[name]), atol=1.5)
    assert colors_of(image) == {model.color, (255, 255, 255)}


def test_welded_objects_of_a_room_are_drawn_at_their_own_poses():
    room = get_scene_type("restaurant_low_clutter")
    height = -0.785 - float(room.library["shelf"].bounds[0, 2])
    for asset, place in (("cafe_table", (2.0, 1.0, 0.0)), ("shelf", (-4.0, 2.0, height))):
        image = semantic(one_object_each(room, [asset], place))[0]
        model = room.library[asset]
        points = np.asarray(model.visual.vertices) @ yaw_matrix(torch.tensor(YAW)).numpy().T + np.array(place)
        expected = outline(points, CAMERAS[room.name])
        np.testing.assert_allclose(outline_of_color(image, model.color), expected, atol=1.5)


@pytest.mark.parametrize("name", CAMERAS)
def test_every_asset_of_a_scene_type_has_a_color_of_its_own(name):
    colors = [asset.color for asset in get_scene_type(name).library]
    assert len(set(colors)) == len(colors)
    assert (255, 255, 255) not in colors  # the background
