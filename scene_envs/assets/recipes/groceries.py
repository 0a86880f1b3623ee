"""Cereal box and toast."""

from __future__ import annotations

import numpy as np
import trimesh

from scene_envs.arrays import Array
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.recipes.painted import loft, sheet
from scene_envs.assets.shapes import box, circle, convex_hull
from scene_envs.assets.surfaces import Color, join

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


_CRUST: Color = (150, 92, 44)
_TOASTED: Color = (196, 138, 72)
_CRUMB: Color = (232, 196, 134)
_SLICE = 0.016


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
