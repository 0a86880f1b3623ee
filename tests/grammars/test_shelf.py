"""Tiers of shelves: agreement of the grammars with the shelf asset."""

from __future__ import annotations

import numpy as np
import pytest

from scene_envs.assets import get_library
from scene_envs.grammars import NOTHING, Object
from scene_envs.grammars.shelf import HALF_DEPTH, HALF_WIDTH, MIDDLE, TIER, TIER_HEIGHTS, tiers

SHELF = get_library(("shelf",))["shelf"]
BOXES = np.array([(part.vertices.min(axis=0), part.vertices.max(axis=0)) for part in SHELF.fine])
"""(parts, 2, 3) lowest and highest corner of each part, m; all of them are boxes."""


@pytest.mark.parametrize("height", TIER_HEIGHTS)
def test_a_board_ends_at_the_height_of_each_tier(height: float) -> None:
    assert any(abs(high[2] - height) < 1e-9 and np.ptp([low[1], high[1]]) > 0.5 for low, high in BOXES)


@pytest.mark.parametrize("height", TIER_HEIGHTS)
def test_no_part_of_the_shelf_is_in_the_way_on_a_tier(height: float) -> None:
    low = np.array([MIDDLE - HALF_DEPTH, -HALF_WIDTH, height])
    high = np.array([MIDDLE + HALF_DEPTH, HALF_WIDTH, height + 0.24])
    overlap = np.minimum(BOXES[:, 1], high) - np.maximum(BOXES[:, 0], low)
    assert not (overlap > 1e-9).all(axis=1).any()


def test_a_tier_keeps_footprints_whole() -> None:
    assert TIER.overhang == 0


def test_three_inner_tiers_and_the_top() -> None:
    inner, top = Object("soda_can"), NOTHING
    surfaces = tiers(inner, top)
    assert [surface.height for surface in surfaces] == list(TIER_HEIGHTS)
    assert [list(surface.children) for surface in surfaces] == [[inner], [inner], [inner], [top]]
