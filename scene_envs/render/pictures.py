"""Lit pictures of scenes, and pages of several."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.arrays import Array, Index
from scene_envs.errors import InvalidInputError
from scene_envs.render.raster import Pinhole
from scene_envs.render.stage import (
    Stage,
    contact_shade,
    frame_scene_type,
    get_stage,
    light_camera,
    picture_camera,
    scene_type_of_one,
    soft_shadow,
    to_pinhole,
)
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, SceneType

if TYPE_CHECKING:
    from PIL import Image


_BACKDROP = np.array([[250.0, 249.0, 247.0], [226.0, 230.0, 235.0]], dtype=np.float32)
_HIGHLIGHT = np.array([226.0, 52.0, 40.0], dtype=np.float32)
_SHADOW = np.array([0.40, 0.38, 0.34], dtype=np.float32)
"""Share of red, green and blue that a full shadow takes away."""
_SUPERSAMPLING = 2
_TABLE = 0.68
"""Radius (m) of the framing of a dim sum table, for which contact shading is tuned."""
_PAGE, _INK = (255, 255, 255), (58, 62, 70)


def render(
    batch: SceneBatch,
    *,
    camera: Camera | Pinhole | None = None,
    width: int | None = None,
    height: int | None = None,
    highlight: torch.Tensor | NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """Lit pictures of scenes with soft shadows, drawn in software; no display, GPU or simulator is needed.

    :func:`~scene_envs.render.sensors.observe` gives depth, masks and other images of the same scenes.

    Args:
        batch: B scenes.
        camera: Camera in place of the three-quarter view of the scene type. Without it, a scene with just one support,
            in a type without fixed objects, is framed by this support.
        width: Image width, pixels; the camera's by default. The view of a picture is fitted to the image.
        height: Image height, pixels; the camera's by default.
        highlight: (B, N) bool, objects to draw in red.

    Returns:
        (B, H, W, 3) uint8, RGB.

    Raises:
        InvalidInputError: sizes below 1 pixel, a camera without a direction, or a highlight of another shape.
    """
    scene_type = batch.scene_type
    size = {name: value for name, value in (("width", width), ("height", height)) if value is not None}
    view = to_pinhole(camera or picture_camera(scene_type, **size), width, height)
    marked = _as_mask(highlight, batch)
    images = np.empty((len(batch), view.height, view.width, 3), dtype=np.uint8)
    for index, (stage, poses) in enumerate(stages(batch)):
        seen = scene_type if camera else scene_type_of_one(scene_type, *poses)
        own = view if seen is scene_type else to_pinhole(picture_camera(seen, view.width, view.height))
        images[index] = draw_picture(stage, own, seen, marked[index])
    return images


def stages(batch: SceneBatch) -> Iterator[tuple[Stage, tuple[Array, Array, Index]]]:
    """For each scene, the stage with its objects, which is the same one, and their translations (N, 3) m, rotations
    (N, 3, 3) and categories (N,).
    """
    translations = batch.translations.detach().cpu().double().numpy()
    rotations = batch.rotations.detach().cpu().double().numpy()
    categories = batch.categories.detach().cpu().numpy()
    stage = get_stage(batch.scene_type.assets, batch.scene_type.asset_folders)
    for poses in zip(translations, rotations, categories, strict=True):
        stage.place(*poses)
        yield stage, poses


def _as_mask(highlight: torch.Tensor | NDArray[np.bool_] | None, batch: SceneBatch) -> NDArray[np.bool_]:
    shape = tuple(batch.tensor.shape[:2])
    if highlight is None:
        return np.zeros(shape, dtype=bool)
    mask = highlight.detach().cpu().numpy() if isinstance(highlight, torch.Tensor) else np.asarray(highlight)
    if mask.shape != shape:
        raise InvalidInputError(f"highlight marks objects of the batch, so its shape is {shape}; got {mask.shape}")
    return mask.astype(bool)


def draw_picture(stage: Stage, camera: Pinhole, scene_type: SceneType, marked: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8: what ``camera`` sees of the objects on the stage, lit as scenes of the type are, with the slots
    ``marked`` (N,) in red. A pixel is the mean of 2 x 2 samples, which are shaded once where they show one triangle.
    """
    from scipy.ndimage import uniform_filter

    height, width, scale = camera.height, camera.width, _SUPERSAMPLING
    framing = frame_scene_type(scene_type)
    frame = stage.look(camera.resized(scale * width, scale * height))
    lamp = light_camera(scene_type)
    # Size (m) of a pixel of the lamp's image
    texel = 2.0 * np.linalg.norm(np.subtract(lamp.position, lamp.target)) / lamp.height
    texel *= np.tan(np.radians(lamp.fov_y) / 2.0)
    normals = stage.normals(camera)

    samples = [frame.faces[row::scale, column::scale] for row in range(scale) for column in range(scale)]
    first = samples[0]
    plain = np.logical_and.reduce([first == other for other in samples[1:]])
    rows, columns = np.nonzero(plain & (first >= 0))
    mixed_rows, mixed_columns = np.nonzero(~plain)
    down, across = np.indices((scale, scale)).reshape(2, 1, -1)
    fine_rows = (scale * mixed_rows[:, None] + down).ravel()
    fine_columns = (scale * mixed_columns[:, None] + across).ravel()
    ramp = np.linspace(0.0, 1.0, scale * height, dtype=np.float32)[:, None]
    backdrop = _BACKDROP[0] * (1.0 - ramp) + _BACKDROP[1] * ramp
    mixed = backdrop[fine_rows]
    (solid,) = np.nonzero(frame.faces[fine_rows, fine_columns] >= 0)
    fine_rows, fine_columns = fine_rows[solid], fine_columns[solid]

    nearness = np.float32(1.0) / frame.depth
    nearness = np.add.reduce([nearness[row::scale, column::scale] for row in range(scale) for column in range(scale)])
    middle = np.float32(scale * scale) / nearness[rows, columns]
    faces = np.concatenate([first[rows, columns], frame.faces[fine_rows, fine_columns]])
    at = np.append(columns + 0.5, (fine_columns + 0.5) / scale), np.append(rows + 0.5, (fine_rows + 0.5) / scale)
    points = camera.rays(*at) * np.append(middle, frame.depth[fine_rows, fine_columns])[:, None]
    facing = normals[faces]
    color = stage.paint(camera, faces, points, normals, framing.to_light)
    if marked.any():
        red = marked[stage.slot_of[faces]]
        color[red] = 0.42 * color[red] + 0.58 * _HIGHLIGHT * (color[red].mean(-1, keepdims=True) / 200.0)
    light = stage.look(to_pinhole(lamp))
    # Points are raised off their surface, so that no surface shadows itself.
    shadow = soft_shadow(points + np.float32(2.6 * texel) * facing, camera, light, 1.3 * texel)
    grid = np.where(first >= 0, frame.depth[::scale, ::scale], 0.0)[..., None]
    grid = grid * camera.rays(np.arange(width) + 0.5 / scale, (np.arange(height) + 0.5 / scale)[:, None])
    contact = contact_shade(grid, normals[first], camera, 0.04 * np.sqrt(framing.radius / _TABLE))
    of_row, of_column = np.append(rows, fine_rows // scale), np.append(columns, fine_columns // scale)
    contact = uniform_filter(contact, 3)[of_row, of_column]
    towards = np.clip(2.0 * facing @ (camera.view[:3, :3] @ framing.to_light).astype(np.float32), 0.0, 1.0)
    color *= 1.0 - _SHADOW * (shadow * (0.4 + 0.6 * towards))[:, None]
    color *= (1.0 - np.minimum(1.25 * contact, 0.5))[:, None]

    image = np.empty((height, width, 3), dtype=np.float32)
    image[:] = backdrop.reshape(height, scale, 3).mean(axis=1)[:, None]
    image[rows, columns] = color[: len(rows)]
    mixed[solid] = color[len(rows) :]
    image[mixed_rows, mixed_columns] = mixed.reshape(-1, scale * scale, 3).mean(axis=1)
    return np.rint(np.clip(image, 0.0, 255.0)).astype(np.uint8)


def gallery(
    images: NDArray[np.uint8] | Sequence[NDArray[np.uint8]],
    columns: int = 4,
    captions: Sequence[str] | None = None,
    *,
    gap: int = 8,
) -> Image.Image:
    """A PIL image of a white page with images, row by row, each with its caption below.

    Args:
        images: One or more (H, W, 3) uint8 images of one size.
        columns: Number of images per row; fewer images than columns make one shorter row.
        captions: One line per image.
        gap: Number of pixels between images and around the page.

    Raises:
        InvalidInputError: no images, sizes that differ, or another number of captions.

    >>> page = gallery(np.zeros((3, 24, 32, 3), np.uint8), columns=2, gap=4)
    >>> page.size
    (76, 60)
    """
    from PIL import Image, ImageDraw, ImageFont

    tiles = [np.asarray(image) for image in images]
    if not tiles:
        raise InvalidInputError("a gallery needs at least one image, got none")
    if columns < 1:
        raise InvalidInputError(f"columns must be at least 1, got {columns}")
    shapes = {tile.shape for tile in tiles}
    if len(shapes) > 1 or len(tiles[0].shape) != 3 or tiles[0].shape[2] != 3:
        raise InvalidInputError(f"a gallery needs (H, W, 3) images of one size, got shapes {sorted(shapes)}")
    if captions is not None and len(captions) != len(tiles):
        raise InvalidInputError(f"{len(tiles)} images need {len(tiles)} captions, got {len(captions)}")
    height, width = tiles[0].shape[:2]
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    size = max(11, round(0.045 * width))
    line = round(1.7 * size) if captions is not None else 0
    page = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + line + gap) + gap), _PAGE)
    draw = ImageDraw.Draw(page)
    font = ImageFont.load_default(size)
    for index, tile in enumerate(tiles):
        x = gap + (index % columns) * (width + gap)
        y = gap + (index // columns) * (height + line + gap)
        page.paste(Image.fromarray(tile.astype(np.uint8)), (x, y))
        if captions is not None:
            draw.text((x + width / 2, y + height + line / 2), captions[index], fill=_INK, font=font, anchor="mm")
    return page
