"""Food and drinks: apples, pears and avocados, which are solids of revolution on a flat foot, cereal, bread, a can and
a bottle.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import trimesh

from scene_envs.arrays import Array
from scene_envs.assets.base import Model, asset_recipe
from scene_envs.assets.recipes.painted import Cells, Paint, curve, loft, revolve, sleeve
from scene_envs.assets.shapes import Color, Profile, box, circle, convex_hull, hull_of, join, lathe, sheet, solid, tube

_SIDES = 12
_STEM: Color = (96, 66, 38)
_CALYX: Color = (84, 70, 44)

# Half sections of the visual meshes in radii and heights of the fruit, from the blossom end up to the stem.
_ROUND = [(0.0, 0.07), (0.16, 0.045), (0.34, 0.0), (0.60, 0.045), (0.90, 0.28), (1.0, 0.53), (0.955, 0.75),
          (0.80, 0.92), (0.56, 1.0), (0.32, 0.97), (0.12, 0.88), (0.0, 0.83)]  # fmt: skip
_CONICAL = [(0.0, 0.08), (0.14, 0.05), (0.30, 0.0), (0.52, 0.05), (0.80, 0.30), (0.98, 0.58), (0.985, 0.75),
            (0.84, 0.93), (0.58, 1.0), (0.33, 0.96), (0.12, 0.86), (0.0, 0.81)]  # fmt: skip
_APPLE_HULL = [(0.48, 0.0), (0.96, 0.33), (1.0, 0.65), (0.68, 1.0)]
_CONICAL_HULL = [(0.46, 0.0), (0.90, 0.38), (1.0, 0.74), (0.70, 1.0)]
_AVOCADO = [(0.0, 0.02), (0.20, 0.005), (0.36, 0.0), (0.66, 0.04), (0.93, 0.21), (1.0, 0.38), (0.945, 0.53),
            (0.80, 0.70), (0.62, 0.85), (0.42, 0.955), (0.18, 1.0), (0.0, 0.985)]  # fmt: skip
_AVOCADO_HULL = [(0.46, 0.0), (0.94, 0.19), (1.0, 0.42), (0.82, 0.70), (0.40, 1.0)]
_LONG, _SHORT, _NARROW = (0.60, 0.36, 0.64), (0.68, 0.46, 0.70), (0.56, 0.38, 0.68)
"""Necks of pears: radius at the start, radius near the top and height of the start, as shares of the fruit's."""
# the cereal box, m
_WIDTH, _DEPTH, _HEIGHT = 0.19, 0.06, 0.28
_PRINT = 4e-4
"""Distance (m) of the print in front of the board."""
_BOARD: Color = (238, 160, 44)
_FLAP: Color = (222, 140, 34)
_BRAND: Color = (160, 34, 44)
_CREAM: Color = (252, 244, 222)
_BOWL: Color = (62, 116, 182)
_MILK: Color = (250, 248, 242)
_OAT: Color = (206, 146, 76)
_HOLE: Color = (240, 228, 204)
_RINGS = ((-0.036, 0.0), (-0.019, 0.009), (-0.014, -0.007), (0.004, 0.002), (0.018, 0.010), (0.022, -0.006),
          (0.040, 0.001))  # fmt: skip
"""Positions (m, from the middle of the bowl) of the cereal in the picture on the box."""
_LETTERS = {
    "O": ("###", "#.#", "#.#", "#.#", "###"),
    "A": ("###", "#.#", "###", "#.#", "#.#"),
    "T": ("###", ".#.", ".#.", ".#.", ".#."),
    "S": ("###", "#..", "###", "..#", "###"),
}
# the bread slice
_CRUST: Color = (150, 92, 44)
_TOASTED: Color = (196, 138, 72)
_CRUMB: Color = (232, 196, 134)
_SLICE = 0.016
# the can and the bottle, m
_SILVER: Color = (196, 199, 204)
_BRUSHED: Color = (172, 176, 182)
_SHADE: Color = (140, 144, 150)
_COLA: Color = (206, 28, 36)
_WAVE: Color = (250, 248, 244)
_CAN_RADIUS, _CAN_HEIGHT = 0.0334, 0.122
_TEA: Color = (176, 108, 44)
_GLASS: Color = (196, 132, 60)
_LABEL: Color = (64, 128, 70)
_PALE: Color = (236, 240, 216)
_CAP: Color = (46, 92, 58)
_LABEL_RADIUS = 0.0325
_BODY = [(0.0325, 0.0), (0.0325, 0.140), (0.015, 0.176)]
_NECK = [(0.015, 0.176), (0.015, 0.208)]


