"""Welded furniture."""

from __future__ import annotations

import numpy as np

from scene_envs.assets.library import Model, asset_recipe
from scene_envs.assets.shapes import solid
from scene_envs.assets.surfaces import join, lathe, planks

_TOP_RADIUS, _TOP_THICKNESS, _HEIGHT = 0.625, 0.03, 0.785
_WALNUT = [(142, 99, 68), (131, 90, 61), (149, 106, 74), (125, 85, 57), (137, 95, 65)]
_EDGE, _IRON = (112, 75, 50), (62, 60, 62)


@asset_recipe("cafe_table", display_name="table", mass=0.0, color=(139, 98, 66))
def cafe_table() -> Model:
    """A round table on a post; its top surface is z = 0."""
    top = solid([(_TOP_RADIUS, -_TOP_THICKNESS), (_TOP_RADIUS, 0.0)], 32)
    post = solid([(0.04, 0.03 - _HEIGHT), (0.04, -_TOP_THICKNESS)], 12)
    foot = solid([(0.27, -_HEIGHT), (0.27, 0.015 - _HEIGHT), (0.05, 0.03 - _HEIGHT)], 24)
    bevel = _TOP_RADIUS - 0.004
    visual = join(
        planks(_TOP_RADIUS - 0.02, 0.0, _WALNUT, count=9, rows=10, columns=3),
        lathe([(bevel, -0.0005), (_TOP_RADIUS - 0.05, -0.0005)], _EDGE, segments=72),
        lathe(
            [*((r, -0.03) for r in np.linspace(0.04, _TOP_RADIUS, 10)), (_TOP_RADIUS, -0.004), (bevel, 0.0)],
            _EDGE,
            segments=72,
        ),
        lathe([(0.04, 0.03 - _HEIGHT), (0.04, -0.03)], _IRON, segments=24),
        lathe([(0.0, -_HEIGHT), (0.27, -_HEIGHT), (0.27, 0.015 - _HEIGHT), (0.04, 0.03 - _HEIGHT)], _IRON),
    )
    parts = [top, post, foot]
    return Model(visual, parts, parts)
