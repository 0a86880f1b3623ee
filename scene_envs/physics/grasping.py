"""Collision-free approaches of a parallel gripper to the objects of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, product
from typing import Any

import numpy as np
import torch
from fcl import Transform
from torch import Tensor

from scene_envs.arrays import Array, Index, Mask
from scene_envs.assets.base import AssetLibrary, ConvexPart
from scene_envs.assets.fcl import Boxed, convex, shapes_of
from scene_envs.assets.shapes import box
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch, require_rigid_poses

TOUCHING = 1e-4
"""The gripper's boxes are smaller by this (m) on each side, so that it may touch objects."""
TURNS = tuple(np.arange(4) * np.pi / 4)
"""Angles (rad) of the closing direction about the approach, counted from an axis of the object."""
_LOOSE = 1e-5
"""Boxes of the gripper's parts are larger by this (m) on each side, more than what FCL takes for contact."""
_PARTS = 1 << 9
"""Boxes of parts that are compared with those of four turned grippers at a time."""
PLACES = (0.5, 0.0, 1.0)
"""Grasp positions as fractions of the object's extent in the closing direction: its middle, then its two edges."""


@dataclass(frozen=True)
class Gripper:
    """A parallel gripper of boxes; the defaults are about those of a Franka hand. All lengths in m.

    Raises InvalidInputError for a length that is not positive, a palm narrower than the open fingers, or a reach longer
    than the fingers.
    """

    opening: float = 0.08  # distance between the open fingers
    finger_length: float = 0.045  # along the approach
    finger_width: float = 0.02  # across the approach and the closing direction
    finger_thickness: float = 0.008  # along the closing direction
    palm: tuple[float, float] = (0.2, 0.06)  # body above the fingers, along the closing direction and across it
    path: float = 0.15  # free space that the palm needs behind it along the approach
    reaches: tuple[float, ...] = (0.03, 0.01)  # of the tips below the near side, not past the far side, in turn

    def __post_init__(self) -> None:
        lengths = (self.opening, self.finger_length, self.finger_width, self.finger_thickness, *self.palm, self.path)
        if min(lengths) <= 0 or not self.reaches or min(self.reaches) <= 0:
            raise InvalidInputError(f"{self}: all lengths must be positive")
        if self.palm[0] < self.opening + 2 * self.finger_thickness or self.palm[1] < self.finger_width:
            raise InvalidInputError(f"{self}: the palm must reach over the open fingers")
        if max(self.reaches) > self.finger_length:
            raise InvalidInputError(f"{self}: reaches {self.reaches} must not be longer than the fingers")

    def body(self) -> tuple[ConvexPart, ...]:
        """The two fingers, and the palm with its path; x is the closing direction, z points back from the tips. Boxes
        are smaller by :data:`TOUCHING` on each side.
        """
        aside = 0.5 * (self.opening + self.finger_thickness)
        finger = (self.finger_thickness, self.finger_width, self.finger_length)
        palm = (*self.palm, self.path)
        return _inner(palm, (0, 0, self.finger_length)), _inner(finger, (-aside, 0, 0)), _inner(finger, (aside, 0, 0))

    def grasp(self) -> ConvexPart:
        """The space between the fingers, smaller by :data:`TOUCHING` on each side."""
        return _inner((self.opening, self.finger_width, self.finger_length), (0, 0, 0))


def reachable(batch: SceneBatch, approaches: Sequence[Sequence[float]], gripper: Gripper | None = None) -> Tensor:
    """(A, B, N) bool: objects of B scenes that an open gripper reaches in a straight line without touching anything;
    False for welded and empty slots.

    For each of A ``approaches``, directions in the world from the object to the waiting gripper, such as (0, 0, 1), it
    is tried at the middle and both edges of the object, with four closing directions and all reaches. It reaches the
    object when a fine convex part of it is between the fingers, and none of any object is in the fingers, the palm or
    the palm's path, whose boxes are smaller by 0.1 mm on each side (:mod:`scene_envs.assets.fcl`).

    Raises InvalidInputError for a matrix that is not a rotation; the message names its scene and slot.
    """
    require_rigid_poses(batch)
    gripper = Gripper() if gripper is None else gripper
    found = torch.zeros(len(approaches), *batch.tensor.shape[:2], dtype=torch.bool)
    translations = batch.translations.double().cpu().numpy()
    rotations = batch.rotations.double().cpu().numpy()
    categories, free = batch.categories.cpu().numpy(), batch.is_free.cpu().numpy()
    back = np.asarray(approaches, dtype=np.float64)
    hand = _hand(batch.scene_type.library, gripper)
    for row, slots in enumerate(map(np.flatnonzero, categories < batch.scene_type.num_assets)):
        poses = rotations[row, slots], translations[row, slots]
        with hand.shapes.lock:
            met = hand.reach(categories[row, slots], *poses, np.flatnonzero(free[row, slots]), back)
        found[:, row, slots] = torch.from_numpy(met)
    return found.to(batch.tensor.device)


