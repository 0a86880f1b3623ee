"""Work budgets: counts of work that stop searches and simulations at the same step on every machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_envs.physics.geometry import LibraryGeometry
from scene_envs.physics.placement import Objects, object_boxes, place

PER_SCENE, PER_OBJECT = 1_000.0, 10_000.0
"""Units of simulation (see :class:`Budget`) that a scene may take: so many, and so many more for each free object by
which those that coincide with no other outnumber those that do."""
_COINCIDENT = 0.9
"""Two objects coincide when the common part of their boxes is at least this share of the larger box."""


@dataclass
class Budget:
    """Units of work that a search or a simulation may spend.

    A unit of a search is one pair of convex parts looked at. A unit of simulation is one free object over one step of
    35 solver iterations: about 0.05 ms, several times that where objects are deep in each other.

    Attributes:
        limit: units until the work ends.
        spent: units spent so far.
    """

    limit: float
    spent: float = 0.0

    def spend(self, units: float) -> None:
        """Add ``units`` of work."""
        self.spent += units

    @property
    def is_spent(self) -> bool:
        """Whether the limit is reached."""
        return self.spent >= self.limit


def simulation_units(library: LibraryGeometry, objects: Objects) -> float:
    """Units of simulation that one scene may take.

    Args:
        library: geometry of the assets.
        objects: of one scene.
    """
    free = np.flatnonzero(~objects.fixed)
    coincident = int(_coincident(library, objects[free]).sum())
    return PER_SCENE + PER_OBJECT * max(0, len(free) - 2 * coincident)


def _coincident(library: LibraryGeometry, objects: Objects) -> NDArray[np.bool_]:
    """(n,) objects whose box is nearly that of another one."""
    low, high = object_boxes(place(library, objects, "coarse"))
    common = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    volume = np.prod(high - low, axis=1)
    shared = np.prod(np.maximum(common, 0.0), axis=2) >= _COINCIDENT * np.maximum(volume[:, None], volume)
    np.fill_diagonal(shared, False)
    return shared.any(axis=1)
