"""Class colours for assets without one, distinct from each other and from colours in use."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from scene_envs.assets.importing.model import Color


@cache
def _candidates() -> NDArray[np.float64]:
    tones = [(s, v) for v in (0.85, 0.6, 0.4) for s in (0.85, 0.55)]
    colors = [colorsys.hsv_to_rgb(hue / 36.0, s, v) for s, v in tones for hue in range(36)]
    return np.rint(255.0 * np.array(colors))


def distinct_colors(count: int, taken: Iterable[Color] = ()) -> list[Color]:
    """``count`` colours, each the candidate farthest from white and from all before it; the choice is deterministic.

    >>> colors = np.array(distinct_colors(20), dtype=float)
    >>> gaps = np.linalg.norm(colors[:, None] - colors[None], axis=-1) + 1e3 * np.eye(20)
    >>> bool(gaps.min() > 60)
    True
    """
    pool = _candidates()
    gaps = np.full(len(pool), np.inf)
    for color in ((255, 255, 255), *taken):
        gaps = np.minimum(gaps, np.linalg.norm(pool - np.asarray(color), axis=1))
    chosen: list[Color] = []
    while len(chosen) < count:
        if gaps.max() < 1.0:  # every candidate is taken: begin again
            gaps = np.full(len(pool), np.inf)
        red, green, blue = pool[int(gaps.argmax())].astype(int).tolist()
        chosen.append((red, green, blue))
        gaps = np.minimum(gaps, np.linalg.norm(pool - (red, green, blue), axis=1))
    return chosen
