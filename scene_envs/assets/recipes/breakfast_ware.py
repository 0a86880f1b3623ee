"""A jug, a crock and cutlery."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import trimesh

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart, Model, asset_recipe
from scene_envs.assets.recipes.painted import Cells, revolve
from scene_envs.assets.shapes import (
    Color,
    arc,
    circle,
    convex_hull,
    fan,
    hull_of,
    join,
    lathe,
    loft,
    quad_faces,
    ring,
    rods,
    sheet,
    solid,
    surface,
    tube,
    walls,
)

_SIDES = 12
_JUG_FOOT, _JUG_RADIUS, _JUG_HEIGHT, _JUG_WALL, _JUG_FLOOR = 0.046, 0.0525, 0.182, 0.005, 0.007
_JUG_HANDLE = [(0.0514, 0.0, 0.145), (0.076, 0.0, 0.145), (0.089, 0.0, 0.102), (0.076, 0.0, 0.055),
               (0.0482, 0.0, 0.055)]  # fmt: skip
_ENAMEL: Color = (232, 238, 240)
_RIM: Color = (44, 82, 140)
_STRIPE: Color = (96, 140, 190)
_CROCK_RADIUS, _CROCK_HEIGHT, _CROCK_WALL, _CROCK_FLOOR = 0.065, 0.17, 0.008, 0.008
_STAVES: tuple[Color, Color, Color] = ((222, 184, 126), (206, 164, 104), (232, 198, 144))
_HOOP: Color = (150, 104, 58)
_HOLLOW: Color = (180, 138, 88)
# cutlery
_STEEL: Color = (196, 200, 207)
_BRIGHT: Color = (222, 226, 231)
_SHADE: Color = (168, 173, 182)
_THICK = 0.0034
"""Thickness of the metal, m; thinner metal would vanish when engines shrink hulls by 1 mm."""
Station = tuple[float, float, float, float]
"""(x, width, lowest z, highest z) of a section across the length, m."""


def _handle(path: Sequence[tuple[float, float, float]], radius: float, color: Color) -> trimesh.Trimesh:
    """A round handle along ``path``, whose ends reach 2 mm into the wall so that they do not show."""
    points = np.array(path)
    points[[0, -1], 0] -= 0.002
    low, high = points[:-1], points[1:]
    thirds = np.stack([(2.0 * low + high) / 3.0, (low + 2.0 * high) / 3.0], axis=1).reshape(-1, 3)
    knots = np.concatenate([points[:1], thirds[1:-1], points[-1:]])  # rounds the corners, does not run past them
    return tube(arc(knots.tolist(), 20), radius, color)


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


def _section(station: Station, y: float = 0.0) -> Array:
    x, width, low, high = station
    return np.array([[x, y + side * width, z] for side in (-0.5, 0.5) for z in (low, high)])


def _beam(stations: Sequence[Station], y: float = 0.0) -> list[ConvexPart]:
    """One part between each two neighbouring stations; they share their end faces."""
    return [convex_hull(np.concatenate([_section(a, y), _section(b, y)])) for a, b in pairwise(stations)]


def _grip(end: Station) -> list[Station]:
    """Stations that round the end of a handle off, seen from above."""
    x, width, low, high = end
    return [
        (x + along * width, across * width, low, high) for along, across in ((0.0, 0.45), (0.06, 0.72), (0.2, 0.94))
    ]


def _skin(stations: Sequence[Station], color: Color, y: float = 0.0, samples: int = 14) -> trimesh.Trimesh:
    """A rounded bar through the stations, y = 0 in its middle."""
    from scipy.interpolate import PchipInterpolator

    table = np.array(stations)
    x = np.unique([*np.linspace(table[0, 0], table[-1, 0], samples), *table[:, 0]])
    width, low, high = PchipInterpolator(table[:, 0], table[:, 1:])(x).T
    angles = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False) + np.pi / 12
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ring = np.sign(ring) * np.abs(ring) ** 0.6  # between an ellipse and a rectangle
    ring /= np.abs(ring).max(axis=0)
    sides = y + 0.5 * width[:, None] * ring[:, 0]
    heights = 0.5 * (low + high)[:, None] + 0.5 * (high - low)[:, None] * ring[:, 1]
    return loft(np.stack([np.broadcast_to(x[:, None], sides.shape), sides, heights], axis=-1), color)


@asset_recipe("fork", display_name="fork", mass=0.03, color=(92, 108, 132))
def fork() -> Model:
    """A fork with three tines, 0.19 m long."""
    end: Station = (-0.095, 0.017, 0.0, _THICK)
    waist: Station = (-0.035, 0.011, 0.0, _THICK)
    neck: Station = (0.030, 0.008, 0.012 - _THICK, 0.012)
    foot, root = (0.046, 0.025, 0.0, 0.0036), (0.058, 0.025, 0.0, 0.0036)
    tip = (0.095, 0.0036, 0.0028, 0.0062)
    handle, stem = _beam([end, waist, neck])
    head = convex_hull(np.concatenate([_section(neck), _section(foot), _section(root)]))
    rows = (-0.0102, 0.0, 0.0102)
    tines = [_beam([(root[0], 0.0046, 0.0, 0.0036), tip], y)[0] for y in rows]
    shoulder = (0.040, 0.020, 0.0035, 0.0078)
    visual = join(
        _skin([*_grip(end), (-0.07, 0.016, 0.0, _THICK), waist, (0.0, 0.008, 0.0042, 0.0076), neck], _STEEL),
        _skin([neck, shoulder, (0.047, 0.0248, 0.0006, 0.0042), root], _STEEL, samples=8),
        *(
            _skin([(root[0], 0.0046, 0.0, 0.0036), (0.078, 0.0042, 0.0004, 0.0036), tip], _BRIGHT, y, samples=5)
            for y in rows
        ),
    )
    return Model(visual, [handle, stem, head, *tines], [hull_of([handle, stem]), hull_of([head, *tines])])


@asset_recipe("knife", display_name="knife", plural="knives", mass=0.05, color=(58, 70, 92))
def knife() -> Model:
    """A table knife lying on its side, 0.22 m long; the edge of the blade faces -y."""
    end, bolster = (-0.110, 0.018, 0.0, 0.008), (-0.005, 0.014, 0.0, 0.0065)
    outline = np.array([(-0.005, -0.0068), (0.045, -0.0100), (0.080, -0.0098), (0.100, -0.0060), (0.110, 0.0035),
                        (0.108, 0.0085), (0.090, 0.0100), (-0.005, 0.0068)])  # fmt: skip
    handle = _beam([end, bolster])[0]
    blade = convex_hull([(x, y, z) for x, y in outline for z in (0.0, _THICK)])
    edge = _rounded(outline - np.array([[0.012, 0.0]]) * (outline[:, :1] < 0.0))  # starts inside the handle
    ground = edge + np.where(edge[:, 1:] < 0.0, [[0.0, 0.0028]], [[0.0, 0.0]])  # the bevel along the cutting edge
    low, high, flat = (
        np.column_stack([line, np.full(len(line), z)]) for line, z in ((edge, 0.0), (edge, 0.0012), (ground, 0.0024))
    )
    visual = join(
        _skin([*_grip(end), (-0.100, 0.0177, 0.0, 0.008), (-0.03, 0.0145, 0.0, 0.0072), bolster], _STEEL),
        _prism(low, high, _SHADE),
        _prism(high, flat, _BRIGHT),
    )
    return Model(visual, [handle, blade], [hull_of([handle, blade])])


def _prism(low: Array, high: Array, color: Color) -> trimesh.Trimesh:
    """A sharp-edged skin between two outlines (K, 3), counter-clockwise from above, with its lid."""
    sides = surface(walls(low, high).reshape(-1, 3), quad_faces(len(low)), color)
    return join(sides, sheet(high, color), surface(low, fan(len(low))[:, ::-1], color))


def _rounded(outline: Array, rounds: int = 2) -> Array:
    """A closed outline (K, 2) with its corners cut off ``rounds`` times (Chaikin); it stays inside the first one."""
    for _ in range(rounds):
        ahead = np.roll(outline, -1, axis=0)
        outline = np.stack([0.8 * outline + 0.2 * ahead, 0.2 * outline + 0.8 * ahead], axis=1).reshape(-1, 2)
    return outline


@asset_recipe("dinner_spoon", display_name="spoon", mass=0.035, color=(128, 150, 178))
def dinner_spoon() -> Model:
    """A table spoon, 0.19 m long."""
    return _spoon(0.19, 0.042, 0.015)


@asset_recipe("teaspoon", display_name="spoon", mass=0.02, color=(168, 190, 214))
def teaspoon() -> Model:
    """A small spoon, 0.155 m long."""
    return _spoon(0.155, 0.032, 0.013)


def _spoon(length: float, width: float, height: float) -> Model:
    """Handle, stem and a bowl that is filled for physics; all sizes in m."""
    half, reach, front = 0.5 * length, 0.34 * length, 0.60 * height
    end = (-half, 0.40 * width, 0.0, _THICK)
    waist = (-0.20 * length, 0.26 * width, 0.0, _THICK)
    neck = (half - reach, 0.18 * width, height - _THICK, height)
    handle, stem = _beam([end, waist, neck])
    center, size = half - 0.5 * reach, np.array([0.5 * reach, 0.5 * width])

    def at(outline: Array, scale: float, drop: float) -> Array:
        """Outline (K, 2) in the unit circle to (K, 3): ``drop`` 0 is the sloping rim, 1 the table."""
        flat = np.array([center, 0.0]) + scale * outline * size
        rim = height - (height - front) * (flat[:, 0] - (half - reach)) / reach
        return np.column_stack([flat, rim * (1.0 - drop)])

    bowl = convex_hull(np.concatenate([_section(neck), at(circle(12), 1.0, 0.0), at(circle(8), 0.45, 1.0)]))
    shell = ((0.45, 1.0), (0.70, 0.80), (0.88, 0.50), (0.97, 0.2), (1.0, 0.0))
    dish = ((0.94, 0.0), (0.86, 0.26), (0.66, 0.53), (0.4, 0.66), (0.05, 0.7))
    outside, inside = ([at(circle(24), scale, drop) for scale, drop in steps] for steps in (shell, dish))
    hold: Station = (-0.42 * length, 0.38 * width, 0.0, _THICK)
    arch: Station = (0.0, 0.19 * width, 0.3 * height, 0.3 * height + _THICK)
    rim: Station = (neck[0] + 0.004, 0.22 * width, height - _THICK, height)
    visual = join(
        _skin([*_grip(end), hold, waist, arch, neck, rim], _STEEL),
        loft(outside, _STEEL, caps=(True, False)),
        loft([outside[-1], inside[0]], _BRIGHT, caps=(False, False)),
        loft(inside, _SHADE, caps=(False, True)),
    )
    return Model(visual, [handle, stem, bowl], [hull_of([handle, stem]), bowl])
