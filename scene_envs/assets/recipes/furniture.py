"""The floor, whose tiles repeat by a rule, and a speaker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from scene_envs.assets.base import Model, asset_recipe
from scene_envs.assets.shapes import (
    Color,
    Patch,
    box,
    convex_hull,
    join,
    loft,
    moved,
    painted_box,
)

_TILES: list[Color] = [(216, 210, 200), (206, 199, 188), (220, 215, 206), (201, 194, 182)]


@asset_recipe("floor", display_name="floor", mass=0.0, color=(206, 200, 190))
def floor() -> Model:
    """A tiled floor, 10 m square and 0.1 m thick; its upper surface is z = 0."""
    size, count = (10.0, 10.0, 0.1), 20
    tiles = [
        Patch(
            i / count, j / count, (i + 1) / count, (j + 1) / count, _TILES[(i + j) % 2 + 2 * ((7 * i + 3 * j) % 3 == 0)]
        )
        for i in range(count)
        for j in range(count)
    ]
    part = box(size, (0.0, 0.0, -size[2]))
    return Model(painted_box(size, _TILES[1], {"top": tiles}, base=(0.0, 0.0, -size[2])), [part], [part])


@asset_recipe("speaker", display_name="speaker", mass=0.60, color=(72, 44, 100))
def speaker() -> Model:
    """A round loudspeaker lying along x on a flat 36 mm wide, so that it does not roll."""
    half = 0.0875
    section = np.array([(-0.018, 0.0), (0.018, 0.0), (0.030, 0.010), (0.035, 0.026), (0.035, 0.049), (0.030, 0.065),
                        (0.018, 0.075), (-0.018, 0.075), (-0.030, 0.065), (-0.035, 0.049), (-0.035, 0.026),
                        (-0.030, 0.010)])  # fmt: skip
    part = convex_hull([(x, y, z) for x in (-half, half) for y, z in section])
    cloth, rubber, badge, cone = (52, 60, 72), (30, 31, 36), (230, 96, 44), (96, 100, 110)
    turns = 2.0 * np.pi * (np.arange(28) + 0.5) / 28
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    ring /= (np.abs(ring) ** 3).sum(axis=1, keepdims=True) ** (1.0 / 3.0)  # as the section, without its corners
    ring *= np.array([0.035, 0.0375]) / np.abs(ring).max(axis=0)

    def skin(stations: Sequence[tuple[float, float]], color: Color, side: float = 1.0) -> trimesh.Trimesh:
        """A skin through scaled copies of the section at these (x, scale)."""
        rings = [[(x, scale * y, 0.0375 + scale * z) for y, z in ring] for x, scale in stations]
        return moved(loft(rings, color), np.diag([side, side, 1.0]))

    visual = join(
        skin([(-0.070, 1.0), (0.070, 1.0)], cloth),
        *(skin([(0.068, 1.0), (0.080, 1.0), (0.084, 0.97), (0.0855, 0.92)], rubber, side) for side in (1.0, -1.0)),
        *(skin([(0.0850, 0.80), (half, 0.78)], cone, side) for side in (1.0, -1.0)),
        painted_box((0.042, 0.0012, 0.018), badge, base=(0.0, -0.0346, 0.029)),
    )
    return Model(visual, [part], [part])
