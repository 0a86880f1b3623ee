"""One convex part of an asset with its face planes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart

SIZE_CLASSES = ((8, 6), (16, 16), (32, 24))
"""(corners, face directions) up to which parts share padded arrays; larger parts make a last class."""


@dataclass(frozen=True, eq=False)
class PartGeometry:
    """A convex part with its face planes, asset frame."""

    vertices: Array  # (V, 3) m
    normals: Array  # (K, 3) distinct outward face normals
    offsets: Array  # (K,) m; the part is where ``normals @ x <= offsets``

    @classmethod
    def of(cls, part: ConvexPart) -> PartGeometry:
        """Face planes of ``part``; triangles of one flat face give one plane, a part without area those of its box."""
        corners = part.vertices[part.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        normals = normals[lengths > 1e-14] / lengths[lengths > 1e-14, None]
        kept: list[int] = []
        for index, normal in enumerate(normals):
            if all(normals[other] @ normal < 1.0 - 1e-9 for other in kept):
                kept.append(index)
        normals = normals[kept] if kept else np.concatenate([np.eye(3), -np.eye(3)])
        return cls(part.vertices, normals, (normals @ part.vertices.T).max(axis=1))

    @cached_property
    def size_class(self) -> int:
        """Index into the padded arrays that hold this part."""
        for index, (corners, directions) in enumerate(SIZE_CLASSES):
            if len(self.vertices) <= corners and len(self.normals) <= directions:
                return index
        return len(SIZE_CLASSES)
