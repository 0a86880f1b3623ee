"""Collision-free approaches of a parallel gripper to the objects of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
import torch
from torch import Tensor

from scene_envs.arrays import Array, Index, Mask
from scene_envs.assets.base import Asset, AssetLibrary, ConvexPart
from scene_envs.assets.shapes import box
from scene_envs.errors import InvalidInputError
from scene_envs.physics.collision import Collider
from scene_envs.physics.parts import library_geometry
from scene_envs.physics.placement import Budget, Objects, flatten, object_boxes, part_pairs, place, separations
from scene_envs.scene import SceneBatch

TOUCHING = 1e-4
"""Overlap (m) of the gripper with an object up to which it only touches the object."""
TURNS = tuple(np.arange(4) * np.pi / 4)
"""Angles (rad) of the closing direction about the approach, counted from an axis of the object."""
PLACES = (0.5, 0.0, 1.0)
"""Grasp positions as fractions of the object's extent in the closing direction: its middle, then its two edges."""
PART_PAIRS = 35_000.0
"""Limit of pairs of convex parts tested per scene: six times the number of a crowded scene, about 0.6 s."""


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
        """The two fingers, and the palm with its path; x is the closing direction, z points back from the tips."""
        aside = 0.5 * (self.opening + self.finger_thickness)
        finger = (self.finger_thickness, self.finger_width, self.finger_length)
        palm = (*self.palm, self.path)
        return box(finger, (-aside, 0, 0)), box(finger, (aside, 0, 0)), box(palm, (0, 0, self.finger_length))

    def grasp(self) -> ConvexPart:
        """The space between the fingers."""
        return box((self.opening, self.finger_width, self.finger_length))


@dataclass(frozen=True, eq=False)
class ReachResult:
    """Objects that a gripper reaches."""

    reached: Tensor  # (A, B, N) bool, for each approach; False for welded and empty slots
    valid: Tensor  # (B,) bool; False for scenes, such as heaps, of too much work


def reachable(batch: SceneBatch, approaches: Sequence[Sequence[float]], gripper: Gripper | None = None) -> ReachResult:
    """Objects of B scenes that an open gripper reaches in a straight line without touching anything.

    For each of A ``approaches``, directions in the world from the object to the waiting gripper, such as (0, 0, 1), it
    is tried at the middle and both edges of the object, with four closing directions and all reaches. It reaches the
    object when a part of it is between the fingers, and fingers, palm and the palm's path overlap no object by more
    than 0.1 mm (fine convex parts, exact depths).
    """
    gripper = Gripper() if gripper is None else gripper
    found = torch.zeros(len(approaches), *batch.tensor.shape[:2], dtype=torch.bool)
    valid = torch.ones(len(batch), dtype=torch.bool)
    categories = batch.categories.cpu().numpy()
    translations = batch.translations.double().cpu().numpy()
    rotations = batch.rotations.double().cpu().numpy()
    welded = batch.is_welded.cpu().numpy()
    hand = _hand(batch.scene_type.library, gripper)
    for row in range(len(batch)):
        rows = slice(row, row + 1)
        objects = flatten(hand.collider.library, translations[rows], rotations[rows], categories[rows], welded[rows])
        objects = objects[np.flatnonzero(categories[row, objects.slot] < batch.scene_type.num_assets)]
        budget = Budget(PART_PAIRS)
        for index, approach in enumerate(approaches):
            met = hand.reach(objects, np.asarray(approach, dtype=np.float64), budget)
            found[index, row, objects.slot[met]] = True
        valid[row] = not budget.is_spent
    device = batch.tensor.device
    return ReachResult((found & valid[:, None]).to(device), valid.to(device))


