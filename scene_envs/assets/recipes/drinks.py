"""Drinks in cans and bottles."""

from __future__ import annotations

import numpy as np
import trimesh

from scene_envs.arrays import Array
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.recipes.painted import sheet, sleeve
from scene_envs.assets.shapes import circle, solid
from scene_envs.assets.surfaces import Color, join, lathe

_SILVER: Color = (196, 199, 204)
_BRUSHED: Color = (172, 176, 182)
_SHADE: Color = (140, 144, 150)
_COLA: Color = (206, 28, 36)
_WAVE: Color = (250, 248, 244)

_CAN_RADIUS, _CAN_HEIGHT = 0.0334, 0.122


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


_TEA: Color = (176, 108, 44)
_GLASS: Color = (196, 132, 60)
_LABEL: Color = (64, 128, 70)
_CREAM: Color = (236, 240, 216)
_CAP: Color = (46, 92, 58)

_LABEL_RADIUS = 0.0325
_BODY = [(0.0325, 0.0), (0.0325, 0.140), (0.015, 0.176)]
_NECK = [(0.015, 0.176), (0.015, 0.208)]


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
