"""Apples, pears and avocados: solids of revolution that stand on a flat foot."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

from scene_envs.assets.base import Array
from scene_envs.assets.library import Model, asset_recipe
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
_APPLE_HULL = [(0.48, 0.0), (0.96, 0.33), (1.0, 0.63), (0.62, 1.0)]
_CONICAL_HULL = [(0.46, 0.0), (0.90, 0.38), (1.0, 0.72), (0.62, 1.0)]


def _scaled(profile: Profile, radius: float, height: float) -> list[tuple[float, float]]:
    return [(radius * r, height * z) for r, z in profile]


def _stem(height: float, start: float, tip: float, lean: float, thickness: float) -> trimesh.Trimesh:
    """A stem from ``start`` to ``tip`` (fractions of the height), leaning ``lean`` m toward +x."""
    path = [(0.0, 0.0, start * height), (0.3 * lean, 0.0, 0.5 * (start + tip) * height), (lean, 0.0, tip * height)]
    return tube(path, [0.9 * thickness, 0.8 * thickness, 1.2 * thickness], _STEM, sides=6)


def _cheek(height: float, turn: float = 0.6, spread: float = 0.9) -> Paint:
    """Ground colour (0) with a sunny cheek (2) and a streaky seam between them (1)."""

    def paint(angle: Array, z: Array) -> Cells:
        sun = np.cos(angle - turn) + 0.35 * np.cos(5.0 * angle + 1.0) * np.cos(9.0 * angle) + 0.5 * (z / height - 0.5)
        return (sun > -spread).astype(np.int64) + (sun > 0.35 - spread)

    return paint


def _specks(density: float) -> Paint:
    """Scattered darker (1) and lighter (2) cells on a ground colour (0)."""

    def paint(angle: Array, z: Array) -> Cells:
        shape = np.broadcast_shapes(angle.shape, z.shape)
        draw = np.random.default_rng(7).random(shape)  # fixed: an asset looks the same every time
        return np.where(draw < density, 1, np.where(draw > 1.0 - density, 2, 0))

    return paint


def _apple(
    diameter: float, height: float, colors: tuple[Color, Color, Color], paint: Paint, *, conical: bool = False
) -> Model:
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
    return _apple(0.066, 0.062, ((228, 186, 92), (216, 112, 62), (198, 58, 46)), _cheek(0.062))


@asset_recipe("apple_golden", display_name="apple", mass=0.17, color=(250, 215, 60))
def apple_golden() -> Model:
    """A yellow apple with a few green and brown specks."""
    return _apple(0.070, 0.068, ((232, 208, 92), (214, 196, 84), (238, 218, 116)), _specks(0.10))


@asset_recipe("apple_green", display_name="apple", mass=0.19, color=(140, 230, 40))
def apple_green() -> Model:
    """A green apple."""
    return _apple(0.075, 0.070, ((142, 190, 64), (130, 180, 56), (162, 204, 88)), _specks(0.10))


@asset_recipe("apple_red", display_name="apple", mass=0.21, color=(150, 10, 30))
def apple_red() -> Model:
    """A dark red apple, wide at the top, with five lobes below."""
    return _apple(0.080, 0.080, ((164, 52, 44), (148, 30, 38), (128, 18, 32)), _cheek(0.080, spread=0.75), conical=True)


def _pear(
    diameter: float,
    height: float,
    neck: tuple[float, float, float],
    colors: tuple[Color, Color, Color],
    paint: Paint,
) -> Model:
    """A pear; ``neck`` is the radius where it begins, near its top, and the height where it begins (fractions)."""
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
    visual = join(body, _stem(height, 0.97, 1.04, 0.004, 0.0016))
    return Model(visual, [lower, upper], [hull_of([lower, upper])])


@asset_recipe("pear_bosc", display_name="pear", mass=0.19, color=(170, 130, 20))
def pear_bosc() -> Model:
    """A brown pear with a long neck."""
    return _pear(0.070, 0.100, (0.60, 0.36, 0.64), ((176, 130, 66), (164, 118, 58), (190, 146, 80)), _specks(0.15))


@asset_recipe("pear_anjou", display_name="pear", mass=0.19, color=(190, 210, 110))
def pear_anjou() -> Model:
    """A green pear, egg-shaped, with a short neck."""
    return _pear(0.068, 0.090, (0.68, 0.46, 0.70), ((178, 196, 88), (166, 186, 78), (192, 208, 108)), _specks(0.12))


@asset_recipe("pear_red", display_name="pear", mass=0.20, color=(190, 40, 110))
def pear_red() -> Model:
    """A squat red pear with a narrow neck."""
    return _pear(0.075, 0.085, (0.56, 0.38, 0.68), ((196, 92, 62), (176, 50, 50), (150, 30, 44)), _cheek(0.085))


_AVOCADO = [(0.0, 0.02), (0.20, 0.005), (0.36, 0.0), (0.66, 0.04), (0.93, 0.21), (1.0, 0.38), (0.945, 0.53),
            (0.80, 0.70), (0.62, 0.85), (0.42, 0.955), (0.18, 1.0), (0.0, 0.985)]  # fmt: skip
_AVOCADO_HULL = [(0.46, 0.0), (0.94, 0.19), (1.0, 0.42), (0.82, 0.70), (0.40, 1.0)]


def _avocado(diameter: float, height: float, colors: tuple[Color, Color, Color], bumps: float, density: float) -> Model:
    part = solid(_scaled(_AVOCADO_HULL, diameter / 2.0, height), _SIDES)
    body = revolve(
        curve(_scaled(_AVOCADO, diameter / 2.0, height), 26),
        colors,
        _specks(density),
        segments=36,
        swell=_pebbles(bumps),
    )
    return Model(join(body, _stem(height, 0.97, 1.012, 0.0, 0.0028)), [part], [part])


def _pebbles(size: float) -> Callable[[Array, Array], Array]:
    def swell(angle: Array, z: Array) -> Array:
        return 1.0 - size * (0.5 + 0.5 * np.cos(11.0 * angle + 400.0 * z) * np.cos(7.0 * angle - 900.0 * z))

    return swell


@asset_recipe("avocado_a", display_name="avocado", mass=0.22, color=(20, 110, 60))
def avocado_a() -> Model:
    """A smooth green avocado."""
    return _avocado(0.065, 0.100, ((84, 112, 48), (74, 100, 42), (104, 130, 62)), 0.01, 0.12)


@asset_recipe("avocado_b", display_name="avocado", mass=0.20, color=(40, 60, 30))
def avocado_b() -> Model:
    """A small dark avocado with a pebbled skin."""
    return _avocado(0.060, 0.095, ((58, 56, 44), (46, 44, 38), (74, 76, 54)), 0.04, 0.28)


@asset_recipe("avocado_c", display_name="avocado", mass=0.33, color=(90, 140, 30))
def avocado_c() -> Model:
    """A large bright green avocado."""
    return _avocado(0.082, 0.120, ((112, 148, 62), (100, 136, 54), (138, 168, 84)), 0.01, 0.14)