class _Hand:
    """A gripper with the assets of a library; the last two assets are the gripper and its space for a grasp."""

    def __init__(self, library: AssetLibrary, gripper: Gripper) -> None:
        self.gripper = gripper
        self.body, self.grasp = len(library), len(library) + 1
        tools = (_tool("gripper", gripper.body()), _tool("grasp", (gripper.grasp(),)))
        self.collider = Collider(library_geometry((*library.assets, *tools)))
        self.corners = [np.concatenate([part.vertices for part in asset.fine]) for asset in library]

    def reach(self, objects: Objects, back: Array, budget: Budget) -> Index:
        """Rows of the free objects of one scene that the gripper reaches from the direction ``back`` (3,). ``budget``
        counts pairs of convex parts; when it is spent, the result is not valid.
        """
        free = np.flatnonzero(~objects.fixed)
        if not len(free):
            return free
        owner, rotation, low, high = self._extents(objects, free, back / np.linalg.norm(back))
        open_rows = free
        for place_along, reach in product(PLACES, self.gripper.reaches):
            if budget.is_spent:
                return free[:0]
            tried = np.flatnonzero(np.isin(owner, open_rows))
            across = low[tried, 0] + place_along * (high[tried, 0] - low[tried, 0])
            deep = np.maximum(high[tried, 2] - reach, low[tried, 2])
            tips = np.stack([across, 0.5 * (low[tried, 1] + high[tried, 1]), deep], axis=1)
            tips = np.einsum("gij,gj->gi", rotation[tried], tips)
            good = self._succeed(objects, owner[tried], rotation[tried], tips, budget)
            open_rows = np.setdiff1d(open_rows, owner[tried[good]])
        return np.setdiff1d(free, open_rows)

    def _extents(self, objects: Objects, rows: Index, back: Array) -> tuple[Index, Array, Array, Array]:
        """Gripper frames for some objects: owner (G,), rotation (G, 3, 3) to the world, and the owner's lowest and
        highest coordinates (G, 3), (G, 3) m along the axes of the gripper.
        """
        rotation = _frames(objects.rotation[rows], back)  # (n, T, 3, 3)
        low, high = np.empty(rotation.shape[:3]), np.empty(rotation.shape[:3])
        for index, row in enumerate(rows.tolist()):
            points = self.corners[objects.category[row]] @ objects.rotation[row].T + objects.translation[row]
            along = points @ rotation[index]  # (T, V, 3)
            low[index], high[index] = along.min(axis=1), along.max(axis=1)
        owner = np.repeat(rows, len(TURNS))
        return owner, rotation.reshape(-1, 3, 3), low.reshape(-1, 3), high.reshape(-1, 3)

    def _succeed(self, objects: Objects, owner: Index, rotation: Array, translation: Array, budget: Budget) -> Index:
        """Rows of the G poses at which part of the object is between the fingers and the gripper overlaps nothing."""
        left = np.arange(len(owner))
        for tool, wanted in ((self.grasp, True), (self.body, False)):
            both = _concatenate(objects, tool, rotation[left], translation[left])
            first = len(objects) + np.arange(len(left))
            left = left[self._overlap(both, first, owner[left], budget) == wanted]
        return left[~self._is_blocked(objects, rotation[left], translation[left], budget)]

    def _is_blocked(self, objects: Objects, rotation: Array, translation: Array, budget: Budget) -> Mask:
        """(G,) whether the gripper overlaps anything."""
        both = _concatenate(objects, self.body, rotation, translation)
        count, total = len(objects), len(both)
        low, high = object_boxes(place(self.collider.library, both, "fine"))
        near = ((low[count:, None] < high[None, :count]) & (low[None, :count] < high[count:, None])).all(axis=-1)
        first, second = np.nonzero(near)
        blocked = np.zeros(total - count, dtype=bool)
        blocked[first[self._overlap(both, first + count, second, budget)]] = True
        return blocked

    def _overlap(self, objects: Objects, first: Index, second: Index, budget: Budget) -> Mask:
        """(P,) whether two objects overlap by more than :data:`TOUCHING`."""
        placed = place(self.collider.library, objects, "fine")
        pair, a, b = part_pairs(placed, first, second)
        near = ((placed.low[a] < placed.high[b]) & (placed.low[b] < placed.high[a])).all(axis=-1)
        pair, a, b = pair[near], a[near], b[near]
        overlap = np.zeros(len(first), dtype=bool)
        budget.spent += len(pair)
        if budget.is_spent:
            return overlap
        gap, _ = separations(self.collider.library, placed.parts, a, b)
        deep = gap < -TOUCHING
        pair, a, b = pair[deep], a[deep], b[deep]
        depth, _ = self.collider.depth(placed.parts, a, b)
        overlap[pair[depth > TOUCHING]] = True
        return overlap


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


def _concatenate(objects: Objects, category: int, rotation: Array, translation: Array) -> Objects:
    """The objects of one scene, followed by G tools."""
    scene = np.zeros(len(rotation), dtype=np.int64)
    return objects + Objects(scene, scene - 1, scene + category, rotation, translation, scene > 0)


def _tool(name: str, parts: tuple[ConvexPart, ...]) -> Asset:
    """Convex parts as an asset without mass, for collisions alone."""
    zero = np.zeros(3)
    return Asset(name, name, name, 0.0, zero, np.zeros((3, 3)), None, parts, parts, (0, 0, 0), True)  # type: ignore[arg-type]
