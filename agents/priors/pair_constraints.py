"""Linear constraints on pairs of objects: what stands on, in, beside or at what."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from scene_envs.arrays import Array, Index
from scene_envs.datasets.prompts.facts import SceneFacts

AXES = np.eye(3)
"""Right, front and up, the axes of positions."""
_UPON = 0.15
"""Share of a thing's width within which the centre of what stands on it lies, to each side of its own centre."""
_WITHIN = 0.25
"""The same for things in a container."""
_LEVEL = 0.004
"""Heights of two things in contact differ by at most this (m)."""
_FLOOR, _FILL = 0.01, 0.03
"""Thickness (m) of the bottom of a container; height (m) above it that the lowest things lie within."""
_REST = 0.01
"""Height (m) above a tier that things on it stand within."""
_CLEAR = 1.1
"""Things that no longer stand on each other are apart by this times their mean width."""
_SPOT = 0.03
"""They come within this distance (m) of the chosen place."""
_OFF = 10.0
"""A place outside the furniture counts as less roomy by this times its distance."""


@dataclass(frozen=True)
class Constraint:
    """``low <= axis . (position of first - position of second) <= high``, in the frame of :class:`SceneFacts`.

    Attributes:
        first, second: indices of the two objects.
        axis: (3,) unit vector.
        low, high: bounds in m; infinite for none.
        second_stays: whether the first object alone may be moved.
    """

    first: int
    second: int
    axis: Array
    low: float
    high: float = np.inf
    second_stays: bool = False


@dataclass(frozen=True)
class Surfaces:
    """Heights of the surfaces of n objects that carry others, relative to the positions of :class:`SceneFacts`, m.

    Attributes:
        top: (n,) of the upper side at the middle; of the rim of a hollow thing.
        tiers: (n, L) of the tiers, from the top; NaN for none.
    """

    top: Array
    tiers: Array


def sizes(scene: SceneFacts) -> Array:
    """(n, 3) extent of each object, m."""
    return np.asarray(scene.boxes[:, 1] - scene.boxes[:, 0])


def distance_across(scene: SceneFacts, first: int | Index, second: int | Index) -> Array:
    """Horizontal distances of two sets of objects, m."""
    offset = scene.positions[first] - scene.positions[second]
    return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))


def height_above_foot(scene: SceneFacts, index: int) -> float:
    """Height of an object's position above its lowest point, m."""
    return float(scene.positions[index, 2] - scene.boxes[index, 0, 2])


def stands_on(upper: int, lower: int, inside: bool, scene: SceneFacts, surfaces: Surfaces) -> Iterator[Constraint]:
    """One thing stands on another, or lies in it."""
    share = _WITHIN if inside else _UPON
    for axis in (0, 1):
        reach = share * sizes(scene)[lower, axis]
        yield Constraint(upper, lower, AXES[axis], -reach, reach)
    surface = _FLOOR - height_above_foot(scene, lower) if inside else surfaces.top[lower]
    height = surface + height_above_foot(scene, upper)
    yield Constraint(upper, lower, AXES[2], height - _LEVEL, height + _LEVEL + (_FILL if inside else 0.0))


def stands_beside(upper: int, lower: int, scene: SceneFacts) -> Iterator[Constraint]:
    """What stands on a thing comes to stand beside it, where most room is."""
    base = lower
    while (below := int(scene.held.support[base])) >= 0 and not scene.fixed[below]:
        base = below
    target = _roomiest(upper, lower, scene) - scene.positions[lower, :2]
    for axis in (0, 1):
        yield Constraint(upper, lower, AXES[axis], target[axis] - _SPOT, target[axis] + _SPOT, second_stays=True)
    height = scene.boxes[base, 0, 2] + height_above_foot(scene, upper) - scene.positions[lower, 2]
    yield Constraint(upper, lower, AXES[2], height - _LEVEL, height + _LEVEL, second_stays=True)


def _roomiest(upper: int, lower: int, scene: SceneFacts) -> Array:
    """(2,) place around ``lower``, on the same furniture, that is farthest from all other things."""
    clear = _CLEAR * float(sizes(scene)[[upper, lower], :2].mean())
    angles = np.arange(16) * np.pi / 8
    places = scene.positions[lower, :2] + clear * np.stack([np.cos(angles), np.sin(angles)], axis=1)  # (16, 2)
    others = ~scene.fixed & (np.arange(scene.count) != upper) & (np.arange(scene.count) != lower)
    offsets = places[:, None] - scene.positions[None, others, :2]
    room = np.hypot(offsets[..., 0], offsets[..., 1]).min(axis=1, initial=clear)
    unit = int(scene.held.place[lower])
    if unit >= 0:
        low, high = scene.boxes[unit, 0, :2], scene.boxes[unit, 1, :2]
        room -= np.maximum(low - places, places - high).max(axis=1).clip(min=0.0) * _OFF
    return np.asarray(places[room.argmax()])


def stands_at(index: int, unit: int, scene: SceneFacts, level: float | None) -> Iterator[Constraint]:
    """A thing is within the outline of a piece of furniture, and at the height ``level`` above its position."""
    low, high = scene.boxes[unit] - scene.positions[unit]
    margin = sizes(scene)[index] / 2
    for axis in (0, 1):
        least, most = low[axis] + margin[axis], high[axis] - margin[axis]
        if least < most:
            yield Constraint(index, unit, AXES[axis], least, most, second_stays=True)
    if level is not None:
        height = level + height_above_foot(scene, index)
        yield Constraint(index, unit, AXES[2], height - _LEVEL, height + _REST, second_stays=True)
