"""Lit pictures of scenes, what sensors see of them, and pages of several pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from scene_envs.arrays import Array, Index
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.render.raster import Pinhole
from scene_envs.render.stage import (
    Frame,
    Stage,
    contact_shade,
    frame_scene_type,
    get_stage,
    picture_camera,
    scene_type_of_one,
    soft_shadow,
    to_pinhole,
)
from scene_envs.scene_types import Camera, SceneType

if TYPE_CHECKING:
    import torch
    from PIL import Image

    from scene_envs.scene import SceneBatch


Mode = Literal["rgb", "depth", "instance", "boxes", "category", "semantic", "normals"]
MODES: tuple[Mode, ...] = get_args(Mode)
_BACKDROP = np.array([[250.0, 249.0, 247.0], [226.0, 230.0, 235.0]], dtype=np.float32)
_HIGHLIGHT = np.array([226.0, 52.0, 40.0], dtype=np.float32)
_SHADOW = np.array([0.40, 0.38, 0.34], dtype=np.float32)
"""Share of red, green and blue that a full shadow takes away."""
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

    :func:`~scene_envs.render.pictures.observe` gives depth, masks and other images of the same scenes.

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


def observe(
    batch: SceneBatch,
    cameras: Sequence[Camera | Pinhole] | None = None,
    modes: Sequence[Mode] = ("rgb", "depth", "instance", "category", "normals"),
) -> list[dict[Mode, NDArray[Any]]]:
    """What cameras see of scenes, drawn in software; no display, GPU or simulator is needed.

    A pixel shows what the ray through its middle meets first; only ``rgb`` is smoothed.

    | mode | image |
    |---|---|
    | ``rgb`` | (B, H, W, 3) uint8, the lit picture of :func:`~scene_envs.render.pictures.render` |
    | ``depth`` | (B, H, W) float32, distance along the optical axis, m; inf where nothing is seen |
    | ``instance`` | (B, H, W) int32, slot of the object; -1 where nothing is seen |
    | ``boxes`` | (B, N, 4) int32, left, top, right, bottom of the visible part of each slot, pixels, the last two \\
exclusive; 0 for slots that are not seen |
    | ``category`` | (B, H, W) int32, category of the object; that of empty slots where nothing is seen |
    | ``semantic`` | (B, H, W, 3) uint8, one flat color per asset on white, as the paper renders scenes |
    | ``normals`` | (B, H, W, 3) float32, unit normals of triangles, world frame, on the side that is seen; 0 where \\
