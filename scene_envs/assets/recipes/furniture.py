"""Furniture: tables, which are welded, chairs and the floor."""

from __future__ import annotations

import numpy as np

from scene_envs.assets.panels import Patch, painted_box
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.shapes import box, solid
from scene_envs.assets.surfaces import Color, join, lathe, planks

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
