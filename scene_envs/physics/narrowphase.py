"""Exact signed distances between convex parts, by FCL."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_envs.errors import MissingDependencyError
from scene_envs.physics.geometry import LibraryGeometry

Array = NDArray[np.float64]


class PartDistance:
    """Signed distance between two parts of a library at any poses; negative is penetration depth.

    FCL's convex shapes are built on first use and moved afterwards.

    Args:
        library: geometry of the assets.

    Raises:
        MissingDependencyError: python-fcl is not installed.
    """

    def __init__(self, library: LibraryGeometry) -> None:
        try:
            import fcl
        except ImportError as error:  # pragma: no cover
            raise MissingDependencyError(
                "collision needs python-fcl; install it with: pip install python-fcl"
            ) from error
        self._fcl = fcl
        self._library = library
        self._objects: dict[tuple[int, int], Any] = {}
        self._request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=True)

    def __call__(
        self, first: int, rotation_a: Array, translation_a: Array, second: int, rotation_b: Array, translation_b: Array
    ) -> float:
        """Signed distance (m) of parts ``first`` and ``second`` at the given poses."""
        return self.witness(first, rotation_a, translation_a, second, rotation_b, translation_b)[0]

    def witness(
        self, first: int, rotation_a: Array, translation_a: Array, second: int, rotation_b: Array, translation_b: Array
    ) -> tuple[float, Array, Array]:
        """As a call, with the nearest (or deepest) point (3,) on each part, world frame."""
        a, b = self._object(first, 0), self._object(second, 1)
        a.setTransform(self._fcl.Transform(rotation_a, translation_a))
        b.setTransform(self._fcl.Transform(rotation_b, translation_b))
        result = self._fcl.DistanceResult()
        distance = self._fcl.distance(a, b, self._request, result)
        return float(distance), np.asarray(result.nearest_points[0]), np.asarray(result.nearest_points[1])

    def _object(self, part: int, side: int) -> Any:
        if (part, side) not in self._objects:
            geometry = self._library.parts[part]
            faces = np.concatenate([np.full((len(geometry.faces), 1), 3), geometry.faces], axis=1).astype(np.int32)
            convex = self._fcl.Convex(geometry.vertices.copy(), len(geometry.faces), faces.flatten())
            self._objects[part, side] = self._fcl.CollisionObject(convex, self._fcl.Transform())
        return self._objects[part, side]
