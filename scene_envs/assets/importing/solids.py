"""Shapes of a model as coloured surfaces and convex parts, in the model frame."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart
from scene_envs.assets.importing.decomposition import Method, convex_parts
from scene_envs.assets.importing.mesh_files import bare, painted, read_mesh
from scene_envs.assets.importing.model import Color, Shape
from scene_envs.assets.shapes import Profile, box, solid, volume

if TYPE_CHECKING:
    import trimesh

_SEGMENTS = 16
_CAP = np.radians(15.0)
"""Half angle of the flat faces at the poles of a ball, on which it can stand."""


class Collision(NamedTuple):
    """Convex parts of one shape, the volume it fills (m^3), and remarks for the report."""

    parts: list[ConvexPart]
    volume: float
    notes: list[str]
    warnings: list[str]


@lru_cache(maxsize=32)
def _file(path: Path, changed: int) -> tuple[trimesh.Trimesh, ...]:
    return tuple(read_mesh(path))


def meshes_of(shape: Shape) -> list[trimesh.Trimesh]:
    """The meshes of a mesh shape in the model frame, colours kept.

    Raises like :func:`read_mesh`.
    """
    assert shape.path is not None
    changed = shape.path.stat().st_mtime_ns if shape.path.is_file() else 0
    return [_transformed(mesh, shape.pose, shape.size) for mesh in _file(shape.path, changed)]


def _transformed(mesh: trimesh.Trimesh, pose: Array, scale: tuple[float, ...]) -> trimesh.Trimesh:
    moved: Any = mesh.copy()
    moved.vertices = (np.asarray(mesh.vertices) * scale) @ pose[:3, :3].T + pose[:3, 3]
    if np.prod(scale) < 0:  # a mirror turns triangles inside out
        colors = moved.visual.face_colors if moved.visual.kind == "face" else None
        moved.faces = np.asarray(mesh.faces)[:, ::-1]
        if colors is not None:
            moved.visual.face_colors = colors
    return moved  # type: ignore[no-any-return]


def visual_of(shape: Shape, color: Color | None) -> list[trimesh.Trimesh]:
    """Coloured surfaces; ``color`` is used where neither file nor model gives one."""
    chosen = shape.color or color
    if shape.kind == "mesh":
        return [painted(mesh, chosen) for mesh in meshes_of(shape)]
    return [painted(_smooth(shape), chosen)]


def _smooth(shape: Shape) -> trimesh.Trimesh:
    from trimesh import creation

    size = shape.size
    mesh: Any
    if shape.kind == "box":
        mesh = creation.box(size)
    elif shape.kind == "cylinder":
        mesh = creation.cylinder(size[0], size[1], sections=48)
    elif shape.kind == "capsule":
        mesh = creation.capsule(size[1], size[0], count=(32, 32))
        mesh.vertices -= mesh.bounds.mean(axis=0)
    else:
        mesh = creation.icosphere(subdivisions=3)
        mesh.vertices = mesh.vertices * np.broadcast_to(size, 3)
    mesh.apply_transform(shape.pose)
    return mesh  # type: ignore[no-any-return]


def collision_of(shape: Shape, method: Method, tolerance: float, threshold: float) -> Collision:
    """Convex parts of a shape.

    Balls are polyhedra with flat faces at their poles. Cylinders are prisms of 16 sides whose corners lie on the
    circle. For meshes see :func:`convex_parts`.
    """
    if shape.kind != "mesh":
        part = _placed(_primitive(shape), shape.pose)
        return Collision([part], volume([part]), [], [])
    assert shape.path is not None
    result = Collision([], 0.0, [], [])
    filled = 0.0
    for mesh in meshes_of(shape):
        how: Method = "convex" if shape.is_convex else method
        parts, notes, warnings = convex_parts(mesh, how, tolerance, threshold, f"{shape.path.name} ({shape.where})")
        surface = bare(mesh)
        hulls = volume(parts)
        filled += min(hulls, float(surface.volume)) if surface.is_watertight and surface.volume > 0 else hulls
        result.parts.extend(parts)
        result.notes.extend(note for note in notes if note not in result.notes)
        result.warnings.extend(warning for warning in warnings if warning not in result.warnings)
    return result._replace(volume=filled)


def _primitive(shape: Shape) -> ConvexPart:
    size = shape.size
    if shape.kind == "box":
        x, y, z = size
        return box((x, y, z), (0.0, 0.0, -0.5 * z))
    if shape.kind == "cylinder":
        radius, length = size
        return solid([(radius, -0.5 * length), (radius, 0.5 * length)], _SEGMENTS)
    if shape.kind == "capsule":
        radius, length = size
        return solid([(radius * r, radius * z + np.copysign(0.5 * length, z)) for r, z in _ball()], 12)
    ball = solid(_ball(), 12)
    return ConvexPart(ball.vertices * np.broadcast_to(size, 3), ball.faces)


def _ball() -> Profile:
    """Half section of a unit ball with flat poles at z = -1 and 1."""
    angles = np.linspace(_CAP, np.pi - _CAP, 6)
    return [(float(np.sin(a)), float(-np.cos(a) / np.cos(_CAP))) for a in angles]


def _placed(part: ConvexPart, pose: Array) -> ConvexPart:
    return ConvexPart(part.vertices @ pose[:3, :3].T + pose[:3, 3], part.faces)
