"""Bowls: a flat floor and walls of two bands, hollow in both levels of detail because objects lie in them."""

from __future__ import annotations

from typing import NamedTuple

from scene_envs.assets.base import ConvexPart
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.shapes import Profile, ring, solid
from scene_envs.assets.surfaces import Color, lathe

_SIDES = 12


class _Bowl(NamedTuple):
    """Lengths (m): outside and inside (r, z) at the joint of the bands, and sizes of floor and rim."""

    foot: float
    floor: float
    outer: tuple[float, float]
    inner: tuple[float, float]
    radius: float
    height: float
    wall: float

    def parts(self) -> list[ConvexPart]:
        """The floor disc and the two bands of wedges."""
        low = [(self.foot, 0.0), self.outer, self.inner, (self.foot, self.floor)]
        high = [self.outer, (self.radius, self.height), (self.radius - self.wall, self.height), self.inner]
        floor = solid([(self.foot, 0.0), (self.foot, self.floor)], _SIDES)
        return [floor, *ring(low, _SIDES), *ring(high, _SIDES)]


_CEREAL = _Bowl(0.036, 0.006, (0.0605, 0.027), (0.0555, 0.029), 0.0725, 0.065, 0.005)
_FRUIT = _Bowl(0.052, 0.006, (0.091, 0.033), (0.086, 0.036), 0.110, 0.075, 0.005)


def _model(bowl: _Bowl, profile: Profile, colors: list[Color]) -> Model:
    parts = bowl.parts()
    return Model(lathe(profile, colors, segments=56), parts, parts)


@asset_recipe("bowl", display_name="bowl", mass=0.33, color=(120, 190, 255))
def bowl() -> Model:
    """A cereal bowl; its floor is flat within 34 mm of the axis, 6 mm above the table."""
    blue: Color = (112, 150, 176)
    inside: Color = (240, 240, 234)
    return _model(
        _CEREAL,
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
    return _model(
        _FRUIT,
        [
            (0.0, 0.003), (0.045, 0.003), (0.047, 0.0), (0.051, 0.0), (0.052, 0.0025), (0.0690, 0.0130),
            (0.0815, 0.0230), (0.0910, 0.0335), (0.0985, 0.0460), (0.1045, 0.0590), (0.1095, 0.0730), (0.1085, 0.0750),
            (0.1062, 0.0745), (0.1010, 0.0610), (0.0945, 0.0480), (0.0860, 0.0360), (0.0740, 0.0230), (0.0620, 0.0125),
            (0.0500, 0.0064), (0.0, 0.006),
        ],
        [*[dark] * 4, wood, wood, wood, grain, wood, wood, dark, dark, grain, wood, grain, wood, grain, wood, grain],
    )  # fmt: skip
