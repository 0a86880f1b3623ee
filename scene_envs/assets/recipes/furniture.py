"""Furniture: tables, which are welded, chairs and the floor."""

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
    hull_of,
    join,
    lathe,
    lettering,
    loft,
    moved,
    painted_box,
    planks,
    solid,
)

_TOP_RADIUS, _TOP_THICKNESS, _HEIGHT = 0.625, 0.03, 0.785
_WALNUT = [(142, 99, 68), (131, 90, 61), (149, 106, 74), (125, 85, 57), (137, 95, 65)]
_EDGE, _IRON = (112, 75, 50), (62, 60, 62)

_LEG = 0.70
_ASH: list[Color] = [(218, 190, 150), (210, 180, 138), (224, 197, 158), (205, 175, 132)]
_ASH_EDGE: Color = (190, 158, 116)
_CHAIR: Color = (150, 102, 66)
_CHAIR_DARK: Color = (130, 86, 54)
_CUSHION: Color = (176, 128, 88)
_TILES: list[Color] = [(216, 210, 200), (206, 199, 188), (220, 215, 206), (201, 194, 182)]
# the shelf
TIERS = (-0.3915, -0.1232, 0.1392, 0.4075)
"""Heights of the upper surfaces of the boards in the frame of the shelf, m."""
BOARD = 0.016
"""Thickness of boards and sides, m."""
BACK = 0.005
"""Thickness of the back, m."""
_DEPTH, _WIDTH = 0.30, 0.60


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


@asset_recipe("breakfast_table", display_name="table", mass=0.0, color=(186, 150, 112))
def breakfast_table() -> Model:
    """A table for six, 0.75 by 1.50 m, on four legs 0.70 m long; its top surface is z = 0."""
    top = box((0.75, 1.50, 0.04), (0.0, 0.0, -0.04))
    places = [(x, y) for x in (-0.315, 0.315) for y in (-0.69, 0.69)]
    legs = [box((0.06, 0.06, _LEG), (x, y, -0.04 - _LEG)) for x, y in places]
    boards = [
        Patch(i / 6.0, j / 4.0, (i + 1) / 6.0, (j + 1) / 4.0, _ASH[(i + (j + i % 2) // 2) % 4])
        for i in range(6)
        for j in range(4)
    ]
    visual = join(
        painted_box((0.75, 1.50, 0.04), _ASH_EDGE, {"top": boards}, base=(0.0, 0.0, -0.04)),
        *(painted_box((0.06, 0.06, _LEG), _ASH_EDGE, base=(x, y, -0.04 - _LEG)) for x, y in places),
    )
    parts = [top, *legs]  # no coarse hull: a solid block would hide that the top is a face to stand on
    return Model(visual, parts, parts)


@asset_recipe("chair", display_name="chair", mass=6.0, color=(84, 52, 32))
def chair() -> Model:
    """A wooden chair; a person on it looks toward +x. The seat is 0.45 m, the back 0.90 m high."""
    seat_low, seat, height, leg = 0.415, 0.45, 0.90, 0.04
    side, near = 0.45, 0.5 * (0.45 - 0.04)
    board = box((side, side, seat - seat_low), (0.0, 0.0, seat_low))
    back = box((0.03, side, height - seat), (-0.21, 0.0, seat))
    places = [(x, y) for x in (-near, near) for y in (-near, near)]
    legs = [box((leg, leg, seat_low), (x, y, 0.0)) for x, y in places]
    rails = [(0.09, 0.81), (0.055, 0.70), (0.055, 0.59)]
    visual = join(
        painted_box((side, side, seat - seat_low), _CHAIR, {"top": [Patch(0.06, 0.05, 0.94, 0.95, _CUSHION)]},
                    base=(0.0, 0.0, seat_low), front="+x"),
        *(painted_box((leg, leg, seat_low), _CHAIR_DARK, base=(x, y, 0.0)) for x, y in places),
        *(painted_box((0.03, 0.04, height - seat), _CHAIR, base=(-0.21, y, seat)) for y in (-near, near)),
        *(painted_box((0.018, side - 0.08, tall), _CHAIR_DARK, base=(-0.21, 0.0, z)) for tall, z in rails),
    )  # fmt: skip
    parts = [board, back, *legs]
    return Model(visual, parts, parts)


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


@asset_recipe("shelf", display_name="shelf", plural="shelves", mass=0.0, color=(160, 128, 72))
def shelf() -> Model:
    """Four boards between two sides; the origin is in the middle, the open side faces +x. The top board, 0.30 by 0.60
    m, is open on all sides. Below it there are 0.295 m (x from -0.145 to 0.15) by 0.568 m (y) of clear space, 0.2523,
    0.2464 and 0.2523 m high from the lowest tier up.
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
