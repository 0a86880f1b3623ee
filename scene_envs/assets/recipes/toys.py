"""Toys: rings on a base, and a wooden locomotive."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from scene_envs.assets.base import Model, asset_recipe
from scene_envs.assets.shapes import (
    Color,
    Face,
    Patch,
    Profile,
    box,
    convex_hull,
    hull_of,
    join,
    lathe,
    lettering,
    moved,
    painted_box,
    solid,
)

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
# game boxes
_CARD: Color = (226, 220, 208)
_WHITE: Color = (248, 246, 240)


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


def _lidded(
    size: tuple[float, float, float],
    lid: Color,
    sides: Color,
    top: Sequence[Patch],
    label: Sequence[Patch],
    front: Literal["-y", "+x"] = "-y",
) -> Model:
    """A box with a lid, below which a strip of the tray can be seen."""
    strip = 0.16
    tray = Patch(0.0, 0.0, 1.0, strip, _CARD)
    raised = [Patch(p.left, strip + (1 - strip) * p.low, p.right, strip + (1 - strip) * p.high, p.color) for p in label]
    colors: dict[Face, Color] = {
        "-x": sides, "+x": sides, "-y": sides, "+y": sides, "bottom": _CARD, "top": lid,
    }  # fmt: skip
    walls: tuple[Face, ...] = ("-x", "+x", "-y", "+y")
    art: dict[Face, Sequence[Patch]] = {face: [*raised, tray] for face in walls}
    part = box(size)
    return Model(painted_box(size, colors, {**art, "top": top}, front=front), [part], [part])


@asset_recipe("board_game_s", display_name="board game", mass=0.90, color=(150, 60, 170))
def board_game_s() -> Model:
    """A small game box; its long side is along y."""
    plum, gold, sky = (88, 44, 122), (245, 193, 60), (108, 194, 214)
    top = [
        Patch(0.05, 0.04, 0.95, 0.96, (112, 60, 150)),
        Patch(0.05, 0.62, 0.95, 0.86, gold),
        *lettering(0.12, 0.67, 0.88, 0.81, plum, (1, 1, 0.8, 1, 0.6, 1, 1)),
        Patch(0.17, 0.14, 0.83, 0.54, _WHITE),
        *(Patch(0.21, z, 0.21 + w, z + 0.035, sky) for z, w in ((0.46, 0.5), (0.39, 0.58), (0.32, 0.42))),
        Patch(0.55, 0.18, 0.76, 0.34, (232, 86, 92)),
        Patch(0.24, 0.18, 0.45, 0.26, gold),
    ]
    label = [Patch(0.0, 0.24, 1.0, 0.76, gold), *lettering(0.25, 0.36, 0.75, 0.66, plum)]
    return _lidded((0.20, 0.264, 0.060), plum, plum, top, label, front="+x")


@asset_recipe("board_game_xl", display_name="board game", mass=1.10, color=(150, 0, 72))
def board_game_xl() -> Model:
    """A long game box; its long side is along x."""
    night, wine, cream, gold = (34, 40, 62), (150, 32, 46), (238, 226, 196), (206, 166, 88)
    rooms = [(72, 98, 84), (118, 82, 60), (92, 92, 118), (134, 58, 62)]
    grid = [
        Patch(0.60 + 0.09 * i, 0.14 + 0.185 * j, 0.68 + 0.09 * i, 0.30 + 0.185 * j, rooms[(i + 2 * j) % 4])
        for i in range(4)
        for j in range(4)
    ]
    top = [
        Patch(0.02, 0.04, 0.98, 0.96, wine),
        Patch(0.035, 0.07, 0.965, 0.93, night),
        *lettering(0.08, 0.48, 0.52, 0.80, cream, (1.1, 0.8, 1, 1)),
        Patch(0.08, 0.38, 0.52, 0.41, gold),
        *lettering(0.08, 0.24, 0.46, 0.31, gold, (1, 0.7, 1, 1, 0.5, 1, 1, 0.8, 1)),
        Patch(0.585, 0.10, 0.965, 0.90, cream),
        *grid,
    ]
    label = [Patch(0.0, 0.0, 1.0, 0.10, gold), *lettering(0.36, 0.30, 0.64, 0.80, cream, (1.1, 0.8, 1, 1))]
    return _lidded((0.50, 0.25, 0.055), night, wine, top, label)


@asset_recipe("board_game_l", display_name="board game", mass=1.10, color=(0, 150, 96))
def board_game_l() -> Model:
    """A large game box; its long side is along x."""
    mint, red, ink = (206, 230, 208), (208, 38, 44), (30, 38, 36)
    streets = [(124, 76, 48), (142, 198, 226), (206, 74, 150), (238, 148, 44), (212, 50, 48), (246, 216, 62),
               (40, 142, 82), (32, 84, 164)]  # fmt: skip
    border = [
        patch
        for i, street in enumerate(streets)
        for patch in (
            Patch(0.06 + 0.11 * i, 0.07, 0.16 + 0.11 * i, 0.17, street),
            Patch(0.06 + 0.11 * i, 0.83, 0.16 + 0.11 * i, 0.93, streets[7 - i]),
        )
    ]
    top = [
        Patch(0.025, 0.04, 0.975, 0.96, mint),
        *border,
        Patch(0.10, 0.36, 0.90, 0.64, red),
        *lettering(0.14, 0.42, 0.86, 0.58, _WHITE, (1.2, 1, 1, 1, 1, 1, 0.9, 1)),
        Patch(0.42, 0.70, 0.58, 0.78, ink),
        Patch(0.42, 0.22, 0.58, 0.30, ink),
    ]
    label = [
        Patch(0.18, 0.2, 0.82, 0.85, red),
        *lettering(0.24, 0.36, 0.76, 0.70, _WHITE, (1.2, 1, 1, 1, 1, 1, 0.9, 1)),
    ]
    return _lidded((0.40, 0.265, 0.055), (28, 112, 72), (28, 112, 72), top, label)


@asset_recipe("board_game_l2", display_name="board game", mass=1.20, color=(24, 148, 220))
def board_game_l2() -> Model:
    """A large, deep game box; its long side is along x."""
    blue, navy, sun = (34, 128, 204), (20, 62, 124), (252, 208, 58)
    lanes: list[Color] = [(224, 58, 54), (252, 208, 58), (66, 168, 84), (24, 72, 150)]
    target = [
        Patch(0.72 - w, 0.47 - 1.5 * w, 0.72 + w, 0.47 + 1.5 * w, c)
        for w, c in ((0.20, navy), (0.165, _WHITE), (0.125, lanes[0]), (0.08, _WHITE), (0.04, sun))
    ]
    tracks = [
        patch
        for i, lane in enumerate(lanes)
        for patch in (
            Patch(0.08, 0.14 + 0.11 * i, 0.46, 0.22 + 0.11 * i, lane),
            Patch(0.14 + 0.07 * i, 0.155 + 0.11 * i, 0.18 + 0.07 * i, 0.205 + 0.11 * i, _WHITE),
        )
    ]
    top = [
        Patch(0.03, 0.045, 0.97, 0.955, (64, 158, 226)),
        Patch(0.06, 0.64, 0.50, 0.90, sun),
        *lettering(0.09, 0.69, 0.47, 0.85, navy, (1, 1, 0.9, 0.9, 1)),
        *tracks,
        *target,
    ]
    label = [Patch(0.0, 0.0, 1.0, 0.12, sun), *lettering(0.30, 0.34, 0.70, 0.78, _WHITE, (1, 1, 0.9, 0.9, 1))]
    return _lidded((0.40, 0.265, 0.069), blue, navy, top, label)


@asset_recipe("game_case", display_name="nintendo game", mass=0.07, color=(236, 70, 140))
def game_case() -> Model:
    """A flat plastic case with its cover upward and its spine toward +x; cases stack every 12.5 mm."""
    size = (0.14, 0.125, 0.0125)
    shell, teal, coral = (232, 236, 240), (34, 140, 150), (238, 96, 92)
    cover = [
        Patch(0.03, 0.03, 0.97, 0.97, teal),
        Patch(0.03, 0.84, 0.97, 0.97, _WHITE),
        *lettering(0.08, 0.88, 0.44, 0.93, coral, (1, 1, 1)),
        *lettering(0.12, 0.60, 0.88, 0.76, (250, 220, 92), (1, 0.9, 1, 0.8, 1, 1)),
        Patch(0.30, 0.16, 0.70, 0.50, (22, 96, 116)),
        Patch(0.38, 0.22, 0.62, 0.44, coral),
        Patch(0.44, 0.28, 0.56, 0.38, _WHITE),
        Patch(0.08, 0.07, 0.18, 0.12, _WHITE),
    ]
    spine = [Patch(0.06, 0.16, 0.94, 0.84, teal), *lettering(0.3, 0.32, 0.7, 0.68, _WHITE, (1, 0.9, 1, 0.8, 1, 1))]
    part = box(size)
    return Model(painted_box(size, shell, {"top": cover, "+x": spine}, front="+x"), [part], [part])
