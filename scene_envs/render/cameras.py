"""Cameras and lamps for pictures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scene_envs.errors import InvalidInputError
from scene_envs.render.framing import fit_camera, frame_scene_type
from scene_envs.scene_types import Camera, SceneType, get_scene_type

_FOV = 28.0
_MARGIN = 0.05
_LAMP_PIXELS = 512, 1024
"""Resolution of the lamp's depth image for framings of a radius up to 2 m, and for larger ones."""


def picture_camera(scene_type: str | SceneType, width: int = 480, height: int = 360) -> Camera:
    """The three-quarter view of pictures without a given camera.

    It is derived from the workspace and the fixed objects (see
    :func:`~scene_envs.render.framing.frame_scene_type`), so it also suits users' scene types.

    Args:
        scene_type: Scene type or its name.
        width: Image width, pixels; width and height determine the distance of the camera.
        height: Image height, pixels.

    >>> camera = picture_camera("dimsum_table", 640, 480)
    >>> camera.width, camera.fov_y
    (640, 28.0)
    """
    if width < 1 or height < 1:
        raise InvalidInputError(f"an image needs at least 1 x 1 pixels, got width={width}, height={height}")
    framing = frame_scene_type(get_scene_type(scene_type))
    position, target = fit_camera(framing.points, framing.to_camera, _FOV, width / height, _MARGIN)
    return Camera(_triple(position), _triple(target), (0.0, 0.0, 1.0), width, height, _FOV)


def light_camera(scene_type: SceneType) -> Camera:
    """The view from a far lamp that sees the whole workspace."""
    framing = frame_scene_type(scene_type)
    distance = 8.0 * framing.radius
    fov = 2.0 * np.degrees(np.arctan(1.1 * framing.radius / distance))
    pixels = _LAMP_PIXELS[framing.radius > 2.0]
    position = framing.center + distance * framing.to_light
    return Camera(_triple(position), _triple(framing.center), (0.0, 1.0, 0.0), pixels, pixels, float(fov))


def _triple(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))
