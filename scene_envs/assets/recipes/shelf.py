"""Shelf with four tiers, and book, lamp and speaker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from scene_envs.assets.panels import Patch, lettering, loft, moved, painted_box
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.shapes import box, convex_hull, hull_of, solid
from scene_envs.assets.surfaces import Color, join, lathe

TIERS = (-0.3915, -0.1232, 0.1392, 0.4075)
"""Heights of the upper surfaces of the boards in the frame of the shelf, m."""
BOARD = 0.016
"""Thickness of boards and sides, m."""
BACK = 0.005
"""Thickness of the back, m."""
_DEPTH, _WIDTH = 0.30, 0.60


@asset_recipe("shelf", display_name="shelf", plural="shelves", mass=0.0, color=(160, 128, 72))
def shelf() -> Model:
    """Four boards between two sides; the origin is in the middle, the open side faces +x.

    Below the top board there are 0.295 m (x from -0.145 to 0.15) by 0.568 m (y) of clear space, and 0.2523, 0.2464
    and 0.2523 m of clear height from the lowest tier up. The top board is 0.30 by 0.60 m and open on all sides.
    """
    bottom, top = TIERS[0] - BOARD, TIERS[-1] - BOARD
    inner = _WIDTH - 2.0 * BOARD
    pieces = [((_DEPTH, _WIDTH, BOARD), (0.0, 0.0, z)) for z in (bottom, top)]
    pieces += [((_DEPTH - BACK, inner, BOARD), (0.5 * BACK, 0.0, z - BOARD)) for z in TIERS[1:-1]]
    height = top - TIERS[0]
    sides = [((_DEPTH, BOARD, height), (0.0, s * 0.5 * (inner + BOARD), TIERS[0])) for s in (-1.0, 1.0)]
    back = ((BACK, inner, height), (0.5 * (BACK - _DEPTH), 0.0, TIERS[0]))
    oak, edge, pale = (198, 160, 112), (176, 136, 90), (222, 192, 148)
    grain = [Patch(0.0, z, 1.0, z + 0.02, (190, 151, 104)) for z in (0.12, 0.31, 0.55, 0.74, 0.9)]
    upright = [Patch(x, 0.0, x + 0.03, 1.0, (190, 151, 104)) for x in (0.15, 0.4, 0.62, 0.85)]
    visual = join(
        *(
            painted_box(size, {"-x": edge, "+x": edge, "-y": edge, "+y": edge, "bottom": oak, "top": oak},
                        {"top": grain}, base=base, front="+x")
            for size, base in pieces
        ),
        *(
            painted_box(size, {"-x": edge, "+x": edge, "-y": oak, "+y": oak, "bottom": oak, "top": oak},
                        {"-y": upright, "+y": upright}, base=base)
            for size, base in sides
        ),
        painted_box(back[0], pale, base=back[1]),
    )  # fmt: skip
    parts = [box(size, base) for size, base in (*pieces, *sides, back)]
    return Model(visual, parts, parts)


@asset_recipe("book", display_name="book", mass=0.45, color=(30, 64, 140))
def book() -> Model:
    """A thick book that stands upright, its spine toward +x."""
    size = (0.14, 0.05, 0.21)
    cover, cream, paper, line = (186, 66, 50), (246, 236, 212), (240, 232, 214), (222, 210, 186)
    board, inset = 0.003, 0.004
    aside = 0.5 * (size[1] - board)
    front = [
        Patch(0.10, 0.58, 0.90, 0.90, cream),
        *lettering(0.18, 0.78, 0.82, 0.86, cover, (1, 0.8, 1)),
        *lettering(0.18, 0.66, 0.82, 0.74, cover, (1, 1, 0.8, 1)),
        Patch(0.28, 0.22, 0.72, 0.46, (92, 148, 84)),
        Patch(0.36, 0.28, 0.64, 0.40, (236, 184, 72)),
        *lettering(0.22, 0.09, 0.78, 0.13, cream, (1, 1, 1, 1, 0.8, 1, 1)),
    ]
    spine = [
        Patch(0.0, 0.90, 1.0, 0.93, cream),
        Patch(0.0, 0.07, 1.0, 0.10, cream),
        *(Patch(0.30, z, 0.72, z + h, cream) for z, h in ((0.30, 0.07), (0.385, 0.05), (0.45, 0.07), (0.535, 0.05))),
        Patch(0.24, 0.70, 0.78, 0.80, (236, 184, 72)),
    ]
    blurb = [
        Patch(0.12, z, 0.88 - 0.2 * (k == 0), z + 0.018, cream) for k, z in enumerate(np.arange(0.46, 0.86, 0.055))
    ]
    blurb += [Patch(0.58, 0.08, 0.88, 0.20, cream)]
    blurb += lettering(0.62, 0.10, 0.84, 0.18, (60, 50, 44), (0.4, 0.7, 0.3, 0.5, 0.8, 0.4, 0.6))
    sheets = [Patch(x, 0.0, x + 0.06, 1.0, line) for x in np.arange(0.04, 0.95, 0.15)]
    pages = (size[0] - board - inset, size[1] - 2.0 * board, size[2] - 2.0 * inset)
    visual = join(
        painted_box((size[0], board, size[2]), cover, {"-y": front}, base=(0.0, -aside, 0.0)),
        painted_box((size[0], board, size[2]), cover, {"+y": blurb}, base=(0.0, aside, 0.0)),
        painted_box((board, pages[1], size[2]), cover, {"+x": spine}, base=(0.5 * (size[0] - board), 0.0, 0.0)),
        painted_box(pages, paper, {"-x": sheets, "top": sheets}, base=(0.5 * (inset - board), 0.0, inset), front="+x"),
    )  # fmt: skip
    part = box(size)
    return Model(visual, [part], [part])


@asset_recipe("lamp", display_name="lamp", mass=0.08, color=(255, 238, 130))
def lamp() -> Model:
    """A small table lamp, 0.10 m high: a base 0.04 m across, a stem and a shade 0.056 m across."""
    brass, linen, trim, bulb = (190, 150, 84), (248, 232, 196), (214, 178, 120), (255, 246, 214)
    base = solid([(0.020, 0.0), (0.020, 0.006), (0.012, 0.012)], 16)
    stem = solid([(0.004, 0.012), (0.004, 0.052)], 8)
    shade = solid([(0.028, 0.052), (0.017, 0.10)], 16)
    visual = join(
        lathe([(0.0, 0.0), (0.0195, 0.0), (0.020, 0.001), (0.020, 0.006), (0.015, 0.009), (0.012, 0.012),
               (0.006, 0.0135), (0.004, 0.018), (0.0055, 0.024), (0.004, 0.030), (0.0035, 0.054)], brass, segments=28),
        lathe([(0.0, 0.054), (0.025, 0.054), (0.0278, 0.052), (0.028, 0.0525), (0.0272, 0.056), (0.0179, 0.096),
               (0.017, 0.0995), (0.0165, 0.10), (0.0, 0.098)],
              [bulb, trim, trim, trim, linen, trim, trim, bulb], segments=32),
    )  # fmt: skip
    return Model(visual, [base, stem, shade], [hull_of([base, stem, shade])])


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
