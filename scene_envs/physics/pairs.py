"""Near pairs of parts and of objects, as the collision finds them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.rows import Rows


@dataclass(frozen=True, eq=False)
class Contacts(Rows):
    """Near pairs of parts.

    Attributes:
        first, second: (Q,) object rows; ``second`` is the larger one.
        part_first, part_second: (Q,) index of each object's part in the library.
        gap: (Q,) m along ``direction``; the true distance is at least this much.
        direction: (Q, 3) unit vector in the world, from the first part to the second.
    """

    first: Index
    second: Index
    part_first: Index
    part_second: Index
    gap: Array
    direction: Array

    def among(self, number: Index) -> Contacts:
        """The contacts of objects whose new ``number`` (n,) is not negative, renumbered."""
        first, second = number[self.first], number[self.second]
        return replace(self, first=first, second=second)[(first >= 0) & (second >= 0)]


@dataclass(frozen=True, eq=False)
class ObjectPairs:
    """Pairs of objects whose boxes are near each other.

    Attributes:
        first, second: (P,) object rows; ``second`` is the larger one.
        gap: (P,) m, signed gap of the coarse parts along ``direction``.
        direction: (P, 3) unit vector in the world, from the first object to the second.
        depth: (P,) m, overlap of the fine parts; 0 without overlap.
        total: (P,) m, the sum of the depths of all overlapping fine parts (only when asked for).
        part_count: (P,) overlapping fine part pairs (only when asked for).
        low, high: (n, 3) lowest and highest corner of each object's box, m.
        contacts: Near pairs of the coarse parts of these objects.
        rough: (P,) bool, True where the depth is an upper bound, from face planes of the coarse parts, because exact
            depths of the scene would take too long.
    """

    first: Index
    second: Index
    gap: Array
    direction: Array
    depth: Array
    total: Array
    part_count: Index
    low: Array
    high: Array
    contacts: Contacts
    rough: Mask

    def among(self, rows: Index) -> ObjectPairs:
        """The pairs of the objects ``rows`` (m,), ascending, renumbered to 0..m-1."""
        number = np.full(len(self.low), -1, dtype=np.int64)
        number[rows] = np.arange(len(rows))
        first, second = number[self.first], number[self.second]
        kept = (first >= 0) & (second >= 0)
        return ObjectPairs(
            first[kept],
            second[kept],
            self.gap[kept],
            self.direction[kept],
            self.depth[kept],
            self.total[kept],
            self.part_count[kept],
            self.low[rows],
            self.high[rows],
            self.contacts.among(number),
            self.rough[kept],
        )

    def deepest(self) -> Array:
        """(n,) m, the deepest overlap of each object."""
        depth = np.zeros(len(self.low))
        np.maximum.at(depth, self.first, self.depth)
        np.maximum.at(depth, self.second, self.depth)
        return depth
