"""Apples, pears and avocados: solids of revolution that stand on a flat foot."""

from __future__ import annotations

import numpy as np
import trimesh

from scene_envs.arrays import Array
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.recipes.painted import Cells, Paint, curve, revolve
from scene_envs.assets.shapes import Profile, hull_of, solid
from scene_envs.assets.surfaces import Color, join, tube

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


def _scaled(profile: Profile, radius: float, height: float) -> list[tuple[float, float]]:
    return [(radius * r, height * z) for r, z in profile]


def _stem(height: float, start: float, tip: float, lean: float, thickness: float) -> trimesh.Trimesh:
    """A stem from ``start`` to ``tip`` (fractions of the height), leaning ``lean`` m toward +x."""
    path = [(0.0, 0.0, start * height), (0.3 * lean, 0.0, 0.5 * (start + tip) * height), (lean, 0.0, tip * height)]
    return tube(path, [0.9 * thickness, 0.8 * thickness, 1.2 * thickness], _STEM, sides=6)


def _tones(first: Color, last: Color, count: int = 5) -> list[Color]:
    """Colours from ``first`` to ``last`` in even steps."""
    mixed = np.linspace(first, last, count).round().astype(int)
    return [(int(r), int(g), int(b)) for r, g, b in mixed]


def _cheek(spread: float) -> Paint:
    """Paint in streaks, from the ground colour on the shaded side (0) to the cheek on the sunny side (4)."""

    def paint(angle: Array, z: Array) -> Cells:
        streaks = 0.35 * np.cos(5.0 * angle + 1.0) * np.cos(13.0 * angle)
        return np.clip(np.floor(2.5 * (np.cos(angle + 0.5) + streaks + spread)) + 1 + 0.0 * z, 0, 4).astype(np.int64)

    return paint


def _ripening(height: float) -> Paint:
    """Paint from the colour at the blossom end (0) to the colour at the stem (4)."""

    def paint(angle: Array, z: Array) -> Cells:
        return np.clip(np.floor(5.0 * (z / height) + 0.0 * angle), 0, 4).astype(np.int64)

    return paint


def _pebbled(height: float) -> Paint:
    """As :func:`_ripening`, with each cell shifted at random by at most one tone."""

    def paint(angle: Array, z: Array) -> Cells:
        turns = np.random.default_rng(7).integers(-1, 2, np.broadcast_shapes(angle.shape, z.shape))
        return np.clip(_ripening(height)(angle, z) + turns, 0, 4)

    return paint


def _apple(diameter: float, height: float, colors: list[Color], paint: Paint, *, conical: bool = False) -> Model:
    radius = diameter / 2.0
    part = solid(_scaled(_CONICAL_HULL if conical else _APPLE_HULL, radius, height), _SIDES)

    def lobes(angle: Array, z: Array) -> Array:
        share = z / height
        return 1.0 - (0.045 if conical else 0.015) * (1.0 - np.cos(5.0 * angle)) * np.abs(share - 0.5)

    def with_calyx(angle: Array, z: Array) -> Cells:
        return np.where(np.arange(len(z))[:, None] == 0, 3, paint(angle, z))

    profile = curve(_scaled(_CONICAL if conical else _ROUND, radius, height))
    body = revolve(profile, [*colors, _CALYX], with_calyx, swell=lobes)
    return Model(join(body, _stem(height, 0.80, 1.04, 0.003, 0.0013)), [part], [part])


@asset_recipe("apple_gala", display_name="apple", mass=0.15, color=(236, 30, 70))
def apple_gala() -> Model:
    """A small red apple on a yellow ground."""
    return _apple(0.066, 0.062, _tones((232, 190, 92), (196, 54, 46)), _cheek(1.0))


@asset_recipe("apple_golden", display_name="apple", mass=0.17, color=(250, 215, 60))
def apple_golden() -> Model:
    """A yellow apple with a few green and brown specks."""
    return _apple(0.070, 0.068, _tones((238, 212, 94), (216, 204, 84)), _ripening(0.068))