def _scaled(profile: Profile, radius: float, height: float) -> list[tuple[float, float]]:
    return [(radius * r, height * z) for r, z in profile]


def _stem(height: float, start: float, tip: float, lean: float, thickness: float) -> trimesh.Trimesh:
    """A stem from ``start`` to ``tip`` (fractions of the height), leaning ``lean`` m toward +x."""
    path = [(0.0, 0.0, start * height), (0.3 * lean, 0.0, 0.5 * (start + tip) * height), (lean, 0.0, tip * height)]
    return tube(path, [0.9 * thickness, 0.8 * thickness, 1.2 * thickness], _STEM, sides=6)


def _tones(first: Color, last: Color) -> list[Color]:
    """Five colours from ``first`` to ``last`` in even steps."""
    mixed = np.linspace(first, last, 5).round().astype(int)
    return [(int(r), int(g), int(b)) for r, g, b in mixed]


def _cheek(spread: float) -> Paint:
    """Paint in streaks, from the ground colour on the shaded side (0) to the cheek on the sunny side (4)."""

    def paint(angle: Array, z: Array) -> Cells:
        streaks = 0.35 * np.cos(5.0 * angle + 1.0) * np.cos(13.0 * angle)
        return np.clip(np.floor(2.5 * (np.cos(angle + 0.5) + streaks + spread)) + 1 + 0.0 * z, 0, 4).astype(np.int64)

    return paint


def _ripe(height: float) -> Paint:
    """Paint from the colour at the blossom end (0) to the colour at the stem (4)."""
    return lambda angle, z: np.clip(np.floor(5.0 * (z / height) + 0.0 * angle), 0, 4).astype(np.int64)


def _pebbled(height: float) -> Paint:
    """As :func:`_ripe`, with each cell shifted at random by at most one tone."""

    def paint(angle: Array, z: Array) -> Cells:
        turns = np.random.default_rng(7).integers(-1, 2, np.broadcast_shapes(angle.shape, z.shape))
        return np.clip(_ripe(height)(angle, z) + turns, 0, 4)

    return paint


def _apple(diameter: float, height: float, low: Color, high: Color, paint: Paint, conical: bool = False) -> Model:
    """An apple, round or with five lobes at a narrow lower end."""
    radius = diameter / 2.0
    part = solid(_scaled(_CONICAL_HULL if conical else _APPLE_HULL, radius, height), _SIDES)

    def lobes(angle: Array, z: Array) -> Array:
        share = z / height
        return 1.0 - (0.045 if conical else 0.015) * (1.0 - np.cos(5.0 * angle)) * np.abs(share - 0.5)

    def with_calyx(angle: Array, z: Array) -> Cells:
        return np.where(np.arange(len(z))[:, None] == 0, 3, paint(angle, z))

    profile = curve(_scaled(_CONICAL if conical else _ROUND, radius, height))
    body = revolve(profile, [*_tones(low, high), _CALYX], with_calyx, swell=lobes)
    return Model(join(body, _stem(height, 0.80, 1.04, 0.003, 0.0013)), [part], [part])


def _pear(
    diameter: float, height: float, low: Color, high: Color, paint: Paint, neck: tuple[float, float, float]
) -> Model:
    radius = diameter / 2.0
    begin, end, waist = neck
    belly = 0.58 * waist
    lower = solid(
        _scaled([(0.48, 0.0), (0.95, 0.55 * belly), (1.0, 1.1 * belly), (begin, waist)], radius, height), _SIDES
    )
    upper = solid(_scaled([(begin, waist), (end, 0.93), (0.55 * end, 1.0)], radius, height), _SIDES)
    section = [
        (0.0, 0.035), (0.14, 0.025), (0.32, 0.0), (0.62, 0.10 * belly), (0.93, 0.55 * belly), (1.0, belly),
        (0.5 + 0.5 * begin, 0.5 * (belly + waist) + 0.03), (begin, waist + 0.02), (end * 1.06, 0.89),
        (0.72 * end, 0.975), (0.30 * end, 1.0), (0.0, 0.985),
    ]  # fmt: skip
    body = revolve(curve(_scaled(section, radius, height), 28), _tones(low, high), paint)
    visual = join(body, _stem(height, 0.97, 1.028, 0.003, 0.0016))
    return Model(visual, [lower, upper], [hull_of([lower, upper])])