class _Hand:
    """A gripper among the assets of a library, for one scene at a time."""

    def __init__(self, library: AssetLibrary, gripper: Gripper) -> None:
        self.gripper = gripper
        self.shapes = shapes_of(library.assets)
        self.corners = [np.concatenate([part.vertices for part in asset.fine]) for asset in library]
        self.starts = [np.cumsum([0, *(len(part.vertices) for part in asset.fine[:-1])]) for asset in library]
        parts = gripper.grasp(), *gripper.body()
        self.parts = [convex(part) for part in parts]  # the space between the fingers, and the three of the body
        sides = np.array([(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in parts])
        self.middle, self.half = sides.mean(axis=1), 0.5 * (sides[:, 1] - sides[:, 0])  # (4, 3) m

    def reach(self, category: Index, rotation: Array, translation: Array, free: Index, back: Array) -> Mask:
        """(A, n) whether the gripper reaches the n objects of one scene from the directions ``back`` (A, 3); it is
        tried at those of the rows ``free``. The caller holds the lock of the shapes.
        """
        placed = self.shapes.place(category.tolist(), rotation, translation)
        corners = [self.corners[c] @ rotation[row].T + translation[row] for row, c in enumerate(category)]
        low, high = (
            [side.reduceat(points, self.starts[c]) for points, c in zip(corners, category, strict=True)]
            for side in (np.minimum, np.maximum)
        )
        none = np.empty((0, 3))
        scene = Boxed(list(chain(*placed)), np.concatenate([none, *low]), np.concatenate([none, *high]))
        ends = np.cumsum([0, *map(len, placed)])
        reached = np.zeros((len(back), len(category)), dtype=bool)
        for side, direction in enumerate(back / np.linalg.norm(back, axis=1, keepdims=True)):
            frames = _frames(rotation[free], direction)
            tips = self._tips([corners[row] for row in free], frames)
            trials = zip(frames, tips, ends[free], ends[free + 1], strict=True)
            reached[side, free] = [self._reaches(*trial, scene) for trial in trials]
        return reached

    def _tips(self, corners: list[Array], frames: Array) -> Array:
        """(n, P, T, 3) m: places of the tips at n objects, from the corners (V, 3) m of each in the world and the
        frames (n, T, 3, 3) of the gripper.
        """
        pairs = zip(corners, frames, strict=True)
        along = [np.ascontiguousarray((points @ turned).swapaxes(1, 2)) for points, turned in pairs]  # (T, 3, V) each
        bounds = np.array([(points.min(axis=2), points.max(axis=2)) for points in along]).reshape(-1, 2, len(TURNS), 3)
        low, high = bounds[:, 0, None], bounds[:, 1, None]  # (n, 1, T, 3)
        part, reach = np.array(list(product(PLACES, self.gripper.reaches))).T[..., None]  # (P, 1) each
        across = low[..., 0] + part * (high[..., 0] - low[..., 0])  # (n, P, T)
        deep = np.maximum(high[..., 2] - reach, low[..., 2])
        middle = np.broadcast_to(0.5 * (low[..., 1] + high[..., 1]), deep.shape)
        return np.einsum("ntij,nptj->npti", frames, np.stack([across, middle, deep], axis=-1))

    def _reaches(self, frames: Array, tips: Array, start: int, end: int, scene: Boxed) -> bool:
        """Whether at one of the places ``tips`` (P, T, 3) m, turned as ``frames`` (T, 3, 3), a part of the object, from
        ``start`` to ``end``, is between the fingers, and the gripper meets nothing of the scene.
        """
        middle = tips[:, :, None] + self.middle @ frames.swapaxes(1, 2)  # (P, T, 4, 3)
        half = self.half @ np.abs(frames).swapaxes(1, 2) + _LOOSE
        boxes = np.concatenate([middle + half, half - middle], axis=-1)
        struck, (grasp, *body) = [scene.last], self.parts  # in a heap, what was met last is met again
        likely = scene.meet(boxes[:, :, 1:], struck)[..., 0].tolist()
        some: Any = None  # whether any part of the scene is near each part of the gripper
        begin, near, rows = 0, np.empty((0, 0, 0, 0), dtype=bool), None
        for p, t in np.ndindex(*tips.shape[:2]):
            pose = Transform(frames[t], tips[p, t])
            for part in self.parts:
                part.setTransform(pose)
            if any(scene.meets(part, struck) for part, is_near in zip(body, likely[p][t], strict=True) if is_near):
                continue
            if rows is None:
                rows = np.flatnonzero(scene.meet(boxes.max(axis=(0, 1, 2))))
            if p >= begin + len(near):
                begin, near = p, scene.meet(boxes[p : p + max(1, _PARTS // max(1, len(rows)))], rows)
                near[:, :, 0, (rows < start) | (rows >= end)] = False
                some = near.any(axis=-1).tolist()
            between, *others = near[p - begin, t]
            is_between, *are_near = some[p - begin][t]
            trial = zip(body, others, are_near, strict=True)
            if not is_between or any(scene.meets(part, rows[few].tolist()) for part, few, is_near in trial if is_near):
                continue
            last = scene.last
            if scene.meets(grasp, rows[between].tolist()):
                scene.last = last  # not a part of this object
                return True
        return False


_hand = lru_cache(maxsize=16)(_Hand)


def _frames(rotation: Array, back: Array) -> Array:
    """(n, T, 3, 3) gripper to world: z along ``back`` (3,), x turned by :data:`TURNS` from the x or z axis of each
    object, whichever is closer to perpendicular to ``back``, made perpendicular to it.
    """
    axes = rotation[:, :, [0, 2]].swapaxes(1, 2)  # (n, 2, 3)
    across = axes - (axes @ back)[..., None] * back
    length = np.linalg.norm(across, axis=-1)
    best = length.argmax(axis=1)
    rows = np.arange(len(rotation))
    start = across[rows, best] / length[rows, best, None]
    side = np.cross(back, start)
    turns = np.array(TURNS)[:, None]
    closing = np.cos(turns) * start[:, None] + np.sin(turns) * side[:, None]  # (n, T, 3)
    return np.stack([closing, np.cross(back, closing), np.broadcast_to(back, closing.shape)], axis=-1)


def _inner(size: tuple[float, float, float], base: tuple[float, float, float]) -> ConvexPart:
    """A box of this size (m) above ``base``, smaller by :data:`TOUCHING` on each side."""
    x, y, z = (length - 2 * TOUCHING for length in size)
    return box((x, y, z), (base[0], base[1], base[2] + TOUCHING))
