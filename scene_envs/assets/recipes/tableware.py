"""Plates, bowls, a can, a bottle, steamers, a teacup and a teapot."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import trimesh

from scene_envs.arrays import Array
from scene_envs.assets.base import Model, asset_recipe
from scene_envs.assets.recipes.painted import sleeve
from scene_envs.assets.shapes import (
    Color,
    Profile,
    arc,
    box,
    circle,
    hull_of,
    join,
    lathe,
    planks,
    ring,
    rods,
    sheet,
    solid,
    tube,
)

_PORCELAIN: Color = (245, 243, 238)
_GLAZE: Color = (252, 251, 247)
_RUBY: Color = (164, 40, 52)
_SLATE: Color = (74, 104, 118)
_SHALLOW: Color = (222, 232, 232)
_SIDES = 12
_SILVER: Color = (196, 199, 204)
_BRUSHED: Color = (172, 176, 182)
_SHADE: Color = (140, 144, 150)
_COLA: Color = (206, 28, 36)
_WAVE: Color = (250, 248, 244)
_CAN_RADIUS, _CAN_HEIGHT = 0.0334, 0.122
_TEA: Color = (176, 108, 44)
_GLASS: Color = (196, 132, 60)
_LABEL: Color = (64, 128, 70)
_CREAM: Color = (236, 240, 216)
_CAP: Color = (46, 92, 58)
_LABEL_RADIUS = 0.0325
_BODY = [(0.0325, 0.0), (0.0325, 0.140), (0.015, 0.176)]
_NECK = [(0.015, 0.176), (0.015, 0.208)]
# the steamer and its lid, m
_RADIUS, _HEIGHT, _WALL = 0.12, 0.091, 0.009
_FLOOR = (0.008, 0.014)
_LID_HEIGHT, _LID_RIM, _LID_TOP, _LID_WALL = 0.06, 0.018, 0.042, 0.012
_BAMBOO: Color = (238, 203, 152)
_BAND: Color = (203, 153, 96)
_INNER: Color = (242, 213, 168)
_SLATS: tuple[Color, Color] = ((240, 208, 158), (222, 183, 128))
_TEA_PORCELAIN: Color = (248, 246, 241)
_INSIDE: Color = (226, 238, 232)
_COBALT: Color = (48, 84, 150)
_FOOT: Color = (206, 196, 180)
_CUP_RADIUS, _CUP_FOOT, _CUP_HEIGHT, _CUP_FLOOR, _CUP_WALL = 0.0425, 0.030, 0.07, 0.006, 0.005
_CUP_HANDLE = [(0.0385, 0.0, 0.056), (0.061, 0.0, 0.054), (0.061, 0.0, 0.030), (0.0345, 0.0, 0.022)]
_POT_BODY = [(0.052, 0.0), (0.075, 0.045), (0.066, 0.090), (0.036, 0.118)]
_POT_SPOUT = [(0.066, 0.0, 0.045), (0.083, 0.0, 0.070), (0.0945, 0.0, 0.108)]
_POT_HANDLE = [(-0.062, 0.0, 0.098), (-0.086, 0.0, 0.104), (-0.095, 0.0, 0.080), (-0.089, 0.0, 0.052),
               (-0.068, 0.0, 0.036)]  # fmt: skip


@asset_recipe("dinner_plate", display_name="plate", mass=0.60, color=(214, 74, 66))
def dinner_plate() -> Model:
    """A round plate, 0.27 m across, with a ruby ring."""
    foot, radius, height, thick = 0.09, 0.135, 0.022, 0.006
    base = solid([(foot, 0.0), (foot, thick)], 16)
    rim = ring([(foot, 0.0), (foot, thick), (radius, height), (radius, height - thick)], 16)
    visual = lathe(
        [
            (0.0, 0.0), (foot, 0.0), (0.110, 0.0072), (0.1342, 0.0172), (radius, 0.019), (0.1345, height),
            (0.1315, 0.0212), (0.1235, 0.0178), (0.108, 0.0118), (0.094, 0.0072), (0.086, thick), (0.0, thick),
        ],
        [*[_PORCELAIN] * 4, _RUBY, _RUBY, _RUBY, _GLAZE, _GLAZE, _PORCELAIN, _GLAZE],
        segments=64,
    )  # fmt: skip
    return Model(visual, [base, *rim], [hull_of([base, *rim])])


@asset_recipe("serving_dish", display_name="plate", mass=0.70, color=(66, 126, 196))
def serving_dish() -> Model:
    """A square dish, 0.27 m wide, with four sloping rims."""
    side, foot, height, thick = 0.27, 0.19, 0.02, 0.006
    corner, quarter = math.sqrt(0.5), math.pi / 4.0
    base = box((foot, foot, thick))
    rim = ring(
        [(foot * corner, 0.0), (foot * corner, thick), (side * corner, height), (side * corner, height - thick)],
        4,
        phase=quarter,
    )
    section = [(0.0, 0.0), (foot, 0.0), (side, height - thick), (side, height), (side - 0.012, height - 0.0021),
               (foot, thick), (0.0, thick)]  # fmt: skip
    visual = lathe(
        [(width * corner, z) for width, z in section],
        [_SLATE, _SLATE, _SLATE, _SLATE, _SHALLOW, _SHALLOW],
        segments=4,
        phase=quarter,
        flat=True,
    )
    return Model(join(visual), [base, *rim], [hull_of([base, *rim])])


def _bowl(
    foot: float,
    outer: tuple[float, float],
    inner: tuple[float, float],
    rim: tuple[float, float],
    profile: Profile,
    colors: list[Color],
) -> Model:
    """A bowl (m) of a floor disc and two bands of wedges that meet at ``outer`` and ``inner``, both (r, z)."""
    low = [(foot, 0.0), outer, inner, (foot, 0.006)]
    high = [outer, rim, (rim[0] - 0.005, rim[1]), inner]
    floor = solid([(foot, 0.0), (foot, 0.006)], _SIDES)
    parts = [floor, *ring(low, _SIDES), *ring(high, _SIDES)]
    return Model(lathe(profile, colors, segments=56), parts, parts)


@asset_recipe("bowl", display_name="bowl", mass=0.33, color=(120, 190, 255))
def bowl() -> Model:
    """A cereal bowl; its floor is flat within 34 mm of the axis, 6 mm above the table."""
    blue: Color = (112, 150, 176)
    inside: Color = (240, 240, 234)
    return _bowl(
        0.036, (0.0605, 0.027), (0.0555, 0.029), (0.0725, 0.065),
        [
            (0.0, 0.003), (0.029, 0.003), (0.031, 0.0), (0.035, 0.0), (0.036, 0.0025), (0.0455, 0.0095),
            (0.0540, 0.0175), (0.0605, 0.0270), (0.0655, 0.0390), (0.0692, 0.0510), (0.0722, 0.0632),
            (0.0712, 0.0650), (0.0690, 0.0645), (0.0660, 0.0530), (0.0618, 0.0410), (0.0560, 0.0290), (0.0480, 0.0170),
            (0.0400, 0.0090), (0.0340, 0.0062), (0.0, 0.006),
        ],
        [*[blue] * 10, *[inside] * 9],
    )  # fmt: skip


@asset_recipe("fruit_bowl", display_name="bowl", mass=0.55, color=(60, 205, 205))
def fruit_bowl() -> Model:
    """A wide wooden bowl; its floor is flat within 50 mm of the axis, 6 mm above the table."""
    wood: Color = (168, 112, 64)
    dark: Color = (140, 88, 48)
    grain: Color = (184, 130, 80)
    return _bowl(
        0.052, (0.091, 0.033), (0.086, 0.036), (0.110, 0.075),
        [
            (0.0, 0.003), (0.045, 0.003), (0.047, 0.0), (0.051, 0.0), (0.052, 0.0025), (0.0690, 0.0130),
            (0.0815, 0.0230), (0.0910, 0.0335), (0.0985, 0.0460), (0.1045, 0.0590), (0.1095, 0.0730), (0.1085, 0.0750),
            (0.1062, 0.0745), (0.1010, 0.0610), (0.0945, 0.0480), (0.0860, 0.0360), (0.0740, 0.0230), (0.0620, 0.0125),
            (0.0500, 0.0064), (0.0, 0.006),
        ],
        [*[dark] * 4, wood, wood, wood, grain, wood, wood, dark, dark, grain, wood, grain, wood, grain, wood, grain],
    )  # fmt: skip


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
    label = sleeve(_LABEL_RADIUS, levels, [_CREAM, _LABEL, _CAP, _CREAM])
    return Model(join(glass, label, shoulder), [body, neck], [body, neck])


@asset_recipe("steamer_bottom", display_name="steamer bottom", mass=0.35, color=(224, 172, 88))
def steamer_bottom() -> Model:
    """An open basket; another bottom or a lid rests on its rim at z = 0.091."""
    inner = _RADIUS - _WALL
    wall = ring([(inner, 0.0), (_RADIUS, 0.0), (_RADIUS, _HEIGHT), (inner, _HEIGHT)], 16)
    floor = solid([(inner, _FLOOR[0]), (inner, _FLOOR[1])], 16)
    low, high, inset = 0.016, _HEIGHT - 0.016, _RADIUS - 0.002
    basket = lathe(
        [
            (inner, 0.0), (_RADIUS, 0.0), (_RADIUS, low), (inset, low), (inset, high), (_RADIUS, high),
            (_RADIUS, _HEIGHT), (inner, _HEIGHT), (inner, _FLOOR[1]),
        ],
        [_BAND, _BAND, _BAND, _BAMBOO, _BAND, _BAND, _BAND, _INNER],
    )  # fmt: skip
    underside = lathe([(0.0, _FLOOR[0]), (inner, _FLOOR[0]), (inner, 0.0)], [_SLATS[1], _INNER])
    slats = planks(inner, _FLOOR[1] + 0.001, _SLATS, count=15, rows=6, columns=2)
    return Model(join(basket, underside, slats), [*wall, floor], [hull_of(wall)])


@asset_recipe("steamer_lid", display_name="steamer lid", mass=0.22, color=(120, 176, 84))
def steamer_lid() -> Model:
    """A shallow lid whose flat rim rests on a steamer bottom."""
    inner, shoulder = _RADIUS - _LID_WALL, 0.085
    rim = ring([(inner, 0.0), (_RADIUS, 0.0), (_RADIUS, _LID_RIM), (inner, _LID_RIM)], 12)
    cap = solid([(_RADIUS, _LID_RIM), (shoulder, _LID_TOP)], 12)
    knob = solid([(0.016, _LID_TOP), (0.018, _LID_HEIGHT)], 12)
    inset = _RADIUS - 0.002
    weave = [(inset, _LID_RIM), (0.105, 0.029), (shoulder, 0.0385), (0.062, 0.041), (0.038, 0.0418), (0.014, _LID_TOP)]
    visual = join(
        lathe(
            [(inner, 0.0), (_RADIUS, 0.0), (_RADIUS, _LID_RIM), *weave],
            [_BAND, _BAND, _BAND, _BAMBOO, _SLATS[1], _BAMBOO, _SLATS[1], _BAMBOO],
        ),
        lathe([(0.0, _LID_RIM), (inner, _LID_RIM), (inner, 0.0)], _INNER),
        lathe(
            [(0.014, _LID_TOP), (0.016, 0.05), (0.018, 0.055), (0.016, _LID_HEIGHT - 0.001), (0.0, _LID_HEIGHT)],
            _BAND,
            segments=24,
        ),
    )
    return Model(visual, [*rim, cap, knob], [hull_of([*rim, cap]), knob])


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
            [_FOOT, _FOOT, *[_TEA_PORCELAIN] * 4, _COBALT, *[_TEA_PORCELAIN] * 3, *[_INSIDE] * 5],
            segments=36,
        ),
        tube(arc(_CUP_HANDLE), 0.0038, _TEA_PORCELAIN),
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
                _FOOT, _FOOT, *[_TEA_PORCELAIN] * 4, _COBALT, _TEA_PORCELAIN, _COBALT, *[_TEA_PORCELAIN] * 3, _COBALT,
                *[_TEA_PORCELAIN] * 3, *[_COBALT] * 5,
            ],
        ),
        tube(arc([(0.060, 0.0, 0.040), *_POT_SPOUT], 12), np.linspace(0.011, 0.0055, 12), _TEA_PORCELAIN),
        tube(arc(_POT_HANDLE), 0.0048, _TEA_PORCELAIN),
    )  # fmt: skip
    return Model(visual, [*body, *spout, *handle, knob], [hull_of(body), hull_of(spout), hull_of(handle), knob])
