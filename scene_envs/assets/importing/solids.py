"""Shapes of a model as coloured surfaces and convex parts, in the model frame."""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Sequence
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import fcl
import numpy as np
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset, ConvexPart
from scene_envs.assets.fcl import Broadphase, convex, gap
from scene_envs.assets.importing.limits import seconds_left, too_slow
from scene_envs.assets.importing.mesh_files import (
    Color,
    Shape,
    bare,
    merged_inertial,
    moved_inertial,
    painted,
    read_mesh,
)
from scene_envs.assets.shapes import (
    MassProperties,
    Profile,
    box,
    convex_hull,
    mass_properties,
    solid,
    volume,
    winding_number,
)
from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.files import cache_folder, replacing
from scene_envs.workers import WorkerFailure, run_apart

if TYPE_CHECKING:
    import trimesh


MAX_CORNERS = 64
"""Largest number of corners of a hull; the cost of collision tests grows in proportion."""
_COARSE_CORNERS = 16
"""Corners of the inner hull whose faces are moved outward to make an enclosing hull."""
_DIRECTIONS = np.array(list(np.ndindex(3, 3, 3)), dtype=np.float64) - 1.0
"""Directions to the 26 neighbours of a cell, and the zero vector."""
Method = Literal["auto", "coacd", "convex"]
COACD_SETTINGS = {
    "max_convex_hull": 32,
    "preprocess_resolution": 30,
    "resolution": 1000,
    "mcts_nodes": 10,
    "mcts_iterations": 30,
    "mcts_max_depth": 2,
    "max_ch_vertex": MAX_CORNERS,
    "decimate": True,
    "seed": 0,
}
"""Keywords of ``coacd.run_coacd`` besides the threshold of concavity."""
_LOGGER = logging.getLogger(__name__)
_VERSION = 2
"""Version of the format on disk."""
_SNAP_DISTANCE = 0.015
"""Largest distance from the true surface, relative to the size of the body, at which corners are moved onto it. CoACD
rebuilds surfaces that are not closed on a grid; moving the corners keeps flat faces flat."""
_MAX_BODIES = 128
"""Largest number of bodies of one mesh that are decomposed one by one."""
_NOTHING = MassProperties(0.0, np.zeros(3), np.zeros((3, 3)))
_SEGMENTS = 16
_CAP = np.radians(15.0)
"""Half angle of the flat faces at the poles of a ball, on which it can stand."""
MAX_TRIANGLES = 100_000
"""Triangles of the largest mesh that is compared, in about half a second."""
_APART = 1e-3
"""Gap (m) from which a point of one surface misses the other."""
_SAMPLES = 256
"""Points of each surface that are compared."""


def few_cornered_hull(points: Array, tolerance: float, corners: int = MAX_CORNERS) -> tuple[ConvexPart, float]:
    """A hull of some of the points (P, 3), and the farthest distance (m) of a point outside it.

    Starts from the extreme points and adds the farthest outlier until all are within ``tolerance`` (m) or ``corners``
    are used, as quickhull does. Raises InvalidInputError for points in one plane.

    >>> turns = np.linspace(0.0, 2.0 * np.pi, 1000, endpoint=False)
    >>> disc = np.array([[np.cos(t), np.sin(t), z] for t in turns for z in (0.0, 0.1)])
    >>> part, outside = few_cornered_hull(disc, 0.02)
    >>> len(part.vertices) <= 64, outside <= 0.02
    (True, True)
    """
    full = convex_hull(points)
    if len(full.vertices) <= corners and len(full.vertices) <= 16:
        return full, 0.0
    cloud, rows = full.vertices, np.arange(len(full.vertices))
    chosen = np.unique(np.argmax(cloud @ _DIRECTIONS.T, axis=0))[:corners].tolist()
    if np.linalg.matrix_rank(cloud[chosen] - cloud[chosen[0]], tol=1e-9) < 3:
        return full, 0.0
    while True:
        planes = ConvexHull(full.vertices[chosen]).equations
        outside = (cloud @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        worst = int(outside.argmax())
        if outside[worst] <= tolerance or len(chosen) >= corners:
            return convex_hull(full.vertices[chosen]), max(0.0, float(outside[worst]))
        chosen.append(int(rows[worst]))
        rows, cloud = rows[outside > -1e-9], cloud[outside > -1e-9]  # what is inside stays inside a growing hull


def enclosing_hull(parts: Sequence[ConvexPart]) -> ConvexPart:
    """One convex part that encloses all parts, with few faces; the exact hull when that has few corners."""
    points = np.concatenate([part.vertices for part in parts])
    exact = convex_hull(points)
    if len(exact.vertices) <= MAX_CORNERS:
        return exact
    inner, _ = few_cornered_hull(points, 0.0, _COARSE_CORNERS)
    normals = np.concatenate([ConvexHull(inner.vertices).equations[:, :3], np.eye(3), -np.eye(3)])
    offsets = (points @ normals.T).max(axis=0)
    try:
        corners = HalfspaceIntersection(np.column_stack([normals, -offsets]), inner.vertices.mean(axis=0)).intersections
        return convex_hull(corners[np.isfinite(corners).all(axis=1)])
    except QhullError:
        return exact


def thickness(part: ConvexPart) -> float:
    """Smallest distance (m) between a face of the part and the corner farthest from it."""
    planes = ConvexHull(part.vertices).equations
    return float((-(part.vertices @ planes[:, :3].T + planes[:, 3])).max(axis=0).min())


def has_volume(points: Array) -> bool:
    """Whether the points (P, 3) span a volume, up to rounding."""
    if len(points) < 4:
        return False
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] > 1e-6 * max(spread[0], 1e-300))