@asset_recipe("apple_green", display_name="apple", mass=0.19, color=(140, 230, 40))
def apple_green() -> Model:
    """A green apple."""
    return _apple(0.075, 0.070, _tones((162, 204, 82), (130, 182, 56)), _ripening(0.070))


@asset_recipe("apple_red", display_name="apple", mass=0.21, color=(150, 10, 30))
def apple_red() -> Model:
    """A dark red apple, wide at the top, with five lobes below."""
    return _apple(0.080, 0.080, _tones((170, 58, 46), (126, 18, 32)), _cheek(0.9), conical=True)


def _pear(
    diameter: float,
    height: float,
    neck: tuple[float, float, float],
    colors: list[Color],
    paint: Paint,
) -> Model:
    """A pear; ``neck`` is (radius at its start, radius near its top, height of its start), as fractions."""
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
    body = revolve(curve(_scaled(section, radius, height), 28), colors, paint)
    visual = join(body, _stem(height, 0.97, 1.028, 0.003, 0.0016))
    return Model(visual, [lower, upper], [hull_of([lower, upper])])


@asset_recipe("pear_bosc", display_name="pear", mass=0.19, color=(170, 130, 20))
def pear_bosc() -> Model:
    """A brown pear with a long neck."""
    return _pear(0.070, 0.100, (0.60, 0.36, 0.64), _tones((160, 112, 54), (194, 152, 84)), _ripening(0.100))


@asset_recipe("pear_anjou", display_name="pear", mass=0.19, color=(190, 210, 110))
def pear_anjou() -> Model:
    """A green pear, egg-shaped, with a short neck."""
    return _pear(0.068, 0.090, (0.68, 0.46, 0.70), _tones((196, 208, 104), (162, 184, 76)), _ripening(0.090))


@asset_recipe("pear_red", display_name="pear", mass=0.20, color=(190, 40, 110))
def pear_red() -> Model:
    """A squat red pear with a narrow neck."""
    return _pear(0.075, 0.085, (0.56, 0.38, 0.68), _tones((206, 112, 66), (150, 30, 44)), _cheek(0.8))


_AVOCADO = [(0.0, 0.02), (0.20, 0.005), (0.36, 0.0), (0.66, 0.04), (0.93, 0.21), (1.0, 0.38), (0.945, 0.53),
            (0.80, 0.70), (0.62, 0.85), (0.42, 0.955), (0.18, 1.0), (0.0, 0.985)]  # fmt: skip
_AVOCADO_HULL = [(0.46, 0.0), (0.94, 0.19), (1.0, 0.42), (0.82, 0.70), (0.40, 1.0)]


def _avocado(diameter: float, height: float, colors: list[Color], paint: Paint, bumps: float) -> Model:
    part = solid(_scaled(_AVOCADO_HULL, diameter / 2.0, height), _SIDES)

    def pebbles(angle: Array, z: Array) -> Array:
        return 1.0 - bumps * (0.5 + 0.5 * np.cos(11.0 * angle + 400.0 * z) * np.cos(7.0 * angle - 900.0 * z))

    profile = curve(_scaled(_AVOCADO, diameter / 2.0, height), 26)
    body = revolve(profile, colors, paint, segments=36, swell=pebbles)
    return Model(join(body, _stem(height, 0.97, 1.012, 0.0, 0.0028)), [part], [part])


@asset_recipe("avocado_a", display_name="avocado", mass=0.22, color=(20, 110, 60))
def avocado_a() -> Model:
    """A smooth green avocado."""
    return _avocado(0.065, 0.100, _tones((74, 100, 42), (104, 130, 62)), _ripening(0.100), 0.01)


@asset_recipe("avocado_b", display_name="avocado", mass=0.20, color=(40, 60, 30))
def avocado_b() -> Model:
    """A small dark avocado with a pebbled skin."""
    return _avocado(0.060, 0.095, _tones((54, 50, 42), (74, 78, 52)), _pebbled(0.095), 0.04)


@asset_recipe("avocado_c", display_name="avocado", mass=0.33, color=(90, 140, 30))
def avocado_c() -> Model:
    """A large bright green avocado."""
    return _avocado(0.082, 0.120, _tones((104, 140, 52), (146, 172, 84)), _ripening(0.120), 0.01)
