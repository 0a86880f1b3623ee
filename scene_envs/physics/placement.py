"""Objects of a chunk of scenes as flat arrays, and their convex parts in the world."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.geometry import LevelGeometry, LibraryGeometry
from scene_envs.physics.rows import Rows
from scene_envs.physics.separation import PlacedParts, rotate

Level = Literal["fine", "coarse"]


@dataclass(frozen=True, eq=False)
class Objects(Rows):
    """The non-empty slots of some scenes, flattened."""

    scene: Index  # (n,) scene of each object, ascending
    slot: Index  # (n,) slot of each object, ascending within a scene
    category: Index  # (n,) asset index
    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) m
    fixed: Mask  # (n,) bool, welded or static

    def __len__(self) -> int:
        return len(self.scene)


def flatten(
    library: LibraryGeometry, translations: Array, rotations: Array, categories: Index, welded: Mask
) -> Objects:
    """The objects of scenes given as (B, N, 3), (B, N, 3, 3), (B, N) and a mask of welded slots (B, N)."""
    scene, slot = np.nonzero(categories < len(library.assets))
    category = categories[scene, slot].astype(np.int64)
    fixed = welded[scene, slot] | library.static[category]
    return Objects(scene, slot, category, rotations[scene, slot], translations[scene, slot], fixed)


@dataclass(frozen=True, eq=False)
class PlacedObjects:
    """Parts of objects at one level of detail, with their bounding boxes."""

    parts: PlacedParts  # (I,) placed parts, those of one object together
    start: Index  # (n,) first part of each object
    count: Index  # (n,) number of parts of each object
    low: Array  # (I, 3) lowest corner of each part's box, m
    high: Array  # (I, 3) highest corner of each part's box, m


def place(library: LibraryGeometry, objects: Objects, level: Level) -> PlacedObjects:
    """Put the parts of ``objects`` into the world."""
    levels: list[LevelGeometry] = [getattr(asset, level) for asset in library.assets]
    counts = np.array([len(geometry.parts) for geometry in levels], dtype=np.int64)
    count = counts[objects.category]
    start = np.cumsum(count) - count
    total = int(count.sum())
    part = np.empty(total, dtype=np.int64)
    low, high = np.empty((total, 3)), np.empty((total, 3))
    for category in np.unique(objects.category):
        rows = np.flatnonzero(objects.category == category)
        geometry = levels[category]
        target = start[rows][:, None] + np.arange(counts[category])
        world = rotate(objects.rotation[rows], geometry.vertices[None]) + objects.translation[rows][:, None]
        part[target] = geometry.ids
        low[target] = np.minimum.reduceat(world, geometry.starts, axis=1)
        high[target] = np.maximum.reduceat(world, geometry.starts, axis=1)
    owner = np.repeat(np.arange(len(objects)), count)
    parts = PlacedParts(part, objects.rotation[owner], objects.translation[owner])
    return PlacedObjects(parts, start, count, low, high)


def object_boxes(placed: PlacedObjects) -> tuple[Array, Array]:
    """Bounding boxes (n, 3), (n, 3) of whole objects, m."""
    if not len(placed.start):
        return np.empty((0, 3)), np.empty((0, 3))
    return np.minimum.reduceat(placed.low, placed.start), np.maximum.reduceat(placed.high, placed.start)


def part_pairs(placed: PlacedObjects, first: Index, second: Index) -> tuple[Index, Index, Index]:
    """All pairs of parts of the object pairs (``first``, ``second``), both (P,).

    Returns:
        index (Q,) of the object pair, and the two parts (Q,), (Q,) as rows of ``placed.parts``.
    """
    sizes = placed.count[first] * placed.count[second]
    pair = np.repeat(np.arange(len(first)), sizes)
    within = np.arange(len(pair)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    columns = placed.count[second][pair]
    return pair, placed.start[first][pair] + within // columns, placed.start[second][pair] + within % columns
