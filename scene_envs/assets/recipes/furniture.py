"""Furniture and toys whose parts repeat by a rule: a table of boards, the floor, a speaker, rings and a toy train."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh

from scene_envs.assets.base import Model, asset_recipe
from scene_envs.assets.shapes import (
    Color,
    Patch,
    Profile,
    box,
    convex_hull,
    hull_of,
    join,
    lathe,
    loft,
    moved,
    painted_box,
    solid,
)

_LEG = 0.70
_ASH: list[Color] = [(218, 190, 150), (210, 180, 138), (224, 197, 158), (205, 175, 132)]
_ASH_EDGE: Color = (190, 158, 116)
_TILES: list[Color] = [(216, 210, 200), (206, 199, 188), (220, 215, 206), (201, 194, 182)]
_RINGS: list[tuple[float, Color]] = [
    (0.0390, (222, 62, 58)),
    (0.0350, (244, 146, 44)),
    (0.0310, (248, 212, 66)),
    (0.0270, (86, 178, 92)),
    (0.0230, (62, 128, 206)),
]
"""(radius m, colour), from below."""
_BASE, _RING, _HEIGHT = 0.012, 0.019, 0.13
_TO_X = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""Turns the z axis to +x."""


@asset_recipe("breakfast_table", display_name="table", mass=0.0, color=(186, 150, 112))
def breakfast_table() -> Model:
    """A table for six, 0.75 by 1.50 m, on four legs 0.70 m long; its top surface is z = 0."""
    top = box((0.75, 1.50, 0.04), (0.0, 0.0, -0.04))
    places = [(x, y) for x in (-0.315, 0.315) for y in (-0.69, 0.69)]
    legs = [box((0.06, 0.06, _LEG), (x, y, -0.04 - _LEG)) for x, y in places]
    boards = [
        Patch(i / 6.0, j / 4.0, (i + 1) / 6.0, (j + 1) / 4.0, _ASH[(i + (j + i % 2) // 2) % 4])
        for i in range(6)
        for j in range(4)
    ]
    visual = join(
        painted_box((0.75, 1.50, 0.04), _ASH_EDGE, {"top": boards}, base=(0.0, 0.0, -0.04)),
        *(painted_box((0.06, 0.06, _LEG), _ASH_EDGE, base=(x, y, -0.04 - _LEG)) for x, y in places),
    )
    parts = [top, *legs]  # no coarse hull: a solid block would hide that the top is a face to stand on
    return Model(visual, parts, parts)


@asset_recipe("floor", display_name="floor", mass=0.0, color=(206, 200, 190))
def floor() -> Model:
    """A tiled floor, 10 m square and 0.1 m thick; its upper surface is z = 0."""
    size, count = (10.0, 10.0, 0.1), 20
    tiles = [
        Patch(
            i / count, j / count, (i + 1) / count, (j + 1) / count, _TILES[(i + j) % 2 + 2 * ((7 * i + 3 * j) % 3 == 0)]
        )
        for i in range(count)
        for j in range(count)
    ]
    part = box(size, (0.0, 0.0, -size[2]))
    return Model(painted_box(size, _TILES[1], {"top": tiles}, base=(0.0, 0.0, -size[2])), [part], [part])


@asset_recipe("speaker", display_name="speaker", mass=0.60, color=(72, 44, 100))
def speaker() -> Model:
    """A round loudspeaker lying along x on a flat 36 mm wide, so that it does not roll."""
    half = 0.0875
    section = np.array([(-0.018, 0.0), (0.018, 0.0), (0.030, 0.010), (0.035, 0.026), (0.035, 0.049), (0.030, 0.065),
                        (0.018, 0.075), (-0.018, 0.075), (-0.030, 0.065), (-0.035, 0.049), (-0.035, 0.026),
                        (-0.030, 0.010)])  # fmt: skip
    part = convex_hull([(x, y, z) for x in (-half, half) for y, z in section])
    cloth, rubber, badge, cone = (52, 60, 72), (30, 31, 36), (230, 96, 44), (96, 100, 110)
    turns = 2.0 * np.pi * (np.arange(28) + 0.5) / 28
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    ring /= (np.abs(ring) ** 3).sum(axis=1, keepdims=True) ** (1.0 / 3.0)  # as the section, without its corners
    ring *= np.array([0.035, 0.0375]) / np.abs(ring).max(axis=0)

    def skin(stations: Sequence[tuple[float, float]], color: Color, side: float = 1.0) -> trimesh.Trimesh:
        """A skin through scaled copies of the section at these (x, scale)."""
        rings = [[(x, scale * y, 0.0375 + scale * z) for y, z in ring] for x, scale in stations]
        return moved(loft(rings, color), np.diag([side, side, 1.0]))

    visual = join(
        skin([(-0.070, 1.0), (0.070, 1.0)], cloth),
        *(skin([(0.068, 1.0), (0.080, 1.0), (0.084, 0.97), (0.0855, 0.92)], rubber, side) for side in (1.0, -1.0)),
        *(skin([(0.0850, 0.80), (half, 0.78)], cone, side) for side in (1.0, -1.0)),
        painted_box((0.042, 0.0012, 0.018), badge, base=(0.0, -0.0346, 0.029)),
    )
    return Model(visual, [part], [part])


def _bulge(radius: float, z: float, height: float, rounding: float, samples: int) -> Profile:
    """The rounded outside of a disc from ``z`` up, m."""
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, samples)
    return [(radius - rounding * (1.0 - np.cos(a)), z + 0.5 * height * (1.0 + np.sin(a))) for a in angles]


@asset_recipe("stacking_ring", display_name="stacking ring", mass=0.25, color=(255, 96, 16))
def stacking_ring() -> Model:
    """Five rings on a base, with a ball on top; 0.08 m across, 0.13 m high."""
    wood: Color = (232, 206, 162)
    base = solid([(0.040, 0.0), (0.040, _BASE)], 16)
    levels = [_BASE + _RING * i for i in range(6)]
    rings = [solid(_bulge(r, z, _RING, 0.006, 3), 12) for (r, _), z in zip(_RINGS, levels, strict=False)]
    low = levels[5]
    ball = solid([(0.008, low), (0.0125, low + 0.008), (0.0110, low + 0.017), (0.006, _HEIGHT)], 10)
    turns = np.linspace(-0.85, 0.5 * np.pi, 12)
    middle, radius = low + 0.0098, _HEIGHT - low - 0.0098
    head = [(radius * max(np.cos(a), 0.0), middle + radius * np.sin(a)) for a in turns[:-1]] + [(0.0, _HEIGHT)]
    visual = join(
        lathe([(0.0, 0.0), (0.038, 0.0), (0.040, 0.002), (0.040, _BASE - 0.002), (0.038, _BASE), (0.0, _BASE)], wood),
        *(
            lathe([(0.0, z), *_bulge(r, z, _RING, 0.007, 7), (0.0, z + _RING)], color, segments=28)
            for (r, color), z in zip(_RINGS, levels, strict=False)
        ),
        lathe([(0.0, low), (0.0065, low), *head], (238, 82, 92), segments=24),
    )
    return Model(visual, [base, *rings, ball], [hull_of([base, *rings]), ball])


@asset_recipe("toy_train", display_name="toy train", mass=0.10, color=(44, 92, 228))
def toy_train() -> Model:
    """A small locomotive that runs toward +x; its wheels stand on a flat slab."""
    blue, red, black, gold = (46, 104, 196), (206, 52, 46), (44, 46, 52), (240, 196, 70)
    deck, roof, axis, radius = 0.025, 0.055, 0.0375, 0.0125
    wheels = box((0.078, 0.036, 0.013))
    body = box((0.09, 0.04, deck - 0.013), (0.0, 0.0, 0.013))
    cab = box((0.034, 0.038, roof - deck), (-0.026, 0.0, deck))
    boiler = convex_hull(
        solid([(radius, -0.009), (radius, 0.043)], 12, np.pi / 12).vertices @ _TO_X.T + [0.0, 0.0, axis]
    )
    feet = [
        [x, y, deck] for x in boiler.bounds[:, 0] for y in (-0.006, 0.006)
    ]  # under its middle: it rests on the deck
    boiler = convex_hull(np.concatenate([boiler.vertices, feet]))
    wheel = lathe([(0.0, -0.004), (0.0088, -0.004), (0.009, 0.0), (0.0, 0.0)], [black, black, red], segments=20)
    hub = lathe([(0.0035, 0.0), (0.0, 0.0012)], gold, segments=12)
    to_y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    window = [Patch(0.26, 0.48, 0.74, 0.84, (190, 224, 240))]
    visual = join(
        painted_box((0.074, 0.022, 0.007), black, base=(0.0, 0.0, 0.006)),
        painted_box((0.09, 0.04, 0.004), red, base=(0.0, 0.0, 0.013)),
        painted_box((0.088, 0.038, 0.008), blue, base=(0.0, 0.0, 0.017)),
        painted_box((0.032, 0.034, 0.026), blue, {"-y": window, "+y": window, "+x": window, "-x": window},
                    base=(-0.026, 0.0, deck)),
        painted_box((0.034, 0.038, 0.004), red, base=(-0.026, 0.0, 0.051)),
        moved(
            lathe(
                [(0.0, -0.010), (radius, -0.010), (radius, 0.018), (radius + 0.0004, 0.018), (radius + 0.0004, 0.022),
                 (radius, 0.022), (radius, 0.040), (0.011, 0.043), (0.0, 0.043)],
                [black, blue, gold, gold, gold, blue, black, black],
                segments=28,
            ),
            _TO_X,
            (0.0, 0.0, axis),
        ),
        lathe([(0.0045, 0.046), (0.0045, 0.0525), (0.0058, 0.0535), (0.0058, 0.0545), (0.0, 0.0545)], black,
              segments=16),
        *(
            moved(mesh, to_y @ np.diag([1.0, side, side]), (x, side * 0.018, 0.009))
            for x in (-0.027, 0.027)
            for side in (1.0, -1.0)
            for mesh in (wheel, hub)
        ),
    )  # fmt: skip
    return Model(visual, [wheels, body, cab, boiler], [hull_of([wheels, body]), hull_of([cab, boiler])])