def _avocado(diameter: float, height: float, low: Color, high: Color, paint: Paint, bumps: float) -> Model:
    part = solid(_scaled(_AVOCADO_HULL, diameter / 2.0, height), _SIDES)

    def pebbles(angle: Array, z: Array) -> Array:
        return 1.0 - bumps * (0.5 + 0.5 * np.cos(11.0 * angle + 400.0 * z) * np.cos(7.0 * angle - 900.0 * z))

    profile = curve(_scaled(_AVOCADO, diameter / 2.0, height), 26)
    body = revolve(profile, _tones(low, high), paint, segments=36, swell=pebbles)
    return Model(join(body, _stem(height, 0.97, 1.012, 0.0, 0.0028)), [part], [part])


_FRUIT: tuple[tuple[str, float, Color, Callable[..., Model], tuple[Any, ...]], ...] = (
    ("apple_gala", 0.15, (236, 30, 70), _apple, (0.066, 0.062, (232, 190, 92), (196, 54, 46), _cheek(1.0))),
    ("apple_golden", 0.17, (250, 215, 60), _apple, (0.070, 0.068, (238, 212, 94), (216, 204, 84), _ripe(0.068))),
    ("apple_green", 0.19, (140, 230, 40), _apple, (0.075, 0.070, (162, 204, 82), (130, 182, 56), _ripe(0.070))),
    ("apple_red", 0.21, (150, 10, 30), _apple, (0.080, 0.080, (170, 58, 46), (126, 18, 32), _cheek(0.9), True)),
    ("pear_bosc", 0.19, (170, 130, 20), _pear, (0.070, 0.100, (160, 112, 54), (194, 152, 84), _ripe(0.100), _LONG)),
    ("pear_anjou", 0.19, (190, 210, 110), _pear, (0.068, 0.090, (196, 208, 104), (162, 184, 76), _ripe(0.090), _SHORT)),
    ("pear_red", 0.20, (190, 40, 110), _pear, (0.075, 0.085, (206, 112, 66), (150, 30, 44), _cheek(0.8), _NARROW)),
    ("avocado_a", 0.22, (20, 110, 60), _avocado, (0.065, 0.100, (74, 100, 42), (104, 130, 62), _ripe(0.100), 0.01)),
    ("avocado_b", 0.20, (40, 60, 30), _avocado, (0.060, 0.095, (54, 50, 42), (74, 78, 52), _pebbled(0.095), 0.04)),
    ("avocado_c", 0.33, (90, 140, 30), _avocado, (0.082, 0.120, (104, 140, 52), (146, 172, 84), _ripe(0.120), 0.01)),
)
"""Name, mass (kg) and class colour; shape, diameter and height (m), colours at the ends, their pattern, and details."""

for _name, _mass, _color, _shape, _details in _FRUIT:
    asset_recipe(_name, display_name=_name.partition("_")[0], mass=_mass, color=_color)(partial(_shape, *_details))


@asset_recipe("cereal_box", display_name="cereal box", plural="cereal boxes", mass=0.45, color=(245, 135, 25))
def cereal_box() -> Model:
    """A standing carton; its printed faces look along -y and +y."""
    part = box((_WIDTH, _DEPTH, _HEIGHT))
    x, y = _WIDTH / 2.0, _DEPTH / 2.0
    base = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    top = base + np.array([0.0, 0.0, _HEIGHT])
    sides = [sheet([base[i], base[j], top[j], top[i]], _BOARD) for i, j in ((0, 1), (1, 2), (2, 3), (3, 0))]
    visual = join(sheet(base[::-1], _FLAP), *sides, sheet(top, _FLAP), *_front(1.0), *_front(-1.0), *_sides())
    return Model(visual, [part], [part])


