"""Convex decomposition of concave meshes by CoACD, cached on disk.

CoACD: Wei et al., "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree
Search", SIGGRAPH 2022.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import ConvexPart
from scene_envs.assets.importing.hulls import MAX_CORNERS, concavity, few_cornered_hull, has_volume
from scene_envs.assets.importing.limits import seconds_left, too_slow
from scene_envs.assets.importing.mesh_files import bare
from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.files import replacing
from scene_envs.workers import WorkerFailure, run_apart

if TYPE_CHECKING:
    import trimesh

Method = Literal["auto", "coacd", "convex"]
METHODS: tuple[Method, ...] = ("auto", "coacd", "convex")
_LOGGER = logging.getLogger(__name__)
_VERSION = 2
"""Version of the format on disk."""
_SNAP_DISTANCE = 0.015
"""Largest distance from the true surface, relative to the size of the body, at which corners are moved onto it. CoACD
rebuilds surfaces that are not closed on a grid; moving the corners keeps flat faces flat."""
_MAX_BODIES = 128
"""Largest number of bodies of one mesh that are decomposed one by one."""


def cache_folder() -> Path:
    """Folder of cached decompositions: ``$SCENE_ENVS_CACHE``, else ``scene_envs`` in the user's cache folder."""
    if chosen := os.environ.get("SCENE_ENVS_CACHE"):
        return Path(chosen).expanduser()
    if os.name == "nt" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "scene_envs" / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "scene_envs"


def convex_parts(
    mesh: trimesh.Trimesh, method: Method, tolerance: float, threshold: float, what: str
) -> tuple[list[ConvexPart], list[str], list[str]]:
    """The convex parts of one mesh.

    Closed bodies are taken one by one: convex ones keep their shape, concave ones are decomposed. A surface
    that is not closed is decomposed as a whole.

    Args:
        mesh: Triangles, m.
        method: ``"convex"`` takes one hull of the whole mesh; ``"coacd"`` requires CoACD where a body is concave;
            ``"auto"`` falls back to a hull where CoACD is not installed.
        tolerance: Largest depth below its hull (m) of a body that counts as convex.
        threshold: CoACD's concavity, relative to the size of the body.
        what: Name of the mesh, for messages.

    Returns:
        Parts, notes and warnings; no parts when the mesh spans no volume.

    Raises:
        MissingDependencyError: ``"coacd"`` without the package.
    """
    surface = bare(mesh)
    if not len(surface.faces) or not has_volume(np.asarray(surface.vertices)):
        return [], [f"{what} is flat and left out of the collision parts"], []
    if method == "convex":
        return [_hull(surface.vertices, tolerance)], [], []
    bodies, dropped = _bodies(surface, tolerance)
    notes = [f"{what}: {dropped} flat piece(s) left out of the collision parts"] if dropped else []
    warnings: list[str] = []
    parts: list[ConvexPart] = []
    for body in bodies:
        seconds_left()
        hull = _hull(body.vertices, tolerance)
        if _depth(body, hull) <= tolerance:
            parts.append(hull)
            continue
        pieces = _decompose(body, method, threshold, what)
        if pieces is None:
            warnings.append(
                f"{what} is concave and is taken as its hull, because CoACD is not installed "
                "(`pip install 'scene-envs[decomposition]'`)"
            )
            parts.append(hull)
            continue
        parts += [_hull(piece, tolerance) for piece in pieces]
    return parts, notes, sorted(set(warnings))


def _bodies(surface: trimesh.Trimesh, tolerance: float) -> tuple[list[trimesh.Trimesh], int]:
    """Closed or convex bodies of a surface and the number of flat pieces; else the whole surface as one body."""
    pieces: list[Any] = list(surface.split(only_watertight=False))
    solid = [piece for piece in pieces if has_volume(np.asarray(piece.vertices))]
    if not solid or len(solid) > _MAX_BODIES:
        return [surface], 0
    for piece in solid:
        closed = piece.is_watertight and piece.volume > 0
        if not closed and _depth(piece, _hull(piece.vertices, tolerance)) > tolerance:
            return [surface], 0
    return solid, len(pieces) - len(solid)


def _hull(points: Array, tolerance: float) -> ConvexPart:
    return few_cornered_hull(np.asarray(points, dtype=np.float64), 0.25 * tolerance)[0]


def _depth(body: trimesh.Trimesh, hull: ConvexPart) -> float:
    return concavity(np.concatenate([body.vertices, body.triangles_center]), hull)


def _decompose(body: trimesh.Trimesh, method: Method, threshold: float, what: str) -> list[Array] | None:
    """Corners of the convex pieces of a concave body, from the cache where possible; None without CoACD."""
    settings = coacd_settings(threshold)
    path = cache_folder() / "decompositions" / f"{_key(body, settings)}.npz"
    pieces = _read(path)
    if pieces is not None:
        return pieces
    if not _has_coacd():
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


def coacd_settings(threshold: float) -> dict[str, Any]:
    """Keywords of ``coacd.run_coacd`` for a concavity threshold."""
    return {
        "threshold": threshold,
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


def _has_coacd() -> bool:
    try:
        return find_spec("coacd") is not None
    except ValueError:  # a module without a spec
        return False


def run_coacd(vertices: Array, faces: Array, settings: dict[str, Any], what: str) -> list[Array]:
    """Corners (P, 3) of the convex pieces, from a process that is ended at the time limit of the import.

    Args:
        vertices: (V, 3) corners of the mesh.
        faces: (F, 3) int, rows of ``vertices``.
        settings: Keywords of ``coacd.run_coacd``.
        what: Name of the mesh, for messages.

    Raises:
        InvalidInputError: CoACD took too long, or failed.
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
