"""Near pairs of parts and of objects, as the collision finds them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scene_envs.arrays import Array, Index, Mask
from scene_envs.physics.rows import Rows


@dataclass(frozen=True, eq=False)
class Contacts(Rows):
    """Near pairs of parts."""

    first: Index  # (Q,) object rows
    second: Index  # (Q,) object rows, larger than ``first``
    part_first: Index  # (Q,) part of the first object in the library
    part_second: Index  # (Q,) part of the second object in the library
    gap: Array  # (Q,) m along ``direction``; the true distance is at least this much
    direction: Array  # (Q, 3) unit vector in the world, from the first part to the second

    def among(self, number: Index) -> Contacts:
        """The contacts of objects whose new ``number`` (n,) is not negative, renumbered."""
        first, second = number[self.first], number[self.second]
        return replace(self, first=first, second=second)[(first >= 0) & (second >= 0)]


@dataclass(frozen=True, eq=False)
class ObjectPairs:
    """Pairs of objects whose boxes are near each other."""

    first: Index  # (P,) object rows
    second: Index  # (P,) object rows, larger than ``first``
    gap: Array  # (P,) m, signed gap of the coarse parts along ``direction``
    direction: Array  # (P, 3) unit vector in the world, from the first object to the second
    depth: Array  # (P,) m, overlap of the fine parts; 0 without overlap
    total: Array  # (P,) m, sum of the depths of all overlapping fine parts (on request)
    part_count: Index  # (P,) overlapping fine part pairs (on request)
    low: Array  # (n, 3) lowest corner of each object's box, m
    high: Array  # (n, 3) highest corner of each object's box, m
    contacts: Contacts  # near pairs of the coarse parts of these objects
    rough: Mask  # (P,) the depth is an upper bound, from coarse parts: exact depths would take too long

    def among(self, rows: Index) -> ObjectPairs:
        """The pairs of the objects ``rows`` (m,), ascending, renumbered to 0..m-1."""
        number = np.full(len(self.low), -1, dtype=np.int64)
        number[rows] = np.arange(len(rows))
        first, second = number[self.first], number[self.second]
        kept = (first >= 0) & (second >= 0)
        first, second, low, high = first[kept], second[kept], self.low[rows], self.high[rows]
        gap, direction, depth, total = (column[kept] for column in (self.gap, self.direction, self.depth, self.total))
        count, contacts, rough = self.part_count[kept], self.contacts.among(number), self.rough[kept]
        return ObjectPairs(first, second, gap, direction, depth, total, count, low, high, contacts, rough)

    def deepest(self) -> Array:
        """(n,) m, the deepest overlap of each object."""
        depth = np.zeros(len(self.low))
        np.maximum.at(depth, self.first, self.depth)
        np.maximum.at(depth, self.second, self.depth)
        return depth
