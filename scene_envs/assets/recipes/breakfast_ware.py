"""Breakfast ware: plates, mugs, jugs and a crock for cutlery."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import trimesh

from scene_envs.arrays import Array
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.recipes.painted import Cells, revolve
from scene_envs.assets.shapes import hull_of, ring, rods, solid
from scene_envs.assets.surfaces import Color, arc, join, lathe, tube

_SIDES = 12
_WHITE: Color = (246, 245, 240)
_GLAZE: Color = (252, 251, 248)


def _plate(radius: float, height: float, foot: float, base: float, band: Color, well: Color) -> Model:
    """A plate with a flat middle of radius ``foot`` at height ``base``, hollow in both levels of detail (m)."""
    middle = solid([(foot, 0.0), (foot, base)], _SIDES)
    rim = ring([(foot, 0.0), (foot, base), (radius, height), (radius, height - base)], _SIDES)
    slope = (height - base) / (radius - foot)

    def inside(share: float) -> tuple[float, float]:
        r = foot + share * (radius - foot)
        return r, base + slope * (r - foot)

    visual = lathe(
        [
            (0.0, 0.0), (foot, 0.0), (radius - 0.003, height - base - slope * 0.003), (radius, height - 0.5 * base),
            (radius - 0.0005, height), (radius - 0.003, height - 0.0008), inside(0.72), inside(0.45), inside(0.12),
            (foot - 0.004, base), (0.0, base),
        ],
        [_WHITE, _WHITE, _WHITE, band, band, band, _GLAZE, _GLAZE, _WHITE, well],
        segments=64,
    )  # fmt: skip
    parts = [middle, *rim]
    return Model(visual, parts, parts)


@asset_recipe("plate", display_name="plate", mass=0.40, color=(200, 200, 250))
def plate() -> Model:
    """A plate 0.20 m across, flat within 71 mm of the axis, 6 mm above the table."""
    return _plate(0.10, 0.018, 0.074, 0.006, (108, 140, 160), _GLAZE)


@asset_recipe("shared_plate", display_name="plate", mass=0.45, color=(250, 180, 200))
def shared_plate() -> Model:
    """A plate 0.22 m across, flat within 79 mm of the axis, 6 mm above the table."""
    return _plate(0.11, 0.020, 0.082, 0.006, (196, 152, 84), (243, 238, 226))


def _handle(path: Sequence[tuple[float, float, float]], radius: float, color: Color) -> trimesh.Trimesh:
    """A round handle along ``path``, whose ends reach 2 mm into the wall so that they do not show."""
    points = np.array(path)
    points[[0, -1], 0] -= 0.002
    low, high = points[:-1], points[1:]
    thirds = np.stack([(2.0 * low + high) / 3.0, (low + 2.0 * high) / 3.0], axis=1).reshape(-1, 3)
    knots = np.concatenate([points[:1], thirds[1:-1], points[-1:]])  # rounds the corners, does not run past them
    return tube(arc(knots.tolist(), 20), radius, color)


_MUG_RADIUS, _MUG_HEIGHT, _MUG_WALL, _MUG_FLOOR = 0.040, 0.085, 0.0045, 0.006
_MUG_SIDES = 10
_MUG_FACE = _MUG_RADIUS * math.cos(math.pi / _MUG_SIDES)
"""Distance (m) from the axis of the flat face that the handle stands on."""
_MUG_HANDLE = [(_MUG_FACE, 0.0, 0.068), (0.058, 0.0, 0.068), (0.068, 0.0, 0.045), (0.058, 0.0, 0.020),
               (_MUG_FACE, 0.0, 0.020)]  # fmt: skip
_TEAL: Color = (70, 140, 146)
_TEAL_DARK: Color = (56, 118, 126)


@asset_recipe("mug", display_name="mug", mass=0.25, color=(90, 50, 160))
def mug() -> Model:
    """A straight mug with a handle toward +x."""
    inner = _MUG_RADIUS - _MUG_WALL
    wall = ring(
        [(inner, 0.0), (_MUG_RADIUS, 0.0), (_MUG_RADIUS, _MUG_HEIGHT), (inner, _MUG_HEIGHT)], _MUG_SIDES, np.pi / 2.0
    )
    floor = solid([(inner, 0.0), (inner, _MUG_FLOOR)], _MUG_SIDES, np.pi / 2.0)
    handle = rods(_MUG_HANDLE, width=0.010, thickness=0.008)
    visual = join(
        lathe(
            [
                (0.0, 0.002), (0.031, 0.002), (0.033, 0.0), (0.0365, 0.0), (0.0395, 0.004), (0.040, 0.010),
                (0.040, 0.016), (0.040, 0.0825), (0.0392, _MUG_HEIGHT), (0.0372, _MUG_HEIGHT), (0.0358, 0.083),
                (0.0355, 0.012), (0.031, 0.0068), (0.0, _MUG_FLOOR),
            ],
            [*[_WHITE] * 3, _TEAL_DARK, _TEAL, _TEAL, _TEAL, _TEAL, *[_WHITE] * 5],
        ),
        _handle(_MUG_HANDLE, 0.0045, _TEAL),
    )  # fmt: skip
    return Model(visual, [floor, *wall, *handle], [hull_of([floor, *wall]), hull_of(handle)])


_JUG_FOOT, _JUG_RADIUS, _JUG_HEIGHT, _JUG_WALL, _JUG_FLOOR = 0.046, 0.0525, 0.182, 0.005, 0.007
_JUG_HANDLE = [(0.0514, 0.0, 0.145), (0.076, 0.0, 0.145), (0.089, 0.0, 0.102), (0.076, 0.0, 0.055),
               (0.0482, 0.0, 0.055)]  # fmt: skip
_ENAMEL: Color = (232, 238, 240)
_RIM: Color = (44, 82, 140)
_STRIPE: Color = (96, 140, 190)


@asset_recipe("water_jug", display_name="water jug", mass=0.55, color=(0, 120, 230))
def water_jug() -> Model:
    """A tall jug with its handle toward +x and its lip toward -x."""
    outer, inner = (_JUG_FOOT, _JUG_RADIUS), (_JUG_FOOT - _JUG_WALL, _JUG_RADIUS - _JUG_WALL)
    wall = ring([(inner[0], 0.0), (outer[0], 0.0), (outer[1], _JUG_HEIGHT), (inner[1], _JUG_HEIGHT)], _SIDES)
    floor = solid([(inner[0], 0.0), (inner[0] + _JUG_FLOOR * (inner[1] - inner[0]) / _JUG_HEIGHT, _JUG_FLOOR)], _SIDES)
    handle = rods(_JUG_HANDLE, width=0.016, thickness=0.010)

    def lip(angle: Array, z: Array) -> Array:
        share = np.clip((z - 0.150) / (_JUG_HEIGHT - 0.150), 0.0, 1.0) ** 2
        return 1.0 + 0.075 * share * np.exp(-(((angle - np.pi) / 0.32) ** 2))

    def bands(angle: Array, z: Array) -> Cells:
        return np.where(z > 0.176, 2, np.where((z > 0.150) & (z < 0.158), 1, 0))

    heights = np.array([0.006, 0.05, 0.10, 0.150, 0.158, 0.166, 0.172, 0.176, 0.180])
    outside = np.column_stack([np.interp(heights, [0.0, _JUG_HEIGHT], outer), heights])
    inside = np.column_stack([np.interp(heights, [0.0, _JUG_HEIGHT], inner), heights])[::-1]
    top = np.array([[_JUG_RADIUS - 0.0010, _JUG_HEIGHT], [_JUG_RADIUS - 0.004, _JUG_HEIGHT]])
    visual = join(
        lathe([(0.0, 0.002), (0.040, 0.002), (0.042, 0.0), (0.0455, 0.0), tuple(outside[0])], _RIM),
        revolve(np.concatenate([outside, top, inside[:-1]]), [_ENAMEL, _STRIPE, _RIM], bands, segments=48, swell=lip),
        lathe([tuple(inside[-2]), (inner[0], 0.012), (0.036, 0.0075), (0.0, _JUG_FLOOR)], _ENAMEL),
        _handle(_JUG_HANDLE, 0.0062, _RIM),
    )
    return Model(visual, [floor, *wall, *handle], [hull_of([floor, *wall]), hull_of(handle)])


_CROCK_RADIUS, _CROCK_HEIGHT, _CROCK_WALL, _CROCK_FLOOR = 0.065, 0.17, 0.008, 0.008
_STAVES: tuple[Color, Color, Color] = ((222, 184, 126), (206, 164, 104), (232, 198, 144))
_HOOP: Color = (150, 104, 58)
_HOLLOW: Color = (180, 138, 88)


@asset_recipe("utensil_crock", display_name="utensil crock", mass=0.40, color=(110, 70, 30))
def utensil_crock() -> Model:
    """A bamboo crock, free within 55 mm of the axis and 162 mm deep, hollow in both levels of detail."""
    inner = _CROCK_RADIUS - _CROCK_WALL
    wall = ring([(inner, 0.0), (_CROCK_RADIUS, 0.0), (_CROCK_RADIUS, _CROCK_HEIGHT), (inner, _CROCK_HEIGHT)], _SIDES)
    floor = solid([(inner, 0.0), (inner, _CROCK_FLOOR)], _SIDES)

    def staves(angle: Array, z: Array) -> Cells:
        stave = np.floor(np.mod(angle, 2.0 * np.pi) / (2.0 * np.pi) * 18.0).astype(np.int64)
        hoop = ((z > 0.016) & (z < 0.026)) | ((z > 0.144) & (z < 0.154))
        return np.where(hoop, 3, (stave * 5 % 7) % 3)

    heights = np.array([0.0, 0.016, 0.026, 0.085, 0.144, 0.154, _CROCK_HEIGHT - 0.001])
    outside = np.column_stack([np.full(len(heights), _CROCK_RADIUS), heights])
    visual = join(
        lathe([(0.0, 0.0), (_CROCK_RADIUS, 0.0)], _HOLLOW),
        revolve(outside, [*_STAVES, _HOOP], staves, segments=54),
        lathe(
            [(_CROCK_RADIUS, _CROCK_HEIGHT - 0.001), (_CROCK_RADIUS - 0.001, _CROCK_HEIGHT), (inner, _CROCK_HEIGHT),
             (inner, _CROCK_FLOOR), (0.0, _CROCK_FLOOR)],
            [_STAVES[1], _STAVES[1], _HOLLOW, _HOLLOW],
            segments=54,
        ),
    )  # fmt: skip
    parts = [floor, *wall]
    return Model(visual, parts, parts)
