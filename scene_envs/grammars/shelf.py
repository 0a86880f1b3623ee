"""Shelf: positions of its four tiers, and clearance from its boards."""

from __future__ import annotations

from collections.abc import Sequence

from scene_envs.grammars.surface import Region
from scene_envs.grammars.towers import Node, Surface

TIER_HEIGHTS = (-0.3915, -0.1232, 0.1392, 0.4075)
"""z of the upper side of each board (m), bottom first, in the frame of the shelf."""
HALF_DEPTH, HALF_WIDTH = 0.1475, 0.284
"""Half of the clear depth and width of a tier, m."""
MIDDLE = 0.0025
"""x of the middle of the clear depth (m): the back board takes 5 mm."""
TIER = Region(HALF_DEPTH, HALF_WIDTH, overhang=0.0, x=MIDDLE)


def tiers(inner: Node, top: Node) -> Sequence[Surface]:
    """The four boards, the three inner ones alike."""
    return [
        *(Surface([inner], TIER, height=height) for height in TIER_HEIGHTS[:3]),
        Surface([top], TIER, height=TIER_HEIGHTS[3]),
    ]
