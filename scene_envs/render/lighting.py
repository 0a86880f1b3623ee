"""Soft shadows and contact shading from depth images: pure functions on frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scene_envs.render.stage import Frame

Image = NDArray[np.float32]


def camera_points(frame: Frame) -> Image:
    """(H, W, 3): the visible point of each pixel in the camera frame (x right, y up, z backward), m."""
    height, width = frame.depth.shape
    x = ((np.arange(width, dtype=np.float32) + 0.5) * (2.0 / width) - 1.0) / frame.focal[0]
    y = (1.0 - (np.arange(height, dtype=np.float32) + 0.5) * (2.0 / height)) / frame.focal[1]
    depth = np.where(np.isfinite(frame.depth), frame.depth, 0.0).astype(np.float32)
    return np.stack([x[None, :] * depth, y[:, None] * depth, -depth], axis=-1).astype(np.float32)


def surface_normals(frame: Frame, *, stride: int = 2) -> Image:
    """(H, W, 3): unit normals in the camera frame, facing the camera; those of every ``stride``-th pixel are repeated.

    Along each axis the difference to the nearer neighbour is taken, so that edges of objects stay sharp.
    """
    points = camera_points(frame)[::stride, ::stride]
    along = [_shorter(np.diff(points, axis=axis), axis) for axis in (1, 0)]
    normals = np.cross(along[1], along[0])
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    facing = np.where(np.einsum("hwk,hwk->hw", normals, points) > 0, np.float32(-1.0), np.float32(1.0))
    return _enlarge((normals * facing[..., None]).astype(np.float32), stride, frame.depth.shape)


def soft_shadow(
    frame: Frame,
    light: Frame,
    normals: Image,
    *,
    bias: float = 0.004,
    lift: float = 0.008,
    softness: float = 1.8,
    taps: int = 12,
) -> Image:
    """(H, W) in 0..1: the part of the light that nearer objects hide, by percentage-closer filtering.

    Args:
        frame: Frame of the camera.
        light: Frame of the same scene seen from the light.
        normals: (H, W, 3) normals from :func:`surface_normals`.
        bias: Smallest difference in distance from the light (m) between an occluder and the point.
        lift: Distance (m) by which points are raised off their surface, so that no surface shadows itself.
        softness: Radius of the filter, pixels of ``light``.
        taps: Number of samples of the filter.
    """
    seen = np.isfinite(frame.depth)
    to_light = (light.view @ np.linalg.inv(frame.view)).astype(np.float32)
    points = (camera_points(frame)[seen] + np.float32(lift) * normals[seen]) @ to_light[:3, :3].T + to_light[:3, 3]
    distance = np.maximum(-points[:, 2], np.float32(1e-3))  # objects may lie behind the lamp
    height, width = light.depth.shape
    column = (points[:, 0] / distance * np.float32(light.focal[0]) + 1.0) * (0.5 * width)
    row = (1.0 - points[:, 1] / distance * np.float32(light.focal[1])) * (0.5 * height)
    nearest = light.depth.ravel()
    hidden = np.zeros(len(points), dtype=np.float32)
    for dx, dy in _spiral(taps) * softness:
        index = _pixel(row + dy, height) * width + _pixel(column + dx, width)
        hidden += nearest[index] < distance - bias
    shadow = np.zeros(frame.depth.shape, dtype=np.float32)
    shadow[seen] = hidden / taps
    return shadow


def contact_shade(frame: Frame, normals: Image, *, radius: float = 0.04, taps: int = 12, stride: int = 2) -> Image:
    """(H, W) in 0..1: ambient occlusion of each point by its surroundings within ``radius`` m.

    Computed for every ``stride``-th pixel of each axis and repeated; callers blur the result.
    """
    grid = camera_points(frame)[::stride, ::stride]
    height, width = grid.shape[:2]
    rows, columns = np.nonzero(grid[..., 2] < 0)
    surroundings = grid.reshape(-1, 3)
    points, facing = grid[rows, columns], normals[::stride, ::stride][rows, columns]
    reach_x = (0.5 * width * frame.focal[0] * radius / -points[:, 2]).astype(np.float32)
    reach_y = (0.5 * height * frame.focal[1] * radius / -points[:, 2]).astype(np.float32)
    closed = np.zeros(len(points), dtype=np.float32)
    for dx, dy in _spiral(taps):
        index = _pixel(rows + 0.5 + dy * reach_y, height) * width + _pixel(columns + 0.5 + dx * reach_x, width)
        offset = surroundings[index] - points
        square = np.einsum("nk,nk->n", offset, offset) + np.float32(1e-8)
        rise = np.einsum("nk,nk->n", offset, facing) / np.sqrt(square)
        closed += np.maximum(rise - np.float32(0.12), 0.0) * (square < 4.0 * radius**2)
    shade = np.zeros((height, width), dtype=np.float32)
    shade[rows, columns] = closed / taps
    return _enlarge(shade, stride, frame.depth.shape)


def blur(image: Image, size: int) -> Image:
    """(H, W) averaged over windows of ``size`` pixels."""
    from scipy.ndimage import uniform_filter

    return np.asarray(uniform_filter(image, size), dtype=np.float32)


def _pixel(position: NDArray[np.float32], size: int) -> NDArray[np.int32]:
    """The pixel that holds ``position`` (in pixels from the border), clamped to the image."""
    return np.clip(position, 0, size - 1).astype(np.int32)


def _enlarge(image: Image, stride: int, shape: tuple[int, ...]) -> Image:
    return image.repeat(stride, axis=0).repeat(stride, axis=1)[: shape[0], : shape[1]]


def _shorter(steps: Image, axis: int) -> Image:
    """For each pixel the shorter of its backward and forward step: edges of objects are not crossed."""
    first, last = np.take(steps, [0], axis=axis), np.take(steps, [-1], axis=axis)
    backward, forward = np.concatenate([first, steps], axis=axis), np.concatenate([steps, last], axis=axis)
    nearer = np.abs(backward[..., 2:]) <= np.abs(forward[..., 2:])
    return np.where(nearer, backward, forward)


def _spiral(taps: int) -> NDArray[np.float32]:
    """(taps, 2): points spread evenly over the unit disc (sunflower)."""
    index = np.arange(taps) + 0.5
    radius, angle = np.sqrt(index / taps), index * np.pi * (3.0 - np.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1).astype(np.float32)
