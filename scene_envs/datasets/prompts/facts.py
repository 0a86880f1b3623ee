"""Facts of a scene that prompts describe, from poses and asset geometry alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from scene_envs.arrays import Array, Index, Mask
from scene_envs.errors import InvalidInputError
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import SceneType, get_scene_type
from scene_envs.supports import CONTACT, LARGEST_CONTACT, Contacts, Holding, Placed

SIDES = ("left", "right", "front", "back")
"""Directions of the viewer. Front is toward the viewer, or toward the lower edge of a view from above."""

_CHUNK = 32
"""Number of scenes computed together."""
_FURNITURE = 0.5
"""Objects at least this high (m) are furniture."""


@dataclass(frozen=True)
class Tolerances:
    """Limits within which a relation holds.

    Attributes:
        contact: Largest gap or overlap (m) of surfaces that touch; an object that touches nothing is on the table or
            tier within three times this distance.
        aside: Smallest offset (m) of two centres to the left, right, front or back.
        cone: Smallest ratio of that offset to the offset across.
        beside: Largest horizontal distance (m) of two bounding boxes that are next to each other.
        beside_furniture: Largest such distance (m) between pieces of furniture (0.5 m high or more).
        order: Smallest difference (m) between neighbours in an order such as "the second cup from the left".

    Raises:
        InvalidInputError: contact is not in (0, 0.03] m.
    """

    contact: float = CONTACT
    aside: float = 0.02
    cone: float = 1.0
    beside: float = 0.05
    beside_furniture: float = 0.5
    order: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.contact <= LARGEST_CONTACT:
            raise InvalidInputError(f"contact must lie in (0, {LARGEST_CONTACT}] m, got {self.contact}")


NOMINAL = Tolerances()
"""Tolerances of checks."""
STRICT = Tolerances(contact=0.005, aside=0.03, cone=1.25, beside=0.04, beside_furniture=0.4, order=0.02)
LOOSE = Tolerances(contact=0.015, beside=0.06, beside_furniture=0.6)
"""Prompts are written only when they hold under all three tolerances, so that none depends on small offsets."""


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """Facts that prompts can state about one scene of n objects. Indices are into these n objects.

    Attributes:
        names: (n,) display names.
        slots: (n,) slots of the scene.
        positions: (n, 3) centres of mass in m: to the viewer's right, to the front, up.
        boxes: (n, 2, 3) lowest and highest corner along the same axes.
        fixed: (n,) bool, welded objects such as tables, shelves and floors.
        tiers: (n,) number of tiers of each object.
        held: Supports of the objects.
        tolerances: Limits within which a relation holds.

    >>> (facts,) = scene_facts(SceneBatch.empty("dimsum_table", 1))
    >>> facts.count, facts.objects
    (1, Counter({'table': 1}))
    """

    names: tuple[str, ...]
    slots: Index
    positions: Array
    boxes: Array
    fixed: Mask
    tiers: Index
    held: Holding[NDArray[Any]]
    tolerances: Tolerances = NOMINAL

    @property
    def count(self) -> int:
        """Objects, welded ones included."""
        return len(self.names)

    @cached_property
    def objects(self) -> Counter[str]:
        """Display name to number."""
        return Counter(self.names)

    @cached_property
    def _of_name(self) -> dict[str, Index]:
        names = np.array(self.names)
        return {name: np.flatnonzero(names == name) for name in self.objects}

    def named(self, name: str) -> Index:
        """Indices of the objects called ``name``."""
        return self._of_name.get(name, np.empty(0, dtype=np.int64))

    def along(self, side: str) -> Array:
        """(n,) positions along a direction of :data:`SIDES`, m."""
        axis, sign = {"left": (0, -1.0), "right": (0, 1.0), "front": (1, 1.0), "back": (1, -1.0)}[side]
        return sign * self.positions[:, axis]

    def together(self, first: int, second: int) -> bool:
        """Whether two objects share a table, a tier or the floor, and neither carries the other."""
        place, tier = self.held.place, self.held.tier
        same = first != second and place[first] >= 0 and place[first] == place[second] and tier[first] == tier[second]
        return bool(same) and not (self.carries(first, second) or self.carries(second, first))

    def carries(self, lower: int, upper: int) -> bool:
        """Whether the chain of supports below ``upper`` goes through ``lower``."""
        below = int(self.held.support[upper])
        while below >= 0 and below != lower:
            below = int(self.held.support[below])
        return below == lower and below >= 0

    def is_at(self, side: str, first: int, second: int) -> bool:
        """Whether ``first`` is to the given side of ``second``, or close to it for the side ``next``."""
        return self.is_next_to(first, second) if side == "next" else self.is_aside(side, first, second)

    def is_aside(self, side: str, first: int, second: int) -> bool:
        """Whether ``first`` is to the given side of ``second``."""
        offset = self.positions[first] - self.positions[second]
        across = abs(offset[1 if side in ("left", "right") else 0])
        ahead = float(self.along(side)[first] - self.along(side)[second])
        limits = self.tolerances
        return ahead >= limits.aside and ahead >= limits.cone * across and self.together(first, second)

    def is_next_to(self, first: int, second: int) -> bool:
        """Whether two objects are close at the same height."""
        low, high = self.boxes[:, 0], self.boxes[:, 1]
        gaps = np.maximum(low[first] - high[second], low[second] - high[first])
        tall = min(high[first, 2] - low[first, 2], high[second, 2] - low[second, 2]) >= _FURNITURE
        reach = self.tolerances.beside_furniture if tall else self.tolerances.beside
        near = gaps[2] < 0.0 and np.hypot(*np.maximum(gaps[:2], 0.0)) <= reach
        return bool(near) and self.together(first, second)


def viewer_axes(scene_type: str | SceneType) -> Array:
    """(3, 3): rows are the viewer's right, front and up in the world frame, from the scene type's camera.

    All sides are horizontal or vertical in the world: right is the image's right, front is toward the viewer (for
    a shelf) or toward the lower edge of the image (for a view from above).

    >>> viewer_axes("dimsum_table").round(6).tolist()
    [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]

    Raises:
        InvalidInputError: the camera has no horizontal right: it looks along its up direction, or lies on its side.
    """
    kind = get_scene_type(scene_type)
    camera = kind.camera
    right = np.cross(np.subtract(camera.target, camera.position, dtype=float), camera.up)
    right[2] = 0.0
    length = float(np.linalg.norm(right))
    if not length > 1e-9:
        raise InvalidInputError(
            f"the camera of scene type {kind.name!r} at {camera.position}, target {camera.target}, up {camera.up} has "
            "no left and right; a camera that looks down needs a horizontal up, such as (-1, 0, 0)"
        )
    right /= length
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([right, np.cross(right, up), up]) + 0.0


def scene_facts(batch: SceneBatch, tolerances: Tolerances = NOMINAL) -> list[SceneFacts]:
    """Facts about each scene of ``batch``."""
    return facts_under(batch, [tolerances])[0]


def facts_under(batch: SceneBatch, tolerances: Sequence[Tolerances]) -> list[list[SceneFacts]]:
    """The facts of each scene under each of several tolerances; geometry is computed once."""
    result: list[list[SceneFacts]] = [[] for _ in tolerances]
    display = [asset.display_name for asset in batch.scene_type.library]
    axes = torch.from_numpy(viewer_axes(batch.scene_type)).to(batch.tensor.device)
    for start in range(0, len(batch), _CHUNK):
        some = batch[start : start + _CHUNK]
        shapes, placed = Placed.of_scenes(some.scene_type, some.categories, some.translations, some.rotations)
        points, tiered = axes @ placed.points, torch.isfinite(shapes.tiers[placed.category])
        corners = torch.stack([points.amin(dim=-1), points.amax(dim=-1)], dim=1)
        columns = placed.category, placed.slot, placed.center @ axes.T, corners, placed.fixed, tiered.sum(dim=1)
        category, slots, positions, boxes, fixed, tiers = (column.cpu().numpy() for column in columns)
        counts = torch.bincount(placed.scene, minlength=len(some))
        ends = counts.cumsum(0)
        number = torch.arange(len(placed.scene), device=ends.device) - (ends - counts)[placed.scene]
        contacts = Contacts.of(shapes, placed)
        for facts, limits in zip(result, tolerances, strict=True):
            holding = contacts.holding(limits.contact).counted(number)
            held = {name: column.cpu().numpy() for name, column in vars(holding).items()}
            for stop, count in zip(ends.tolist(), counts.tolist(), strict=True):
                part = slice(stop - count, stop)
                names = tuple(display[c] for c in category[part])
                below = Holding(**{name: column[part] for name, column in held.items()})
                facts.append(
                    SceneFacts(
                        names, slots[part], positions[part], boxes[part], fixed[part], tiers[part], below, limits
                    )
                )
    return result
