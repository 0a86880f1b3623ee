"""Renderer of scenes: lit pictures and semantic images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.render.stage import (
    Frame,
    Stage,
    contact_shade,
    frame_scene_type,
    get_stage,
    light_camera,
    picture_camera,
    scene_type_of_one,
    soft_shadow,
    surface_normals,
)
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, SceneType

if TYPE_CHECKING:
    from PIL import Image


Style = Literal["picture", "semantic"]

_BACKDROP = np.array([[250.0, 249.0, 247.0], [226.0, 230.0, 235.0]], dtype=np.float32)
_HIGHLIGHT = np.array([226.0, 52.0, 40.0], dtype=np.float32)
_SHADOW = np.array([0.40, 0.38, 0.34], dtype=np.float32)
"""Share of red, green and blue that a full shadow takes away."""
_SEMANTIC_BACKGROUND = 255
_SUPERSAMPLING = 2
_STYLES = ("picture", "semantic")
_TABLE = 0.68
"""Radius (m) of the framing of a dim sum table, for which contact shading is tuned."""
_PAGE, _INK = (255, 255, 255), (58, 62, 70)


def render(
    batch: SceneBatch,
    *,
    style: Style = "picture",
    camera: Camera | None = None,
    width: int | None = None,
    height: int | None = None,
    highlight: torch.Tensor | NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """Draw scenes in software; no display, GPU or simulator is needed.

    Args:
        batch: B scenes.
        style: ``"picture"`` is a lit three-quarter view with soft shadows. In types without fixed objects, a scene with
            just one support is framed by this support. ``"semantic"`` is one flat colour per asset on white, seen by
            the camera of the scene type (the paper's: 640 x 480, 45 degrees).
        camera: Camera in place of that of the style.
        width: Image width, pixels; the camera's by default. The view of a picture is fitted to the image.
        height: Image height, pixels; the camera's by default.
        highlight: (B, N) bool, objects to draw in red (pictures only).

    Returns:
        (B, H, W, 3) uint8, RGB.

    Raises:
        UnknownNameError: no such style.
        InvalidInputError: sizes below 1 pixel, or a highlight of another shape.
    """
    scene_type = batch.scene_type
    if style not in _STYLES:
        raise unknown_name("render style", style, _STYLES)
    size = {name: value for name, value in (("width", width), ("height", height)) if value is not None}
    default = camera or (scene_type.camera if style == "semantic" else picture_camera(scene_type, **size))
    width, height = default.width if width is None else width, default.height if height is None else height
    if width < 1 or height < 1:
        raise InvalidInputError(f"an image needs at least 1 x 1 pixels, got width={width}, height={height}")
    marked = _as_mask(highlight, batch)
    translations = batch.translations.detach().cpu().double().numpy()
    categories = batch.categories.detach().cpu().numpy()
    rotations = batch.rotations.detach().cpu().double().numpy()
    stage = get_stage(scene_type.assets, scene_type.asset_folders)
    images = np.empty((len(batch), height, width, 3), dtype=np.uint8)
    for index, rotation in enumerate(rotations):
        stage.place(translations[index], rotation, categories[index])
        if style == "semantic":
            images[index] = _semantic(stage.look(default, width, height), categories[index], scene_type)
        else:
            seen = scene_type_of_one(scene_type, translations[index], rotation, categories[index])
            view = camera or (default if seen is scene_type else picture_camera(seen, width, height))
            images[index] = _picture(stage, view, width, height, seen, marked[index])
    return images


def _as_mask(highlight: torch.Tensor | NDArray[np.bool_] | None, batch: SceneBatch) -> NDArray[np.bool_]:
    shape = tuple(batch.tensor.shape[:2])
    if highlight is None:
        return np.zeros(shape, dtype=bool)
    mask = highlight.detach().cpu().numpy() if isinstance(highlight, torch.Tensor) else np.asarray(highlight)
    if mask.shape != shape:
        raise InvalidInputError(f"highlight marks objects of the batch, so its shape is {shape}; got {mask.shape}")
    return mask.astype(bool)


def _semantic(frame: Frame, categories: NDArray[np.int64], scene_type: SceneType) -> NDArray[np.uint8]:
    colors = np.array([asset.color for asset in scene_type.library], dtype=np.uint8)
    flat = np.full((*frame.slots.shape, 3), _SEMANTIC_BACKGROUND, dtype=np.uint8)
    seen = frame.slots >= 0
    flat[seen] = colors[categories[frame.slots[seen]]]
    return flat


def _picture(
    stage: Stage, camera: Camera, width: int, height: int, scene_type: SceneType, marked: NDArray[np.bool_]
) -> NDArray[np.uint8]:
    from scipy.ndimage import uniform_filter

    scale = _SUPERSAMPLING
    framing = frame_scene_type(scene_type)
    frame = stage.look(camera, scale * width, scale * height)
    lamp = light_camera(scene_type)
    # Size (m) of a pixel of the lamp's image
    texel = 2.0 * np.linalg.norm(np.subtract(lamp.position, lamp.target)) / lamp.height
    texel *= np.tan(np.radians(lamp.fov_y) / 2.0)
    light = stage.look(lamp, lamp.width, lamp.height)
    color = stage.paint(frame, framing.to_light)
    if marked.any():
        red = (frame.slots >= 0) & marked[np.maximum(frame.slots, 0)]
        color = np.where(
            red[..., None], 0.42 * color + 0.58 * _HIGHLIGHT * (color.mean(-1, keepdims=True) / 200.0), color
        )
    normals = surface_normals(frame)
    shadow = soft_shadow(frame, light, normals, bias=1.3 * texel, lift=2.6 * texel)[..., None]
    reach = 0.04 * np.sqrt(framing.radius / _TABLE)
    shade = uniform_filter(contact_shade(frame, normals, radius=reach), 2 * scale + 1)[..., None]
    towards = np.clip(2.0 * normals @ (frame.camera.view[:3, :3] @ framing.to_light).astype(np.float32), 0.0, 1.0)[
        ..., None
    ]
    lit = color * (1.0 - _SHADOW * shadow * (0.4 + 0.6 * towards)) * (1.0 - np.minimum(1.25 * shade, 0.5))
    ramp = np.linspace(0.0, 1.0, scale * height, dtype=np.float32)[:, None, None]
    backdrop = _BACKDROP[0] * (1.0 - ramp) + _BACKDROP[1] * ramp
    image = np.where((frame.slots >= 0)[..., None], lit, backdrop)
    small = image.reshape(height, scale, width, scale, 3).mean(axis=(1, 3))
    return np.rint(np.clip(small, 0.0, 255.0)).astype(np.uint8)


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