nothing is seen |

    Args:
        batch: B scenes.
        cameras: Cameras by place and target, or by intrinsics and pose; the one of the scene type by default, which
            is the paper's.
        modes: Images to make.

    Returns:
        The images by mode, for each camera.

    Raises:
        UnknownNameError: no such mode.
        InvalidInputError: a camera without a direction, or one that is inside an object.

    >>> from scene_envs import SceneBatch, get_scene_type
    >>> empty_table = SceneBatch.empty(get_scene_type("dimsum_table"), 1)
    >>> camera = Camera((0.0, 0.0, 2.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), width=5, height=3)
    >>> (view,) = observe(empty_table, [camera], ["depth", "boxes"])
    >>> view["depth"][0, 1].round(3).tolist(), view["boxes"][0, 0].tolist()
    ([inf, 2.0, 2.0, 2.0, inf], [1, 0, 4, 3])
    """
    views = list(observe_each(batch if len(batch) else batch.empty(batch.scene_type, 1), cameras, modes))
    return [
        {mode: np.stack([view[index][mode] for view in views])[: len(batch)] for mode in modes}
        for index in range(len(views[0]))
    ]


def observe_each(
    batch: SceneBatch, cameras: Sequence[Camera | Pinhole] | None, modes: Sequence[Mode]
) -> Iterator[list[dict[Mode, NDArray[Any]]]]:
    """The images of :func:`observe`, without their first axis, scene by scene."""
    for mode in set(modes) - set(MODES):
        raise unknown_name("image mode", mode, MODES)
    scene_type = batch.scene_type
    pinholes = [to_pinhole(camera) for camera in ([scene_type.camera] if cameras is None else cameras)]
    places = [camera.pose[:3, 3].round(4).tolist() for camera in pinholes]
    unseen = set(range(len(pinholes)))
    for scene, (stage, (_, _, categories)) in enumerate(stages(batch)):
        for index, camera in enumerate(pinholes):
            if (slot := stage.enclosing_slot(camera.pose[:3, 3])) >= 0:
                raise InvalidInputError(
                    f"camera {index} at {places[index]} is inside the {scene_type.assets[categories[slot]]!r} in slot "
                    f"{slot} of scene {scene}: give it another place, or leave the scene out"
                )
        frames = [stage.look(camera) for camera in pinholes]
        unseen -= {index for index, frame in enumerate(frames) if (frame.slots >= 0).any()}
        yield [{mode: _image(mode, stage, frame, categories, scene_type) for mode in modes} for frame in frames]
    for index in sorted(unseen) if bool((batch.counts > 0).any()) else ():
        logger.warn(
            f"camera {index} at {places[index]} sees no object of {len(batch)} scenes: it looks away from them, or "
            "they are beside its image"
        )


def stages(batch: SceneBatch) -> Iterator[tuple[Stage, tuple[Array, Array, Index]]]:
    """The stage with each scene on it, and the translations (N, 3) m, rotations (N, 3, 3) and categories (N,) of it."""
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
    mask = np.asarray(highlight.detach().cpu() if hasattr(highlight, "detach") else highlight)
    if mask.shape != shape:
        raise InvalidInputError(f"highlight marks objects of the batch, so its shape is {shape}; got {mask.shape}")
    return mask.astype(bool)


def _image(mode: Mode, stage: Stage, frame: Frame, categories: Index, scene_type: SceneType) -> NDArray[Any]:
    """One image of what ``frame`` holds of the scene on the stage, whose slots have ``categories`` (N,)."""
    if mode == "rgb":
        return draw_picture(stage, frame.camera, scene_type, np.zeros(len(categories), dtype=bool))
    if mode in ("depth", "instance"):
        return frame.depth if mode == "depth" else frame.slots.astype(np.int32)
    if mode == "boxes":
        from scipy.ndimage import find_objects

        areas = find_objects(frame.slots + 1, len(categories))
        boxes = [(a[1].start, a[0].start, a[1].stop, a[0].stop) if a else (0, 0, 0, 0) for a in areas]
        return np.array(boxes, dtype=np.int32)
    if mode == "normals":
        return (stage.normals(frame.camera) @ frame.camera.view[:3, :3].astype(np.float32))[frame.faces]
    category = np.append(categories, scene_type.num_assets).astype(np.int32)[frame.slots]
    colors = [*(asset.color for asset in scene_type.library), (255, 255, 255)]
    return category if mode == "category" else np.array(colors, dtype=np.uint8)[category]


def draw_picture(stage: Stage, camera: Pinhole, scene_type: SceneType, marked: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """(H, W, 3) uint8: what ``camera`` sees of the objects on the stage, lit as scenes of the type are, with the slots
    ``marked`` (N,) in red. A pixel is the mean of 2 x 2 samples, which are shaded once where they show one triangle.
    """
    from scipy.ndimage import uniform_filter

    height, width = camera.height, camera.width
    framing = frame_scene_type(scene_type)
    frame, light = stage.look(camera.resized(2 * width, 2 * height)), stage.lamp(scene_type)
    # Size (m) of a pixel of the lamp's image
    texel = float(np.linalg.norm(light.camera.pose[:3, 3] - framing.center) / light.camera.fx)
    normals = stage.normals(camera)

    first = frame.faces[::2, ::2]
    plain = np.logical_and.reduce([first == frame.faces[row::2, column::2] for row, column in ((0, 1), (1, 0), (1, 1))])
    rows, columns = np.nonzero(plain & (first >= 0))
    mixed_rows, mixed_columns = np.nonzero(~plain)
    fine_rows = (2 * mixed_rows[:, None] + [0, 0, 1, 1]).ravel()
    fine_columns = (2 * mixed_columns[:, None] + [0, 1, 0, 1]).ravel()
    ramp = np.linspace(0.0, 1.0, 2 * height, dtype=np.float32)[:, None]
    backdrop = _BACKDROP[0] * (1.0 - ramp) + _BACKDROP[1] * ramp
    mixed = backdrop[fine_rows]
    (solid,) = np.nonzero(frame.faces[fine_rows, fine_columns] >= 0)
    fine_rows, fine_columns = fine_rows[solid], fine_columns[solid]

    depth = 0.5 * (frame.depth[::2, ::2] + frame.depth[1::2, 1::2])[rows, columns]
    faces = np.append(first[rows, columns], frame.faces[fine_rows, fine_columns])
    at = np.append(columns + 0.5, 0.5 * fine_columns + 0.25), np.append(rows + 0.5, 0.5 * fine_rows + 0.25)
    points = camera.rays(*at) * np.append(depth, frame.depth[fine_rows, fine_columns])[:, None]
    facing = normals[faces]
    color = stage.paint(camera, faces, points, normals, framing.to_light)
    if marked.any():
        red = marked[stage.slot_of[faces]]
        color[red] = 0.42 * color[red] + 0.58 * _HIGHLIGHT * (color[red].mean(-1, keepdims=True) / 200.0)
    # Points are raised off their surface, so that no surface shadows itself.
    shadow = soft_shadow(points + np.float32(2.6 * texel) * facing, camera, light, 1.3 * texel)
    grid = camera.rays(np.arange(width) + 0.25, (np.arange(height) + 0.25)[:, None])
    grid *= np.where(first >= 0, frame.depth[::2, ::2], 0.0)[..., None]
    contact = contact_shade(grid, normals[first], camera, 0.04 * np.sqrt(framing.radius / _TABLE))
    contact = uniform_filter(contact, 3)[np.append(rows, fine_rows // 2), np.append(columns, fine_columns // 2)]
    towards = np.clip(2.0 * facing @ (camera.view[:3, :3] @ framing.to_light).astype(np.float32), 0.0, 1.0)
    color *= 1.0 - _SHADOW * (shadow * (0.4 + 0.6 * towards))[:, None]
    color *= (1.0 - np.minimum(1.25 * contact, 0.5))[:, None]

    image = np.empty((height, width, 3), dtype=np.float32)
    image[:] = backdrop.reshape(height, 2, 3).mean(axis=1)[:, None]
    image[rows, columns] = color[: len(rows)]
    mixed[solid] = color[len(rows) :]
    image[mixed_rows, mixed_columns] = mixed.reshape(-1, 4, 3).mean(axis=1)
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
