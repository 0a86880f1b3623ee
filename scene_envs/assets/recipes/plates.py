"""Flat ware: a flat base with a rim that rises outward."""

from __future__ import annotations

import math

from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.shapes import box, hull_of, ring, solid
from scene_envs.assets.surfaces import Color, join, lathe

_PORCELAIN: Color = (245, 243, 238)
_GLAZE: Color = (252, 251, 247)
_RUBY: Color = (164, 40, 52)
_SLATE: Color = (74, 104, 118)
_SHALLOW: Color = (222, 232, 232)


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
