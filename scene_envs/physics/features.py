"""Corners, faces and edges of a convex part, with the normals at which each of them can touch another part.

The Gauss map of a convex part gives, for each feature, the outward normals at which the feature is extreme. They form a
region of the unit sphere for a corner, an arc for an edge, and a point for a face. The arc of an edge leads from the
normal of one of its faces to the other's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from scene_envs.arrays import Array, Index

_SAME_NORMAL = 1e-10
"""Faces whose unit normals differ by less than this are one face."""
_FLAT = 1e-12
"""Relative size below which a part is a point, width below which a flat part is a line, and height that counts as 0."""


@dataclass(frozen=True, eq=False)
class PartFeatures:
    """Features of one convex part, asset frame.

    A part without thickness has two opposite faces, whose edges are those of the polygon; a line is a polygon of two
    equal edges, and a point has no edges.
    """

    corners: Array  # (V, 3) corners of the hull, m
    normals: Array  # (K, 3) unit outward normals of its distinct faces
    offsets: Array  # (K,) m; the part is where ``normals @ x <= offsets``
    edge_point: Array  # (E, 3) one end of every edge between two distinct faces, m
    edge_direction: Array  # (E, 3) unit vectors along the edges
    edge_faces: Index  # (E, 2) the two faces of an edge
    edge_outward: Array  # (E, 3) unit vectors halfway between the normals of the two faces

    @classmethod
    def of(cls, vertices: Array) -> PartFeatures:
        """Features of the convex hull of ``vertices`` (V, 3), m, which may be flat."""
        try:
            hull = ConvexHull(vertices)
        except (QhullError, ValueError):
            return cls._flat(vertices)
        normals, face = _distinct(hull.equations[:, :3])
        here, side = np.nonzero(np.arange(len(face))[:, None] < hull.neighbors)
        there = hull.neighbors[here, side]
        ends = np.stack([hull.simplices[here, (side + 1) % 3], hull.simplices[here, (side + 2) % 3]], axis=1)
        bent = face[here] != face[there]
        faces = np.stack([face[here], face[there]], axis=1)[bent]
        return cls._with_edges(vertices[np.sort(hull.vertices)], normals, vertices[ends[bent]], faces)

    @classmethod
    def _flat(cls, vertices: Array) -> PartFeatures:
        middle = vertices.mean(axis=0)
        _, sizes, axes = np.linalg.svd(vertices - middle)
        if len(vertices) < 2 or sizes[0] <= _FLAT * np.abs(vertices).max():
            normals = np.concatenate([np.eye(3), -np.eye(3)])
            return cls._with_edges(vertices[:1], normals, np.empty((0, 2, 3)), np.empty((0, 2), dtype=np.int64))
        flat = (vertices - middle) @ axes[:2].T
        try:
            outline = ConvexHull(flat).vertices if len(sizes) > 1 and sizes[1] > _FLAT * sizes[0] else None
        except QhullError:
            outline = None
        if outline is None:
            outline = np.array([flat[:, 0].argmin(), flat[:, 0].argmax()])
        ends = np.stack([vertices[outline], vertices[np.roll(outline, -1)]], axis=1)
        faces = np.tile(np.array([[0, 1]], dtype=np.int64), (len(ends), 1))
        return cls._with_edges(vertices, np.stack([axes[2], -axes[2]]), ends, faces)

    @classmethod
    def _with_edges(cls, corners: Array, normals: Array, ends: Array, faces: Index) -> PartFeatures:
        offsets = (normals @ corners.T).max(axis=1)
        along = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(along, axis=1)
        along, ends, faces = along[length > 0] / length[length > 0, None], ends[length > 0], faces[length > 0]
        one, two = normals[faces[:, 0]], normals[faces[:, 1]]
        blunt = np.einsum("ei,ei->e", one, two) > 0
        # the sum of nearly opposite normals is lost to rounding, and so is the difference of nearly equal ones
        outward = np.where(blunt[:, None], one + two, np.cross(along, two - one))
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        middle = corners.mean(axis=0)
        height = np.einsum("ei,ei->e", outward, ends.mean(axis=1) - middle)
        # the outward vectors of the two edges of a line, at height 0, are opposite already
        outward[height < -_FLAT * np.abs(corners - middle).max()] *= -1.0
        return cls(corners, normals, offsets, ends[:, 0], along, faces, outward)


def _distinct(normals: Array) -> tuple[Array, Index]:
    """Distinct unit normals (K, 3), and the index (F,) of each face's normal among them."""
    exact, face = np.unique(normals, axis=0, return_inverse=True)
    face = face.ravel()
    group = np.arange(len(exact))
    for index in range(1, len(exact)):
        near = np.abs(exact[:index] - exact[index]).max(axis=1) < _SAME_NORMAL
        if near.any():
            group[index] = group[int(near.argmax())]
    kept, number = np.unique(group, return_inverse=True)
    return exact[kept], number.ravel()[face]