def convex_parts(
    surface: trimesh.Trimesh, method: Method, tolerance: float, threshold: float, what: str
) -> tuple[list[ConvexPart], MassProperties, list[str], list[str]]:
    """The convex parts of one bare mesh (m), its solid at 1 kg/m^3, notes and warnings; none without volume.

    Closed bodies are taken one by one: those whose depth below their hull is at most ``tolerance`` (m) keep their
    shape, concave ones are decomposed. An open surface is decomposed as a whole, and its parts are its solid.
    ``threshold`` is CoACD's concavity, relative to the size of the body. ``"convex"`` takes one hull of the whole mesh;
    ``"coacd"`` raises MissingDependencyError where a concave body needs CoACD, and ``"auto"`` then takes a hull.
    """
    if not len(surface.faces) or not has_volume(np.asarray(surface.vertices)):
        return [], _NOTHING, [f"{what} is flat and left out of the collision parts"], []
    notes: list[str] = []
    warnings: list[str] = []
    parts: list[ConvexPart] = []
    pieces = _pieces(surface)
    thick = [piece for piece in pieces if has_volume(np.asarray(piece.vertices))]
    closed = _closed(thick)
    bodies = [body for body in closed if body.volume > 0] or thick
    if method == "convex":
        parts, bodies = [_hull(surface.vertices, tolerance)], []
    elif not 0 < len(bodies) <= _MAX_BODIES or any(
        not piece.is_watertight and _depth(piece, _hull(piece.vertices, tolerance)) > tolerance for piece in bodies
    ):
        bodies = [surface]
    elif flat := sum(not has_volume(np.asarray(p.vertices)) and p.area > 1e-9 * surface.area for p in pieces):
        notes = [f"{what}: {flat} flat piece(s) left out of the collision parts"]
    for body in bodies:
        seconds_left()
        hull = _hull(body.vertices, tolerance)
        if _depth(body, hull) <= tolerance:
            parts.append(hull)
            continue
        cut = _decompose(body, method, threshold, what)
        if cut is None:
            warnings = [
                f"{what} is concave and is taken as its hull, because CoACD is not installed "
                "(`pip install 'scene-envs[decomposition]'`)"
            ]
        parts += [hull] if cut is None else [_hull(piece, tolerance) for piece in cut]
    solid = closed or parts
    return parts, mass_properties(solid, volume(solid)), notes, warnings


def _pieces(surface: Any) -> list[Any]:
    """The connected pieces of a bare mesh, whose holes of three or four corners are filled."""
    from trimesh.graph import connected_component_labels as labels  # by edges: bodies may share a corner

    is_one = surface.is_watertight and not labels(surface.face_adjacency, len(surface.faces)).any()
    return [surface] if is_one else list(surface.split(only_watertight=False))


def _closed(pieces: Sequence[Any]) -> list[Any]:
    """The bodies of a closed surface, the outermost ones facing outward, whatever way the file turns them, and what is
    inside them turned with them, so that cavities face inward; none where a piece is open or covers more than its hull.
    """
    from trimesh.repair import fix_winding

    for piece in pieces:
        seconds_left()
        if piece.is_watertight and not piece.is_winding_consistent:
            fix_winding(piece)
        if not piece.is_watertight or not 0 < abs(piece.volume) <= ConvexHull(piece.vertices).volume * (1 + 1e-6):
            return []
    bodies = sorted(pieces, key=lambda piece: -abs(piece.volume))
    bounds = np.array([body.bounds for body in bodies]).reshape(-1, 2, 3)
    inward = [body.volume < 0 for body in bodies]
    for at, body in enumerate(bodies):
        seconds_left()
        inside = ((bounds[:at, 0] <= bounds[at, 0]) & (bounds[:at, 1] >= bounds[at, 1])).all(axis=1)
        outer = next((index for index in np.flatnonzero(inside) if _holds(bodies[index], body)), at)
        if inward[outer]:
            body.invert()
    return bodies


