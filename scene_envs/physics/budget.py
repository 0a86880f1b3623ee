"""Work budgets: counts of work that stop searches and simulations at the same step on every machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scene_envs.physics.pairs import ObjectPairs
from scene_envs.physics.placement import Objects

PER_SCENE, PER_OBJECT, PER_PAIR, MAX_PER_OBJECT = 1_000.0, 1_200.0, 500.0, 10_000.0
"""Units of simulation (see :class:`Budget`) that a scene may take: ``PER_SCENE``, plus ``PER_OBJECT`` for each free
object, plus ``PER_PAIR`` for each pair of free objects, because they may meet. The sum of the last two is at most
``MAX_PER_OBJECT`` for each free object."""
MIN_UNITS = 20_000.0
"""Smallest number of units beyond ``PER_SCENE``, unless ``MAX_PER_OBJECT`` gives fewer. It lets a scene of five
objects go through all rounds of :func:`~scene_envs.physics.make_ready`."""
_CROWDED = 0.75
"""Above this share of free objects that do not stand clear of each other, a scene gets only ``PER_SCENE`` units."""
_COINCIDENT = 0.9
"""Two objects coincide when the common part of their boxes is at least this share of the larger box."""
_DEEP = 1e-2
"""A free object does not stand clear when it is deeper than this (m) in another free one, or coincides with one."""


@dataclass
class Budget:
    """Units of work that a search or a simulation may spend.

    A unit of a search is one tested pair of convex parts. A unit of simulation is one free object over one step of
    35 solver iterations: about 0.05 ms, several times that where objects are deep in each other.
    """

    limit: float  # number of units at which the work ends
    spent: float = 0.0  # number of units spent so far

    def spend(self, units: float) -> None:
        """Add ``units`` of work."""
        self.spent += units

    @property
    def is_spent(self) -> bool:
        """Whether the limit is reached."""
        return self.spent >= self.limit


def simulation_units(objects: Objects, pairs: ObjectPairs) -> float:
    """Units of simulation that one scene, given as its objects and their near pairs, may take."""
    first, second = pairs.first, pairs.second
    low = np.maximum(pairs.low[first], pairs.low[second])
    high = np.minimum(pairs.high[first], pairs.high[second])
    volume = np.prod(pairs.high - pairs.low, axis=1)
    common = np.prod(np.maximum(high - low, 0.0), axis=1)
    close = (pairs.depth > _DEEP) | (common >= _COINCIDENT * np.maximum(volume[first], volume[second]))
    close &= ~(objects.fixed[first] | objects.fixed[second])
    crowded = np.isin(np.arange(len(objects)), np.concatenate([first[close], second[close]]))
    free = int((~objects.fixed).sum())
    if crowded.sum() > _CROWDED * free:
        return PER_SCENE
    more = PER_OBJECT * free + PER_PAIR * free * (free - 1) / 2
    return PER_SCENE + min(max(more, MIN_UNITS), MAX_PER_OBJECT * free)
