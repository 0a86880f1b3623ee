"""Toys: rings on a base, and a wooden locomotive."""

from __future__ import annotations

import numpy as np

from scene_envs.assets.panels import Patch, moved, painted_box
from scene_envs.assets.recipe import Model, asset_recipe
from scene_envs.assets.shapes import Profile, box, convex_hull, hull_of, solid
from scene_envs.assets.surfaces import Color, join, lathe

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
    boiler = convex_hull(np.concatenate([boiler.vertices, _feet(boiler.vertices, deck)]))
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


def _feet(vertices: np.ndarray, z: float) -> np.ndarray:
    """Corners at height ``z`` under the middle of a lying cylinder, so that it rests on its support."""
    ends = vertices[:, 0].min(), vertices[:, 0].max()
    return np.array([[x, y, z] for x in ends for y in (-0.006, 0.006)])
