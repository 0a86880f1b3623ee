"""Framing of pictures: the view of a scene type, computed from its workspace and fixed objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from scene_envs.arrays import Array, Index
from scene_envs.scene_types import FixedObject, SceneType

_SIDES = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_TOP = np.array([0.0, 0.0, 1.0])
_RAYS = 24


@dataclass(frozen=True, eq=False)
class Framing:
    """Points to show, with the directions of camera and lamp."""

    points: Array  # (P, 3) points that the picture shows, world frame, m
    to_camera: Array  # (3,) unit vector from the scene towards the camera
    to_light: Array  # (3,) unit vector from the scene towards the lamp
    ground: float  # lowest z of all supports, m

    @property
    def center(self) -> Array:
        """(3,) middle of the bounding box of the points, m."""
        return 0.5 * (self.points.min(axis=0) + self.points.max(axis=0))

    @property
    def radius(self) -> float:
        """Largest distance (m) of a point from the centre."""
        return float(np.linalg.norm(self.points - self.center, axis=1).max())


@lru_cache(maxsize=64)
def frame_scene_type(scene_type: SceneType) -> Framing:
    """Framing of scenes of this type.

    A support that rises through the workspace (a shelf) is seen whole, from its open side and slightly above. A support
    that is open above (a bin) is seen steeply from above. If objects stand on a support (a table, a floor) or on
    nothing, the view is a three-quarter view from above, across the longer side; it is steeper for flatter workspaces.
    """
    low, high = (np.array(corner) for corner in scene_type.workspace)
    extent = high - low
    boxes, vertices = _fixed_geometry(scene_type)
    ground = float(min(low[2], vertices[:, 2].min(initial=np.inf)))
    if vertices[:, 2].max(initial=-np.inf) > low[2] + 0.25 * extent[2]:
        side = _open_side(boxes)
        top = vertices[:, 2].max()
        above = _footprint(low, high, 1.0, max(top, high[2]))
        points = np.concatenate([vertices, above])
        if side is None:
            return Framing(points, _direction(_across(extent), 52.0), _direction(_across(extent) - 85.0, 62.0), ground)
        facing = float(np.degrees(np.arctan2(side[1], side[0])))
        return Framing(points, _direction(facing - 30.0, 15.0), _direction(facing + 12.0, 30.0), ground)
    flatness = float(np.clip(2.0 - extent[2] / (0.18 * extent[:2].max()), 0.0, 1.0))  # 0: a table, 1: a room
    azimuth, elevation = _across(extent) * (1.0 - flatness) - 24.0 * flatness, 37.0 + 10.0 * flatness
    upper = vertices[vertices[:, 2] >= low[2] - 0.05 * extent[:2].max()]
    height = min(0.6 * extent[:2].min(), 0.75 * extent[2])
    filled = _footprint(low, high, 0.7, low[2] + height)
    base = upper if len(upper) else _footprint(low, high, 1.0, low[2])
    points = np.concatenate([base, filled])
    return Framing(points, _direction(azimuth, elevation), _direction(azimuth - 85.0, 57.0), ground)


def scene_type_of_one(scene_type: SceneType, translations: Array, rotations: Array, categories: Index) -> SceneType:
    """Scene type for the framing of one scene, in which its only support counts as fixed.

    A union of scene types has no fixed objects and the workspace of the largest type, in which a table would be tiny. A
    scene with one welded object is framed as if this object were fixed there; any other scene is framed as
    ``scene_type``.

    Args:
        scene_type: Scene type of the scene.
        translations: (N, 3) translations, m.
        rotations: (N, 3, 3) rotations.
        categories: (N,) int64; the number of assets is the category of empty slots.
    """
    names = np.array([*scene_type.assets, ""])[categories]
    supports = np.flatnonzero(np.isin(names, scene_type.welded))
    if scene_type.fixed or len(supports) != 1:
        return scene_type

    def fixed(slots: Index) -> SceneType:
        poses = ((translations[slot].tolist(), rotations[slot].ravel().tolist()) for slot in slots)
        objects = (FixedObject(str(names[slot]), *map(tuple, pose)) for slot, pose in zip(slots, poses, strict=True))
        return replace(scene_type, fixed=tuple(objects))

    support = fixed(supports)
    vertices = _fixed_geometry(support)[1]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    lost = np.abs(translations - 0.5 * (low + high)).max(axis=1) > (high - low).max()
    objects = np.flatnonzero((names != "") & (np.arange(len(names)) != supports[0]) & ~lost)
    low[2] = translations[objects, 2].min(initial=high[2])
    tops = _fixed_geometry(fixed(objects))[1][:, 2]
    high[2] = max(high[2], tops.max(initial=-np.inf), low[2] + 0.1 * (high - low)[:2].max())
    return replace(support, workspace=(tuple(low.tolist()), tuple(high.tolist())))


def fit_camera(points: Array, to_camera: Array, fov_y: float, aspect: float, margin: float) -> tuple[Array, Array]:
    """Position and target (m) of the nearest camera without roll that sees all points.

    Args:
        points: (P, 3) points, m.
        to_camera: (3,) unit vector from the scene to the camera; not vertical.
        fov_y: Vertical field of view, degrees.
        aspect: Ratio of width to height.
        margin: Share of the half image that stays free at each border.
    """
    right = np.cross(_TOP, to_camera)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(to_camera, right), to_camera])
    seen = points @ axes.T  # (P, 3): right, up, towards the camera
    slope = np.tan(np.radians(fov_y) / 2.0) * (1.0 - margin) * np.array([aspect, 1.0])
    # A camera at (x, y, d) sees a point when |x_p - x| <= slope_x (d - d_p), and the same for y.
    upper = (seen[:, :2] + slope * seen[:, 2:]).max(axis=0)
    lower = (-seen[:, :2] + slope * seen[:, 2:]).max(axis=0)
    distance = float(((upper + lower) / (2.0 * slope)).max())
    place = np.array([*(0.5 * (upper - lower)), distance])
    target = np.array([place[0], place[1], 0.5 * (seen[:, 2].min() + seen[:, 2].max())])
    return place @ axes, target @ axes


def _fixed_geometry(scene_type: SceneType) -> tuple[Array, Array]:
    """World boxes (P, 2, 3) around the parts of fixed objects, and all corners (V, 3) of those parts, m."""
    boxes, vertices = [np.empty((0, 2, 3))], [np.empty((0, 3))]
    for fixed in scene_type.fixed:
        rotation = np.reshape(fixed.rotation, (3, 3))
        for part in scene_type.library[fixed.asset].fine:
            corners = part.vertices @ rotation.T + np.array(fixed.translation)
            vertices.append(corners)
            boxes.append(np.stack([corners.min(axis=0), corners.max(axis=0)])[None])
    return np.concatenate(boxes), np.concatenate(vertices)


def _open_side(boxes: Array) -> Array | None:
    """The horizontal direction with the clearest view; None if the view from straight above is as clear."""
    covered = [_covered(boxes, side) for side in _SIDES]
    return None if _covered(boxes, _TOP) <= min(covered) else _SIDES[int(np.argmin(covered))]


def _covered(boxes: Array, side: Array) -> float:
    """Part of the view from ``side`` that boxes block before two thirds of the depth."""
    axis = int(np.argmax(np.abs(side)))
    across: Sequence[int] = [a for a in range(3) if a != axis]
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    depth = np.sort(boxes[:, :, axis] * side[axis], axis=1)
    reach = max(low[axis] * side[axis], high[axis] * side[axis]) - (2.0 / 3.0) * (high[axis] - low[axis])
    steps = (np.arange(_RAYS) + 0.5) / _RAYS
    u, v = (low[a] + steps * (high[a] - low[a]) for a in across)
    in_u, in_v = (
        (boxes[:, 0, a, None] <= w) & (w <= boxes[:, 1, a, None]) & (depth[:, 1:] > reach)
        for a, w in zip(across, (u, v), strict=True)
    )
    return float((in_u[:, :, None] & in_v[:, None, :]).any(axis=0).mean())


def _footprint(low: Array, high: Array, share: float, z: float) -> Array:
    """(4, 3): corners of the middle ``share`` of the workspace's footprint at height ``z``, m."""
    center, half = 0.5 * (low + high), 0.5 * share * (high - low)
    return np.array([[center[0] + i * half[0], center[1] + j * half[1], z] for i in (-1, 1) for j in (-1, 1)])


def _across(extent: Array) -> float:
    """Azimuth (degrees) of a camera that has the longer side of the workspace across its picture."""
    return -28.0 if extent[1] > 1.25 * extent[0] else -62.0


def _direction(azimuth: float, elevation: float) -> Array:
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
