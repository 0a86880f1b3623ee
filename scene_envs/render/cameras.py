"""Cameras for pictures, and the light that goes with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scene_envs.scene_types import Camera, SceneType

_FOV = 28.0
_ELEVATION, _AZIMUTH = np.radians(37.0), np.radians(-62.0)
LIGHT_DIRECTION = (-0.55, -0.35, 1.0)
"""From the scene to the light, world frame: over the left shoulder of the picture camera."""


def picture_camera(scene_type: SceneType, width: int = 480, height: int = 360) -> Camera:
    """The three-quarter view of the workspace that pictures use when no camera is given."""
    center, radius = _focus(scene_type)
    direction = np.array(
        [np.cos(_ELEVATION) * np.cos(_AZIMUTH), np.cos(_ELEVATION) * np.sin(_AZIMUTH), np.sin(_ELEVATION)]
    )
    position = center + direction * radius / np.tan(np.radians(_FOV) / 2.0)
    return Camera(_triple(position), _triple(center), (0.0, 0.0, 1.0), width, height, _FOV)


def light_camera(scene_type: SceneType) -> Camera:
    """The view from a far lamp along :data:`LIGHT_DIRECTION` that sees the whole workspace."""
    center, radius = _focus(scene_type)
    direction = np.array(LIGHT_DIRECTION) / np.linalg.norm(LIGHT_DIRECTION)
    distance = 8.0 * radius
    fov = 2.0 * np.degrees(np.arctan(1.25 * radius / distance))
    return Camera(_triple(center + distance * direction), _triple(center), (0.0, 1.0, 0.0), 512, 512, float(fov))


def _focus(scene_type: SceneType) -> tuple[NDArray[np.float64], float]:
    """Centre and radius (m) of what matters: the floor of the workspace and its lower third."""
    low, high = (np.array(corner) for corner in scene_type.workspace)
    extent = high - low
    center = 0.5 * (low + high)
    center[2] = low[2] + 0.15 * extent[2]
    return center, float(0.47 * np.hypot(extent[0], extent[1]))


def _triple(vector: NDArray[np.float64]) -> tuple[float, float, float]:
    return (float(vector[0]), float(vector[1]), float(vector[2]))