def _holds(outer: trimesh.Trimesh, inner: trimesh.Trimesh) -> bool:
    """Whether a closed body encloses four corners of another."""
    points = np.asarray(inner.vertices)[:: max(1, len(inner.vertices) // 4)][:4]
    return all(abs(winding_number(np.asarray(outer.triangles), point)) > 0.5 for point in points)


def _hull(points: Array, tolerance: float) -> ConvexPart:
    if tolerance == 0 and len((full := convex_hull(points)).vertices) <= 2 * MAX_CORNERS:
        return full
    return few_cornered_hull(np.asarray(points, dtype=np.float64), 0.25 * tolerance)[0]


def _depth(body: trimesh.Trimesh, hull: ConvexPart) -> float:
    """Largest depth (m) of corners and middles of triangles of a body below the surface of ``hull``."""
    points, planes = np.concatenate([body.vertices, body.triangles_center]), ConvexHull(hull.vertices).equations
    deepest = 0.0
    for start in range(0, len(points), 4096):
        gaps = points[start : start + 4096] @ planes[:, :3].T + planes[:, 3]
        deepest = max(deepest, float((-gaps).min(axis=1).max()))
    return deepest


def _decompose(body: trimesh.Trimesh, method: Method, threshold: float, what: str) -> list[Array] | None:
    """Corners of the convex pieces of a concave body, from the cache where possible; None without CoACD."""
    settings = {"threshold": threshold, **COACD_SETTINGS}
    path = cache_folder() / "decompositions" / f"{_key(body, settings)}.npz"
    pieces = _read(path)
    if pieces is not None:
        return pieces
    if find_spec("coacd") is None:
        if method == "coacd":
            raise MissingDependencyError(
                f"{what} asks for CoACD, which is not installed; `pip install 'scene-envs[decomposition]'`"
            )
        return None
    _LOGGER.info("decomposing %s (%d triangles); the result is kept in %s", what, len(body.faces), path.parent)
    size = float(body.scale)  # CoACD's numerics want a size near 1
    found = run_coacd(np.asarray(body.vertices) / size, np.asarray(body.faces), settings, what)
    pieces = [snap_to_surface(vertices * size, body, _SNAP_DISTANCE * size) for vertices in found]
    pieces = [piece for piece in pieces if has_volume(piece)]
    if not pieces:
        raise InvalidInputError(f"CoACD found no convex parts in {what}; set `decomposition: convex` for it")
    _write(path, pieces)
    return pieces


def run_coacd(vertices: Array, faces: Array, settings: dict[str, Any], what: str) -> list[Array]:
    """Corners (P, 3) of the convex pieces of a mesh (V, 3), (F, 3), from a process that ends with the import's time.
    Raises InvalidInputError when CoACD takes too long or fails.
    """
    try:
        return run_apart(f"{__name__}:coacd_pieces", (vertices, faces, settings), seconds_left())  # type: ignore[no-any-return]
    except WorkerFailure as failure:
        if failure.is_late:
            raise too_slow(f"CoACD decomposing {what} of {len(faces):,} triangles") from None
        raise InvalidInputError(
            f"CoACD failed on {what}: it {failure}; set `decomposition: convex` for it"
        ) from failure


def coacd_pieces(request: tuple[Array, Array, dict[str, Any]]) -> list[Array]:
    """Corners (P, 3) of the convex pieces of a mesh, in compiled code that nothing interrupts."""
    import coacd

    vertices, faces, settings = request
    coacd.set_log_level("error")
    found = [np.asarray(corners) for corners, _ in coacd.run_coacd(coacd.Mesh(vertices, faces), **settings)]
    if not all(len(piece) >= 4 and np.isfinite(piece).all() for piece in found):
        raise ValueError("a piece has no volume")
    return found


def snap_to_surface(points: Array, body: trimesh.Trimesh, max_distance: float) -> Array:
    """The points (P, 3), with those within ``max_distance`` (m) of the surface moved to the nearest point on it."""
    from trimesh.triangles import closest_point

    triangles = np.asarray(body.triangles)
    low, high = triangles.min(axis=1) - max_distance, triangles.max(axis=1) + max_distance
    snapped = points.copy()
    for index, point in enumerate(points):
        near = triangles[((point >= low) & (point <= high)).all(axis=1)]
        if not len(near):
            continue
        on_surface = closest_point(near, np.tile(point, (len(near), 1)))
        distance = np.linalg.norm(on_surface - point, axis=1)
        if distance.min() <= max_distance:
            snapped[index] = on_surface[distance.argmin()]
    return snapped


def _key(body: trimesh.Trimesh, settings: dict[str, Any]) -> str:
    """Hash of the inputs of the decomposition."""
    digest = hashlib.sha256(json.dumps([_VERSION, settings], sort_keys=True).encode())
    digest.update(np.ascontiguousarray(body.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(body.faces, dtype="<i8").tobytes())
    return digest.hexdigest()


def _read(path: Path) -> list[Array] | None:
    """The pieces in a cache file; None when the file is missing or damaged."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
            vertices, counts = np.asarray(stored["vertices"]), np.asarray(stored["counts"])
        if vertices.shape != (int(counts.sum()), 3) or not np.isfinite(vertices).all() or not (counts >= 4).all():
            raise ValueError("its arrays do not fit together")
    except FileNotFoundError:
        return None
    except Exception as error:
        _LOGGER.warning("the kept decomposition %s is damaged (%s) and is made anew", path, error)
        return None
    return list(np.split(vertices, np.cumsum(counts)[:-1]))


def _write(path: Path, pieces: Sequence[Array]) -> None:
    """Write the pieces to the cache; a failure to write is only logged."""
    try:
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez(file, vertices=np.concatenate(pieces), counts=np.array([len(piece) for piece in pieces]))
    except OSError as error:
        _LOGGER.warning("a decomposition could not be kept in %s: %s", path.parent, error)


class Collision(NamedTuple):
    """Convex parts of one shape, the solid it fills at 1 kg/m^3, and remarks for the report."""

    parts: list[ConvexPart]
    solid: MassProperties
    notes: list[str]
    warnings: list[str]


@lru_cache(maxsize=32)
def _file(path: Path, changed: int) -> tuple[trimesh.Trimesh, ...]:
    return tuple(read_mesh(path))


def file_meshes(path: Path) -> tuple[trimesh.Trimesh, ...]:
    """As :func:`read_mesh`, read again only when the file changes; not to be changed."""
    return _file(path, path.stat().st_mtime_ns if path.is_file() else 0)


@lru_cache(maxsize=32)
def meshes_of(shape: Shape) -> list[trimesh.Trimesh]:
    """The meshes of a mesh shape in the model frame, colours kept, not to be changed; raises like :func:`read_mesh`,
    and InvalidInputError for an object that its file does not hold.
    """
    assert shape.path is not None
    found = file_meshes(shape.path) if shape.surface is None else (shape.surface,)
    meshes: list[Any] = [m.copy() for m in found if shape.part is None or shape.part[0] in m.metadata["names"]]
    if shape.part is not None and not meshes:
        known = ", ".join(sorted({repr(name) for mesh in found for name in mesh.metadata["names"]}))
        raise InvalidInputError(
            f"{shape.path} holds no object {shape.part[0]!r}, the submesh of {shape.where}; {known}"
        )
    bounds = np.array([mesh.bounds for mesh in meshes])
    middle = 0.5 * (bounds[:, 0].min(axis=0) + bounds[:, 1].max(axis=0)) * bool(shape.part and shape.part[1])
    for mesh in meshes:
        moved = (np.asarray(mesh.vertices) - middle) * shape.size
        mesh.vertices = moved @ shape.pose[:3, :3].T + shape.pose[:3, 3]
        if np.prod(shape.size) < 0:  # a mirror turns triangles inside out
            colors = mesh.visual.face_colors if mesh.visual.kind == "face" else None
            mesh.faces = np.asarray(mesh.faces)[:, ::-1]
            if colors is not None:
                mesh.visual.face_colors = colors
    return meshes


def visual_of(shape: Shape, color: Color | None) -> list[trimesh.Trimesh]:
    """Coloured surfaces; ``color`` is used where neither file nor model gives one."""
    chosen = shape.color or color
    if shape.kind == "mesh":
        return [painted(mesh, chosen) for mesh in meshes_of(shape)]
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
    return [painted(mesh, chosen)]


def collision_of(shape: Shape, method: Method, tolerance: float, threshold: float) -> Collision:
    """Convex parts of a shape. Balls are polyhedra with flat faces at their poles, cylinders are prisms of 16 sides
    whose corners lie on the circle; for meshes see :func:`convex_parts`.
    """
    if shape.kind != "mesh":
        part = _primitive(shape)
        part = ConvexPart(part.vertices @ shape.pose[:3, :3].T + shape.pose[:3, 3], part.faces)
        return Collision([part], solid_of(shape), [], [])
    assert shape.path is not None
    result = Collision([], _NOTHING, [], [])
    solids = []
    for surface in _surfaces(shape):
        how: Method = "convex" if shape.is_convex else method
        tolerance *= not shape.is_convex  # what is convex keeps its corners
        parts, solid, *remarks = convex_parts(surface, how, tolerance, threshold, f"{shape.path.name} ({shape.where})")
        solids.append(solid)
        result.parts.extend(parts)
        for kept, new in zip(result[2:], remarks, strict=True):
            kept.extend(remark for remark in new if remark not in kept)
    return result._replace(solid=merged_inertial(solids))


def _surfaces(shape: Shape) -> list[trimesh.Trimesh]:
    """The bare meshes of a shape; one, where they are closed only together, as those of one body by material are."""
    import trimesh

    apart: list[Any] = [bare(mesh) for mesh in meshes_of(shape)]
    if all(mesh.is_watertight for mesh in apart):
        return apart
    whole = bare(trimesh.util.concatenate(apart))  # type: ignore[arg-type]
    return [whole] if whole.is_watertight else apart


def solid_of(shape: Shape) -> MassProperties:
    """The solid of a shape at 1 kg/m^3, in closed form for primitives; InvalidInputError for a mesh that is open."""
    if shape.kind == "mesh":
        bodies = _closed([piece for mesh in _surfaces(shape) for piece in _pieces(mesh)])
        if not bodies and shape.is_convex:
            bodies = [convex_hull(np.concatenate([mesh.vertices for mesh in meshes_of(shape)]))]
        if not bodies:
            raise InvalidInputError(f"{shape.path}: {shape.where} has no mass, as it is not closed; give a mass")
        return mass_properties(bodies, volume(bodies))
    if shape.kind in ("cylinder", "capsule"):
        radius, length = shape.size
        rod, ball = np.pi * radius**2 * length, 4.0 / 3.0 * np.pi * radius**3 * (shape.kind == "capsule")
        mass, side = rod + ball, radius**2 * (rod / 4.0 + ball / 5.0)
        along = rod * length**2 / 12.0 + ball * (radius**2 / 5.0 + length**2 / 4.0 + 0.375 * length * radius)
        squares = np.array([side, side, along])
    else:
        size = np.broadcast_to(shape.size, 3)
        filled, share = (1.0, 12.0) if shape.kind == "box" else (4.0 / 3.0 * np.pi, 5.0)
        mass = filled * float(size.prod())
        squares = mass * size**2 / share
    return moved_inertial(shape.pose, MassProperties(mass, np.zeros(3), np.diag(squares.sum() - squares)))


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
    import trimesh

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
    from trimesh.geometry import align_vectors
    from trimesh.sample import sample_surface

    points, faces = sample_surface(sampled, _SAMPLES, seed=0)[:2]
    tree, ball = Broadphase(obstacles), fcl.CollisionObject(fcl.Sphere(1e-6))
    # A thin pyramid along z: its tip stays 1 mm off the point that it reaches, so that it meets no surface there
    far = float(np.linalg.norm(np.ptp(sampled.vertices, axis=0)))
    corners = np.array([(0, 0, _APART), (1e-4, 0, far), (-1e-4, 1e-4, far), (-1e-4, -1e-4, far)])
    rod = convex(ConvexPart(corners, np.array([(0, 2, 1), (0, 3, 2), (0, 1, 3), (1, 2, 3)])))
    axes = np.concatenate([np.eye(3), -np.eye(3)])

    @cache  # most of the time goes here, and the points of a flat face have one normal
    def turned(direction: bytes) -> Any:
        return align_vectors((0, 0, 1), np.frombuffer(direction))[:3, :3]

    gaps = []
    for point, normal in zip(np.asarray(points), np.asarray(sampled.face_normals[faces]), strict=True):
        for direction in (normal, *axes):
            rod.setTransform(fcl.Transform(turned(direction.tobytes()), point))
            if not tree.meets(rod):
                ball.setTranslation(point)
                gaps.append(min(gap(target, ball) for target in targets))
                break
    return float(np.mean(np.array(gaps) > _APART)) if gaps else 0.0, max(gaps, default=0.0)
