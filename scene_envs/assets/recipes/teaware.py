"""Teapot and teacup."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.shapes import hull_of, ring, rods, solid
from scene_envs.assets.surfaces import Color, arc, join, lathe, tube

_PORCELAIN: Color = (248, 246, 241)
_INSIDE: Color = (226, 238, 232)
_COBALT: Color = (48, 84, 150)
_FOOT: Color = (206, 196, 180)

_CUP_RADIUS, _CUP_FOOT, _CUP_HEIGHT, _CUP_FLOOR, _CUP_WALL = 0.0425, 0.030, 0.07, 0.006, 0.005
_CUP_HANDLE = [(0.0385, 0.0, 0.056), (0.061, 0.0, 0.054), (0.061, 0.0, 0.030), (0.0345, 0.0, 0.022)]

_POT_BODY = [(0.052, 0.0), (0.075, 0.045), (0.066, 0.090), (0.036, 0.118)]
_POT_SPOUT = [(0.066, 0.0, 0.045), (0.083, 0.0, 0.070), (0.0945, 0.0, 0.108)]
_POT_HANDLE = [(-0.062, 0.0, 0.098), (-0.086, 0.0, 0.104), (-0.095, 0.0, 0.080), (-0.089, 0.0, 0.052),
               (-0.068, 0.0, 0.036)]  # fmt: skip


@asset_recipe("teacup", display_name="cup", mass=0.20, color=(168, 94, 196))
def teacup() -> Model:
    """An open cup with a handle toward +x."""
    outer, inner = (_CUP_FOOT, _CUP_RADIUS), (_CUP_FOOT - _CUP_WALL, _CUP_RADIUS - _CUP_WALL)
    floor = solid([(_CUP_FOOT, 0.0), (_CUP_FOOT, _CUP_FLOOR)], 10)
    wall = ring([(inner[0], _CUP_FLOOR), (outer[0], _CUP_FLOOR), (outer[1], _CUP_HEIGHT), (inner[1], _CUP_HEIGHT)], 10)
    handle = rods(_CUP_HANDLE, width=0.008, thickness=0.007)
    visual = join(
        lathe(
            [
                (0.0, 0.0), (0.028, 0.0), (0.029, 0.004), (0.0315, 0.012), (0.0355, 0.028), (0.0392, 0.048),
                (0.0401, 0.054), (0.0406, 0.0575), (0.0425, 0.0695), (0.0412, _CUP_HEIGHT), (0.0396, 0.0695),
                (0.0375, 0.055), (0.033, 0.03), (0.0275, 0.012), (0.02, 0.007), (0.0, _CUP_FLOOR),
            ],
            [_FOOT, _FOOT, *[_PORCELAIN] * 4, _COBALT, *[_PORCELAIN] * 3, *[_INSIDE] * 5],
            segments=36,
        ),
        tube(arc(_CUP_HANDLE), 0.0038, _PORCELAIN),
    )  # fmt: skip
    return Model(visual, [floor, *wall, *handle], [hull_of([floor, *wall, *handle])])


@asset_recipe("teapot", display_name="teapot", mass=0.70, color=(38, 166, 154))
def teapot() -> Model:
    """A round pot, spout toward +x, handle toward -x; all within 0.10 m of its axis."""
    body = [solid([low, high], 12) for low, high in pairwise(_POT_BODY)]
    spout = rods(_POT_SPOUT, width=0.014, thickness=0.010)
    handle = rods(_POT_HANDLE, width=0.010, thickness=0.008)
    knob = solid([(0.009, 0.118), (0.013, 0.128), (0.012, 0.14)], 12)
    visual = join(
        lathe(
            [
                (0.0, 0.0), (0.050, 0.0), (0.054, 0.006), (0.0655, 0.022), (0.0725, 0.036), (0.075, 0.049),
                (0.0742, 0.060), (0.0725, 0.070), (0.0700, 0.079), (0.0655, 0.089), (0.058, 0.099), (0.050, 0.106),
                (0.047, 0.1075), (0.044, 0.1105), (0.030, 0.1165), (0.009, 0.119), (0.008, 0.122), (0.0105, 0.126),
                (0.013, 0.131), (0.0115, 0.137), (0.006, 0.1396), (0.0, 0.14),
            ],
            [
                _FOOT, _FOOT, *[_PORCELAIN] * 4, _COBALT, _PORCELAIN, _COBALT, *[_PORCELAIN] * 3, _COBALT,
                *[_PORCELAIN] * 3, *[_COBALT] * 5,
            ],
        ),
        tube(arc([(0.060, 0.0, 0.040), *_POT_SPOUT], 12), np.linspace(0.011, 0.0055, 12), _PORCELAIN),
        tube(arc(_POT_HANDLE), 0.0048, _PORCELAIN),
    )  # fmt: skip
    return Model(visual, [*body, *spout, *handle, knob], [hull_of(body), hull_of(spout), hull_of(handle), knob])