def _front(turn: float) -> list[trimesh.Trimesh]:
    """The print of one large face; ``turn`` 1 for the face toward -y, -1 for +y."""

    def at(points: Array, layer: int) -> Array:
        across = np.full(len(points), _DEPTH / 2.0 + layer * _PRINT)
        return np.column_stack([turn * points[:, 0], -turn * across, points[:, 1]])

    def disc(x: float, z: float, radius: float, sides: int = 28, squash: float = 1.0) -> Array:
        return np.array([x, z]) + radius * circle(sides) * [1.0, squash]

    def bar(left: float, low: float, right: float, high: float) -> Array:
        return np.array([[left, low], [right, low], [right, high], [left, high]])

    half = _WIDTH / 2.0
    print_ = [
        sheet(at(bar(-half, 0.195, half, 0.262), 1), _BRAND),
        sheet(at(bar(-half, 0.188, half, 0.195), 1), _CREAM),
        sheet(at(disc(0.0, 0.092, 0.078), 1), _CREAM),
    ]
    bowl = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(np.pi, 2.0 * np.pi, 20)])
    print_.append(sheet(at(np.array([0.0, 0.088]) + bowl * [0.060, 0.052], 2), _BOWL))
    print_.append(sheet(at(disc(0.0, 0.088, 0.060, squash=0.30), 3), _MILK))
    for x, z in _RINGS:
        print_.append(sheet(at(disc(x, 0.089 + z, 0.0085, 12, 0.7), 4), _OAT))
        print_.append(sheet(at(disc(x, 0.089 + z, 0.0034, 10, 0.7), 5), _HOLE))
    pixel, left = 0.0088, -0.066
    for index, letter in enumerate("OATS"):
        for row, line in enumerate(_LETTERS[letter]):
            for column, mark in enumerate(line):
                if mark == "#":
                    corner = left + pixel * (4 * index + column), 0.2505 - pixel * (row + 1)
                    print_.append(sheet(at(bar(*corner, corner[0] + pixel, corner[1] + pixel), 2), _CREAM))
    return print_


def _sides() -> list[trimesh.Trimesh]:
    """A red band and a white panel on the narrow faces."""
    printed = []
    for sign in (-1.0, 1.0):
        x = sign * (_WIDTH / 2.0 + _PRINT)
        for low, high, width, color in ((0.195, 0.262, _DEPTH, _BRAND), (0.188, 0.195, _DEPTH, _CREAM),
                                        (0.03, 0.165, 0.7 * _DEPTH, _CREAM)):  # fmt: skip
            y = sign * width / 2.0
            printed.append(sheet([(x, -y, low), (x, y, low), (x, y, high), (x, -y, high)], color))
    return printed


@asset_recipe("bread_slice", display_name="bread slice", mass=0.03, color=(190, 115, 55))
def bread_slice() -> Model:
    """A slice of toast; slices stack every 16 mm."""
    outline = _rounded_square(0.104, 0.100, 0.022, 4)
    part = convex_hull(np.concatenate([_at(outline, 0.0), _at(outline, _SLICE)]))
    wide = [
        _rounded_square(0.104 - 2 * inset, 0.100 - 2 * inset, 0.022 - 0.5 * inset, 8) for inset in (0.0, 0.002, 0.009)
    ]
    loops = [_at(wide[2], 0.0), _at(wide[1], 0.0), _at(wide[0], 0.003), _at(wide[0], _SLICE - 0.003),
             _at(wide[1], _SLICE), _at(wide[2], _SLICE)]  # fmt: skip
    visual = loft(loops, [_CRUMB, _TOASTED, _CRUST, _CRUST, _CRUST, _TOASTED, _CRUMB])
    return Model(visual, [part], [part])


def _rounded_square(width: float, depth: float, radius: float, points: int) -> Array:
    """(4 * points, 2): a rectangle with round corners, counter-clockwise."""
    angles = np.linspace(0.0, 0.5 * np.pi, points)
    corners = []
    for quarter, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        turned = angles + quarter * 0.5 * np.pi
        center = np.array([x * (width / 2.0 - radius), y * (depth / 2.0 - radius)])
        corners.append(center + radius * np.column_stack([np.cos(turned), np.sin(turned)]))
    return np.concatenate(corners)


def _at(outline: Array, z: float) -> Array:
    return np.column_stack([outline, np.full(len(outline), z)])


