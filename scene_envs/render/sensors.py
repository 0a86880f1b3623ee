"""Images of sensors: color, metric depth, instance and category masks, boxes and normals, for cameras of any place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from gymnasium import logger
from numpy.typing import NDArray

from scene_envs.arrays import Index
from scene_envs.errors import InvalidInputError, unknown_name
from scene_envs.render.pictures import draw_picture, stages
from scene_envs.render.raster import Pinhole
from scene_envs.render.stage import Frame, Stage, to_pinhole
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, SceneType

Mode = Literal["rgb", "depth", "instance", "boxes", "category", "semantic", "normals"]
MODES: tuple[Mode, ...] = get_args(Mode)
_BACKGROUND = (255, 255, 255)


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
    for mode in modes:
        if mode not in MODES:
            raise unknown_name("image mode", mode, MODES)
    scene_type, slots = batch.scene_type, batch.tensor.shape[1]
    pinholes = [to_pinhole(camera) for camera in ([scene_type.camera] if cameras is None else cameras)]
    images = [{mode: _no_images(mode, camera, len(batch), slots) for mode in modes} for camera in pinholes]
    unseen = set(range(len(pinholes)))
    for scene, (stage, (_, _, categories)) in enumerate(stages(batch)):
        for index, camera in enumerate(pinholes):
            slot = stage.enclosing_slot(camera.pose[:3, 3])
            if slot >= 0:
                raise InvalidInputError(
                    f"camera {index} at {_place(camera)} is inside the {scene_type.assets[categories[slot]]!r} in slot "
                    f"{slot} of scene {scene}: give it another place, or leave the scene out"
                )
            frame = stage.look(camera)
            if (frame.slots >= 0).any():
                unseen.discard(index)
            for mode in modes:
                images[index][mode][scene] = _image(mode, stage, frame, categories, scene_type)
    for index in sorted(unseen) if bool((batch.counts > 0).any()) else ():
        logger.warn(
            f"camera {index} at {_place(pinholes[index])} sees no object of {len(batch)} scenes: it looks away from "
            "them, or they are beside its image"
        )
    return images


def boxes_of(instance: NDArray[np.int32], slots: int) -> NDArray[np.int32]:
    """(N, 4): left, top, right and bottom (pixels, the last two exclusive) of each slot in an instance image (H, W); 0
    for slots that are not in it.

    >>> boxes_of(np.array([[-1, 1, 1], [-1, 1, -1]], dtype=np.int32), 2).tolist()
    [[0, 0, 0, 0], [1, 0, 3, 2]]
    """
    boxes = np.zeros((slots, 4), dtype=np.int32)
    rows, columns = np.nonzero(instance >= 0)
    slot = instance[rows, columns]
    seen = np.unique(slot)
    low, high = np.full((slots, 2), 2**31 - 1, dtype=np.int32), np.zeros((slots, 2), dtype=np.int32)
    for axis, places in enumerate((columns, rows)):
        np.minimum.at(low[:, axis], slot, places.astype(np.int32))
        np.maximum.at(high[:, axis], slot, places.astype(np.int32) + 1)
    boxes[seen] = np.concatenate([low, high], axis=1)[seen]
    return boxes


def _no_images(mode: Mode, camera: Pinhole, count: int, slots: int) -> NDArray[Any]:
    """Room for ``count`` images."""
    if mode == "boxes":
        return np.empty((count, slots, 4), dtype=np.int32)
    channels = (3,) if mode in ("rgb", "semantic", "normals") else ()
    kind = np.float32 if mode in ("depth", "normals") else np.int32 if mode in ("instance", "category") else np.uint8
    return np.empty((count, camera.height, camera.width, *channels), dtype=kind)


def _image(mode: Mode, stage: Stage, frame: Frame, categories: Index, scene_type: SceneType) -> NDArray[Any]:
    """One image of what ``frame`` holds of the scene on the stage, whose slots have ``categories`` (N,)."""
    if mode == "rgb":
        return draw_picture(stage, frame.camera, scene_type, np.zeros(len(categories), dtype=bool))
    if mode == "depth":
        return frame.depth
    if mode == "instance":
        return frame.slots
    if mode == "boxes":
        return boxes_of(frame.slots.astype(np.int32), len(categories))
    if mode == "normals":
        return (stage.normals(frame.camera) @ frame.camera.view[:3, :3].astype(np.float32))[frame.faces]
    category = np.append(categories, scene_type.num_assets)[frame.slots]
    if mode == "category":
        return category
    colors = [*(asset.color for asset in scene_type.library), _BACKGROUND]
    return np.array(colors, dtype=np.uint8)[category]


def _place(camera: Pinhole) -> list[float]:
    place: list[float] = camera.pose[:3, 3].round(4).tolist()
    return place
