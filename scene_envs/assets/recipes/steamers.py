"""Bamboo steamers: bottoms that stack every 91 mm, and their lid."""

from __future__ import annotations

from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.shapes import hull_of, ring, solid
from scene_envs.assets.surfaces import Color, join, lathe, planks

_RADIUS, _HEIGHT, _WALL = 0.12, 0.091, 0.009
_FLOOR = (0.008, 0.014)
_LID_HEIGHT, _LID_RIM, _LID_TOP, _LID_WALL = 0.06, 0.018, 0.042, 0.012
_BAMBOO: Color = (238, 203, 152)
_BAND: Color = (203, 153, 96)
_INNER: Color = (242, 213, 168)
_SLATS: tuple[Color, Color] = ((240, 208, 158), (222, 183, 128))


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