@asset_recipe("soda_can", display_name="coke can", mass=0.37, color=(255, 0, 0))
def soda_can() -> Model:
    """A red can with a white wave."""
    part = solid([(_CAN_RADIUS, 0.0), (_CAN_RADIUS, _CAN_HEIGHT)], 16)
    low, high, segments = 0.008, 0.110, 48
    angle = 2.0 * np.pi * np.arange(segments) / segments
    wave = 0.058 + 0.017 * np.sin(angle) + 0.004 * np.sin(2.0 * angle)
    half = 0.0075 + 0.003 * np.cos(angle + 0.4)
    levels = np.stack([np.full(segments, low), wave - half, wave + half, wave + half + 0.003, wave + half + 0.0055,
                       np.full(segments, high)])  # fmt: skip
    visual = join(
        lathe([(0.0, 0.006), (0.021, 0.0035), (0.0245, 0.0), (0.0265, 0.0), (_CAN_RADIUS, low)], _SILVER),
        sleeve(_CAN_RADIUS, levels, [_COLA, _WAVE, _COLA, _WAVE, _COLA]),
        lathe(
            [(_CAN_RADIUS, high), (0.0278, 0.1195), (0.0278, _CAN_HEIGHT), (0.0262, _CAN_HEIGHT), (0.0252, 0.1185),
             (0.0, 0.1185)],
            [_SILVER, _SILVER, _SILVER, _BRUSHED, _BRUSHED],
        ),
        _lid(0.1189),
    )  # fmt: skip
    return Model(visual, [part], [part])


def _lid(z: float) -> trimesh.Trimesh:
    """The mouth and the ring of a can, lying on its lid."""

    def at(outline: Array, height: float, color: Color) -> trimesh.Trimesh:
        return sheet(np.column_stack([outline, np.full(len(outline), z + height)]), color)

    mouth = circle(16) * [0.0075, 0.0085] - [0.0125, 0.0]
    ring = circle(20) * [0.0115, 0.0075] + [0.006, 0.0]
    hole = circle(16) * [0.0042, 0.0045] + [0.011, 0.0]
    return join(at(mouth, 0.0, _SHADE), at(ring, 0.0012, _SILVER), at(hole, 0.0016, _SHADE))


@asset_recipe("tea_bottle", display_name="tea bottle", mass=0.53, color=(10, 70, 110))
def tea_bottle() -> Model:
    """A bottle of tea with a green label and cap."""
    body, neck = solid(_BODY, 12), solid(_NECK, 12)
    glass = lathe(
        [
            (0.0, 0.004), (0.024, 0.002), (0.028, 0.0), (0.0315, 0.004), (0.0320, 0.012), (0.0320, 0.040),
            (_LABEL_RADIUS, 0.041), (_LABEL_RADIUS, 0.052), (_LABEL_RADIUS, 0.054),
        ],
        [*[_TEA] * 5, _LABEL, _LABEL, _LABEL],
    )  # fmt: skip
    shoulder = lathe(
        [
            (_LABEL_RADIUS, 0.106), (_LABEL_RADIUS, 0.108), (_LABEL_RADIUS, 0.119), (0.0320, 0.120), (0.0320, 0.134),
            (0.0300, 0.145), (0.0250, 0.158), (0.0185, 0.170), (0.0150, 0.178), (0.0130, 0.184), (0.0130, 0.188),
            (0.0148, 0.189), (0.0148, 0.206), (0.0135, 0.208), (0.0, 0.208),
        ],
        [_LABEL, _LABEL, _LABEL, _TEA, *[_TEA] * 2, *[_GLASS] * 5, *[_CAP] * 3],
    )  # fmt: skip
    angle = 2.0 * np.pi * np.arange(48) / 48
    leaf = 0.015 * np.clip(np.cos(2.0 * angle + 2.2), 0.0, None)  # two leaves, on opposite sides
    middle = 0.080 + 0.006 * np.sin(2.0 * angle + 2.2)
    levels = [np.full(48, 0.054), middle - leaf, middle, middle + leaf, np.full(48, 0.106)]
    label = sleeve(_LABEL_RADIUS, levels, [_PALE, _LABEL, _CAP, _PALE])
    return Model(join(glass, label, shoulder), [body, neck], [body, neck])
