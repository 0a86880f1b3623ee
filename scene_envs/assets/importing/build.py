"""Import of one file as an asset: reading, scaling, decomposition, mass, base."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset, ConvexPart, bounds_of
from scene_envs.assets.importing.entries import AssetEntry, Axis
from scene_envs.assets.importing.hulls import enclosing_hull, thickness
from scene_envs.assets.importing.inertials import weigh
from scene_envs.assets.importing.limits import seconds_left
from scene_envs.assets.importing.model import Inertial, Model, Shape, merged_inertial, pose_of
from scene_envs.assets.importing.report import AssetReport
from scene_envs.assets.importing.sdf import read_sdf
from scene_envs.assets.importing.solids import collision_of, meshes_of, visual_of
from scene_envs.assets.importing.urdf import read_urdf
from scene_envs.assets.shapes import mass_properties
from scene_envs.assets.surfaces import join
from scene_envs.errors import InvalidInputError

if TYPE_CHECKING:
    import trimesh

_CONVEX = 0.01
"""Depth below the hull, as a fraction of the diagonal, up to which a body counts as convex."""
_MAX_CONVEX = 2e-3
"""Upper limit (m) of that depth."""
_THIN = 3e-3
"""Parts thinner than this (m) get a note: the collision margins of physics engines take up much of them."""
_MANY_PARTS, _MANY_TRIANGLES = 64, 200_000
_UNLIKE = 0.01
"""Difference (m) between the bounding boxes of visual and collision geometry that is worth a note."""
_SMALL, _LARGE = 2e-3, 20.0
"""Smallest and largest plausible diagonal (m); beyond them the file is probably not in metres."""


def build_asset(path: Path, entry: AssetEntry) -> tuple[Asset, AssetReport]:
    """The asset that ``entry`` makes of the file at ``path``, and its import report.

    Raises:
        InvalidInputError: a mesh that does not exist, or a model without volume.
        CorruptFileError: a file cannot be read; file and reason are named.
        MissingDependencyError: a format or method needs a package that is not installed.
    """
    model = _scaled(_read(path), entry)
    notes, warnings = list(model.notes), []
    shapes = model.collisions or model.visuals
    if not shapes:
        raise InvalidInputError(f"{path} has neither visual nor collision geometry")
    if not model.collisions:
        notes.append("no collision geometry: the visual one is used")
    size = _diagonal(shapes)
    if not _SMALL <= size <= _LARGE:
        warnings.append(f"it is {size:.3g} m large; if the file is not in metres, set `scale`")
    parts, volume = _collide(shapes, entry, size, path, notes, warnings)
    static = model.static is True if entry.welded is None else entry.welded
    if entry.welded is None and (entry.mass is not None or entry.density is not None):
        static = False
    given = merged_inertial(model.inertials) if model.inertials else None
    weight = weigh(given, parts, volume, mass=entry.mass, density=entry.density)
    properties = mass_properties(parts, 0.0) if static else weight.properties
    if not static:
        notes += weight.notes
        warnings += weight.warnings
    visual = join(*(mesh for shape in model.visuals or shapes for mesh in visual_of(shape, entry.color)))
    shift = _shift(parts, entry, visual if static else None)
    notes += _unlike(visual, parts, size)
    fine = tuple(ConvexPart(_clean(part.vertices + shift), part.faces) for part in parts)
    if len(visual.faces) > _MANY_TRIANGLES:
        notes.append(f"{len(visual.faces)} triangles to draw; pictures will be slow")
    asset = Asset(
        name=entry.name,
        display_name=entry.display_name,
        plural=entry.plural,
        mass=properties.mass,
        center_of_mass=properties.center_of_mass + shift,
        inertia=properties.inertia,
        visual=_moved(visual, shift),
        fine=fine,
        coarse=fine if len(fine) == 1 else (enclosing_hull(fine),),
        color=entry.color or (128, 128, 128),
        static=static,
    )
    x, y, z = (shift + 0.0).tolist()
    density = 0.0 if static else properties.mass / volume
    report = AssetReport(
        entry.name, path, properties.mass, density, len(fine), (x, y, z), tuple(notes), tuple(warnings)
    )  # fmt: skip
    return asset, report


def _read(path: Path) -> Model:
    suffix = path.suffix.lower()
    if suffix == ".urdf":
        return read_urdf(path)
    if suffix == ".sdf":
        return read_sdf(path)
    shape = Shape("mesh", (1.0, 1.0, 1.0), np.eye(4), "the mesh", path)
    return Model(visuals=(shape,), collisions=(shape,))


def _scaled(model: Model, entry: AssetEntry) -> Model:
    """The model scaled, with its up axis turned to +z; the density is kept, so the mass grows with the scale cubed."""
    turn, scale = _upright(entry.up), entry.scale

    def shape(old: Shape) -> Shape:
        pose = pose_of(scale * turn @ old.pose[:3, 3], turn @ old.pose[:3, :3])
        return dataclasses.replace(old, pose=pose, size=tuple(scale * s for s in old.size))

    inertials = tuple(
        Inertial(i.mass * scale**3, scale * turn @ i.center_of_mass, scale**5 * turn @ i.inertia @ turn.T)
        for i in model.inertials
    )
    notes = model.notes
    if scale != 1.0 and any(i.mass > 0 for i in model.inertials) and entry.mass is None and entry.density is None:
        notes = (*notes, f"mass scaled by {scale:g} cubed")
    return Model(
        tuple(map(shape, model.visuals)), tuple(map(shape, model.collisions)), inertials, model.static, notes
    )  # fmt: skip


def _upright(up: Axis) -> Array:
    """(3, 3) rotation that takes the axis ``up`` to +z, about one other axis."""
    quarter = {
        "z": np.eye(3),
        "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
        "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
        "-z": np.diag([1.0, -1.0, -1.0]),
    }
    return quarter[up] if up in quarter else quarter["-z"] @ quarter[up[1:]]


def _diagonal(shapes: Sequence[Shape]) -> float:
    """Length (m) of the diagonal of the bounding box of all shapes."""
    points = []
    for shape in shapes:
        if shape.kind == "mesh":
            points += [np.asarray(mesh.vertices) for mesh in meshes_of(shape)]
        else:
            reach = sum(shape.size) if shape.kind == "capsule" else max(shape.size)
            half = np.array(shape.size) / 2 if shape.kind == "box" else np.full(3, reach)
            corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
            points.append(corners @ shape.pose[:3, :3].T + shape.pose[:3, 3])
    cloud = np.concatenate(points)
    return float(np.linalg.norm(cloud.max(axis=0) - cloud.min(axis=0)))


def _collide(
    shapes: Sequence[Shape], entry: AssetEntry, size: float, path: Path, notes: list[str], warnings: list[str]
) -> tuple[list[ConvexPart], float]:
    """Fine parts of all shapes and the volume (m^3) they fill; adds remarks to ``notes`` and ``warnings``."""
    tolerance = min(_CONVEX * size, _MAX_CONVEX)
    parts: list[ConvexPart] = []
    volume, repeated = 0.0, 0
    seen: set[bytes] = set()
    for shape in shapes:
        found = collision_of(shape, entry.decomposition, tolerance, entry.concavity)
        key = b"".join(np.round(part.vertices, 7).tobytes() for part in found.parts)
        if key and key in seen:
            repeated += 1
            continue
        seen.add(key)
        parts += found.parts
        volume += found.volume
        seconds_left()
        notes += [note for note in found.notes if note not in notes]
        warnings += [warning for warning in found.warnings if warning not in warnings]
    if not parts:
        raise InvalidInputError(f"{path} spans no volume: all corners of its collision geometry lie in one plane")
    if repeated:
        notes.append(f"{repeated} repeated collision shape{'s' if repeated > 1 else ''} left out")
    widths = [thickness(part) for part in parts]
    thin = sum(width < _THIN for width in widths)
    if thin:
        notes.append(f"{thin} of {len(parts)} parts thinner than 3 mm (the thinnest {1e3 * min(widths):.2g} mm)")
    if len(parts) > _MANY_PARTS:
        notes.append(f"{len(parts)} parts; physics will be slow, a larger `concavity` gives fewer")
    return parts, volume


def _unlike(visual: trimesh.Trimesh, parts: Sequence[ConvexPart], size: float) -> list[str]:
    """A note when visual and collision geometry have different bounding boxes."""
    apart = float(np.abs(np.asarray(visual.bounds) - bounds_of(parts)).max())
    if apart <= max(_UNLIKE, 0.05 * size):
        return []
    return [f"the boxes of visual and collision geometry differ by up to {apart:.2g} m"]


def _shift(parts: Sequence[ConvexPart], entry: AssetEntry, visual: trimesh.Trimesh | None) -> Array:
    """(3,) m: position of the file's origin in the asset frame; the box includes ``visual`` when it is given."""
    if entry.base == "origin":
        return np.zeros(3)
    low, high = bounds_of(parts)
    if visual is not None:
        low, high = np.minimum(low, visual.bounds[0]), np.maximum(high, visual.bounds[1])
    return 0.0 - np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])


def _clean(vertices: Array) -> Array:
    """The vertices, with heights that are 0 up to rounding set to exactly 0."""
    vertices[np.abs(vertices[:, 2]) < 1e-9, 2] = 0.0
    return vertices


def _moved(mesh: trimesh.Trimesh, shift: Array) -> trimesh.Trimesh:
    import trimesh

    return trimesh.Trimesh(
        vertices=mesh.vertices + shift,
        faces=mesh.faces,
        vertex_normals=mesh.vertex_normals,
        vertex_colors=mesh.visual.vertex_colors,  # type: ignore[union-attr]
        process=False,
    )
