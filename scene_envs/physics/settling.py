"""Settling: motion of scenes under gravity until they are at rest, in segments of time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from scene_envs.arrays import Array
from scene_envs.physics.budget import Budget
from scene_envs.physics.pairs import ObjectPairs
from scene_envs.physics.motion import Physics, advance
from scene_envs.physics.placement import Objects
from scene_envs.physics.rest import Rest
from scene_envs.physics.support import company

_SEGMENT = 0.25
"""Length (s) of a segment; after each, settling chooses the shapes again and checks whether anything still moves."""
_STILL, _STILL_ANGLE = 5e-5, 5e-4
"""An object that moved less than this (m, rad) in a segment has come to rest."""


def settle_scene(
    physics: Physics,
    objects: Objects,
    pairs: ObjectPairs,
    duration: float,
    iterations: int,
    bottom: float,
    budget: Budget,
) -> tuple[Array, Array, bool]:
    """Let one scene come to rest: rotation (n, 3, 3), translation (n, 3) m, and whether they stayed finite.

    Args:
        physics: Physics of the scene's assets.
        objects: Objects of one scene.
        pairs: Near pairs of the objects.
        duration: Longest time to simulate, s.
        iterations: Solver iterations per step.
        bottom: Height (m) below which objects are simulated no further.
        budget: Units of simulation; when they are spent, objects stay at the poses reached.
    """
    current = objects
    calm = np.zeros(len(objects), dtype=bool)  # was simulated, and did not move
    remaining = duration
    while remaining > 1e-9 and not budget.is_spent:
        span = min(_SEGMENT, remaining)
        remaining -= span
        rest = physics.rest(current, pairs, span)
        active = ~(rest.still | current.fixed)
        fallen = active & (current.translation[:, 2] < bottom)
        done = fallen | active & ~company(current, pairs, active & ~calm & ~fallen)
        rest = Rest(rest.still | done, rest.rise, rest.tilt)
        if not (active & ~done).any() and (np.abs(rest.rise) < _STILL).all():
            break
        moved = advance(physics, current, pairs, rest, span, budget, settling=iterations)
        if not moved.is_finite:
            return objects.rotation, objects.translation, False
        far = np.linalg.norm(moved.translation - current.translation, axis=1)
        calm = (far < _STILL) & (moved.angle < _STILL_ANGLE)
        current = replace(current, rotation=moved.rotation, translation=moved.translation)
        if remaining > 1e-9 and not budget.is_spent:
            pairs = physics.collider.pairs(current)
    return current.rotation, current.translation, True
