"""Comparison of an asset's mesh with its convex parts: where contacts with the one would miss the other."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import fcl
import numpy as np
import trimesh
from trimesh.geometry import align_vectors
from trimesh.sample import sample_surface

from scene_envs.assets.base import Asset, ConvexPart
from scene_envs.assets.fcl import Broadphase, convex, gap

MAX_TRIANGLES = 100_000
"""Triangles of the largest mesh that is compared, in about half a second."""
_APART = 1e-3
"""Gap (m) from which a point of one surface misses the other."""
_SAMPLES = 256


class PartAudit(NamedTuple):
    """Shares (0 to 1) of sampled contacts that miss the other surface by more than 1 mm, and largest gaps, m."""

    parts_alone: float  # contacts with the parts where the mesh is apart: the parts stand out, or fill a hollow
    parts_gap: float
    mesh_alone: float  # contacts with the mesh where the parts are apart: the mesh stands out
    mesh_gap: float

    def __str__(self) -> str:
        parts, mesh = 1e3 * self.parts_gap, 1e3 * self.mesh_gap
        return f"""{self.parts_alone:.0%} of the contacts with its parts miss the mesh (gaps up to {parts:.1f} mm), \
{self.mesh_alone:.0%} of those with the mesh miss the parts (up to {mesh:.1f} mm)"""


@lru_cache(maxsize=4096)
def audit_parts(asset: Asset) -> PartAudit | None:
    """Compare the drawn mesh with the fine parts at points of both surfaces that a straight rod can reach along the
    normal or an axis; None for a mesh of more than :data:`MAX_TRIANGLES`. The same asset has the same audit always.
    """
    if len(asset.visual.faces) > MAX_TRIANGLES:
        return None
    model = fcl.BVHModel()
    model.beginModel(len(asset.visual.faces), len(asset.visual.vertices))
    model.addSubModel(np.array(asset.visual.vertices, dtype=np.float64), np.array(asset.visual.faces, dtype=np.int64))
    model.endModel()
    mesh, parts = fcl.CollisionObject(model), [convex(part) for part in asset.fine]
    hulls: Any = trimesh.util.concatenate([trimesh.Trimesh(p.vertices, p.faces, process=False) for p in asset.fine])
    return PartAudit(*_missed(hulls, [mesh, *parts], [mesh]), *_missed(asset.visual, [mesh], parts))


def _missed(sampled: trimesh.Trimesh, obstacles: list[Any], targets: list[Any]) -> tuple[float, float]:
    """Share of the points of a surface, among those that a rod reaches past the ``obstacles``, that are apart from all
    of the ``targets``, and the largest gap, m.
    """
    points, faces = sample_surface(sampled, _SAMPLES, seed=0)[:2]
    tree, ball = Broadphase(obstacles), fcl.CollisionObject(fcl.Sphere(1e-6))
    # A thin pyramid along z: its tip stays 1 mm off the point that it reaches, so that it meets no surface there
    far = float(np.linalg.norm(np.ptp(sampled.vertices, axis=0)))
    corners = np.array([(0, 0, _APART), (1e-4, 0, far), (-1e-4, 1e-4, far), (-1e-4, -1e-4, far)])
    rod = convex(ConvexPart(corners, np.array([(0, 2, 1), (0, 3, 2), (0, 1, 3), (1, 2, 3)])))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    gaps = []
    for point, normal in zip(np.asarray(points), sampled.face_normals[faces], strict=True):
        for direction in (normal, *axes):
            rod.setTransform(fcl.Transform(align_vectors((0, 0, 1), direction)[:3, :3], point))
            if not tree.meets(rod):
                ball.setTranslation(point)
                gaps.append(min(gap(target, ball) for target in targets))
                break
    return float(np.mean(np.array(gaps) > _APART)) if gaps else 0.0, max(gaps, default=0.0)
