"""Model files as data: shapes and inertials, meshes with a colour per corner, and checked numbers of XML files."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array
from scene_envs.assets.importing.limits import check_file, check_triangles, seconds_left
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError, SceneEnvsError

if TYPE_CHECKING:
    import trimesh


Color = tuple[int, int, int]
Kind = Literal["mesh", "box", "cylinder", "sphere", "capsule", "ellipsoid"]
MESH_SUFFIXES = (".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
"""Mesh files that can be read."""
_GREY: Color = (176, 176, 170)
_UNSET = (102, 102, 102)
"""Colour that trimesh gives a mesh with texture coordinates and no material."""
_SMOOTH = float(np.cos(np.radians(40.0)))
"""Faces that meet at less than 40 degrees are shaded as one curved surface."""
_MAX_SMOOTHED = 100_000
"""Largest number of triangles of a mesh whose corners are smoothed."""
_FINE_TEXTURE, _TEXTURE_COLORS = 500, 32
"""Smallest number of triangles that a textured mesh is cut into, and largest number of its colours."""
_MAX_PIXELS = 8192 * 8192
"""Largest number of pixels of a texture."""
_SAMPLES = np.array(
    [[a, b, 4 - a - b] for a in range(5) for b in range(5 - a)], dtype=np.float64
) / 4.0  # fmt: skip
"""Barycentric points (15, 3) at which a texture is read to colour a triangle."""
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_PREFIXED = re.compile(rb"(</?)([A-Za-z_][\w.-]*):([A-Za-z_][\w.-]*)")
"""An element with a namespace prefix, such as <drake:declare_convex/>."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One piece of geometry; ``size`` (m) is (x, y, z) of a box, (radius, length along z without the caps) of a
    cylinder or capsule, (radius,) of a sphere, (x, y, z radii) of an ellipsoid, and the scale (x, y, z) of a mesh.
    """

    kind: Kind
    size: tuple[float, ...]
    pose: Array  # (4, 4) transform from the shape frame to the model frame
    where: str  # link and element, for messages
    path: Path | None = None  # file of a mesh
    color: Color | None = None  # colour (r, g, b) given by the model, or None
    is_convex: bool = False  # whether the model declares the mesh convex


@dataclass(frozen=True, eq=False)
class Inertial:
    """Mass (kg), centre of mass (3,) m and inertia (3, 3) kg m^2 about that centre, model axes."""

    mass: float
    center_of_mass: Array
    inertia: Array


@dataclass(frozen=True, eq=False)
class Model:
    """A model file at zero joint positions, in one frame."""

    visuals: tuple[Shape, ...]  # shapes to draw
    collisions: tuple[Shape, ...]  # shapes for collisions
    inertials: tuple[Inertial, ...] = ()  # inertials of the links that have one
    static: bool | None = None  # whether the model is fixed to the world; None when the file does not say
    notes: tuple[str, ...] = field(default=())  # choices of the reader that the file may not intend


def pose_of(translation: Array, rotation: Array) -> Array:
    """(4, 4) from a translation (3,) m and a rotation (3, 3)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


def from_roll_pitch_yaw(angles: Array) -> Array:
    """(3, 3) rotation of URDF and SDF: about the fixed axes x, then y, then z; (3,) rad."""
    return np.asarray(Rotation.from_euler("xyz", angles).as_matrix())


def moved_inertial(pose: Array, inertial: Inertial) -> Inertial:
    """The inertial of a link in the frame that ``pose`` (4, 4) maps to."""
    turn = pose[:3, :3]
    center = turn @ inertial.center_of_mass + pose[:3, 3]
    return Inertial(inertial.mass, center, turn @ inertial.inertia @ turn.T)


def merged_inertial(inertials: tuple[Inertial, ...]) -> Inertial:
    """The inertial of several bodies joined to one: masses add, inertias by the parallel-axis theorem."""
    mass = sum(inertial.mass for inertial in inertials)
    weights = [inertial.mass / mass if mass > 0 else 1.0 / len(inertials) for inertial in inertials]
    center = sum((w * i.center_of_mass for w, i in zip(weights, inertials, strict=True)), np.zeros(3))
    total = np.zeros((3, 3))
    for inertial in inertials:
        arm = inertial.center_of_mass - center
        total += inertial.inertia + inertial.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Inertial(mass, center, total)


def read_mesh(path: Path) -> list[trimesh.Trimesh]:
    """The triangle meshes of a file, z up, in the unit of the file.

    Objects of an OBJ and nodes of a scene stay apart. glTF is y up by its specification and is turned; the up axis and
    the unit that a COLLADA file names are applied. Raises InvalidInputError (no such file, unknown format, beyond the
    limits), CorruptFileError (unreadable, no triangles, not finite) and MissingDependencyError (COLLADA without
    pycollada).
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InvalidInputError(
            f"{path}: meshes of type {suffix or '(none)'!r} cannot be read; known: {', '.join(MESH_SUFFIXES)}"
        )
    if not path.is_file():
        raise InvalidInputError(f"{path} does not exist")
    _check_content(path)
    check_file(path)
    import trimesh

    options: dict[str, Any] = {"split_objects": True} if suffix == ".obj" else {}
    try:
        scene: Any = trimesh.load_scene(str(path), process=False, **options)
        for geometry in scene.geometry.values():
            _check_texture(geometry, path)
        pieces = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    except SceneEnvsError:
        raise
    except ImportError as error:
        raise MissingDependencyError(
            f"{path} needs a package that is not installed ({error}); COLLADA files need "
            "`pip install 'scene-envs[collada]'`"
        ) from error
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise CorruptFileError(f"{path} cannot be read as a {suffix[1:].upper()} mesh: {reason}") from error
    if not pieces:
        raise CorruptFileError(f"{path} holds no triangles")
    for mesh in pieces:
        _check_mesh(mesh, path)
    check_triangles(path, sum(len(mesh.faces) for mesh in pieces))
    seconds_left()
    turn = _axes(path)
    for mesh in pieces:
        mesh.vertices = mesh.vertices @ turn.T
    return pieces


def _check_content(path: Path) -> None:
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        raise CorruptFileError(f"{path} cannot be read: {error.strerror or error}") from error
    if not start:
        raise CorruptFileError(f"{path} is empty")
    if start.startswith(b"version https://git-lfs"):
        raise CorruptFileError(f"{path} is a Git LFS pointer, not the mesh itself; fetch it with `git lfs pull`")


def _check_mesh(mesh: trimesh.Trimesh, path: Path) -> None:
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise CorruptFileError(
            f"{path}: vertices of shape {vertices.shape} and faces of shape {faces.shape} are no triangles in space"
        )
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise CorruptFileError(f"{path}: vertex {row} is {vertices[row].tolist()}; coordinates must be finite")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise CorruptFileError(f"{path}: a triangle refers to vertex {int(faces.max())} of {len(vertices)}")


def _check_texture(mesh: Any, path: Path) -> None:
    """Refuse a texture of too many pixels before it is decoded: a file of a few kB may hold a gigabyte of pixels."""
    image = _image(getattr(getattr(mesh, "visual", None), "material", None))
    width, height = getattr(image, "size", (0, 0))
    if width * height > _MAX_PIXELS:
        raise InvalidInputError(
            f"{path} has a texture of {width:,} x {height:,} pixels, more than the {_MAX_PIXELS:,} that one may have; "
            "scale it down"
        )


def _axes(path: Path) -> Array:
    """(3, 3): file axes and unit to z up and metres, where the format defines them."""
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return _Y_UP
    if suffix != ".dae":
        return np.eye(3)
    asset = ElementTree.parse(path).getroot().find("{*}asset")
    up = (asset.findtext("{*}up_axis") or "Y_UP").strip() if asset is not None else "Y_UP"
    unit = asset.find("{*}unit") if asset is not None else None
    meter = float(unit.get("meter", "1")) if unit is not None else 1.0
    turns = {"X_UP": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), "Z_UP": np.eye(3)}
    return meter * turns.get(up, _Y_UP)


def bare(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The surface alone: equal corners merged, triangles without area left out."""
    import trimesh

    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    plain.merge_vertices()
    plain.update_faces(plain.nondegenerate_faces())
    plain.remove_unreferenced_vertices()
    return plain


def has_color(mesh: trimesh.Trimesh) -> bool:
    """Whether the file gives the mesh a colour of its own."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        return _image(visual.material) is not None or tuple(visual.material.main_color[:3]) != _UNSET
    return visual.kind is not None


def _image(material: Any) -> Any:
    return getattr(material, "image", None) or getattr(material, "baseColorTexture", None)


def painted(mesh: trimesh.Trimesh, color: Color | None) -> trimesh.Trimesh:
    """The mesh with a colour and a normal per vertex: its own, else ``color``, else grey."""
    import trimesh

    mesh = _cut(mesh)
    faces = np.asarray(mesh.faces)
    colors = _corner_colors(mesh) if color is None or has_color(mesh) else None
    if colors is None:
        colors = np.tile(np.array(color or _GREY, dtype=np.uint8), (len(faces), 3, 1))
    normals = _corner_normals(mesh)
    corners = np.asarray(mesh.vertices)[faces].reshape(-1, 3)
    rows = np.column_stack([np.round(normals.reshape(-1, 3) * 1e4), colors.reshape(-1, 3)]).astype(np.int64)
    _, point = np.unique(corners, axis=0, return_inverse=True)
    _, first, index = np.unique(
        np.column_stack([point.reshape(-1), rows]), axis=0, return_index=True, return_inverse=True
    )
    rgba = np.column_stack([colors.reshape(-1, 3)[first], np.full(len(first), 255, dtype=np.uint8)])
    return trimesh.Trimesh(
        vertices=corners[first],
        faces=index.reshape(-1, 3),
        vertex_normals=normals.reshape(-1, 3)[first],
        vertex_colors=rgba,
        process=False,
    )


def _corner_colors(mesh: trimesh.Trimesh) -> NDArray[np.uint8] | None:
    """(F, 3, 3) uint8: the file's own colours at the corners of each triangle; None without any."""
    visual: Any = mesh.visual
    faces = np.asarray(mesh.faces)
    if visual.kind == "vertex":
        return np.asarray(visual.vertex_colors)[faces][..., :3].astype(np.uint8)
    if visual.kind == "face":
        return np.repeat(np.asarray(visual.face_colors)[:, None, :3], 3, axis=1).astype(np.uint8)
    if visual.kind != "texture" or not has_color(mesh):
        return None
    uv = None if visual.uv is None else np.asarray(visual.uv)
    if uv is None or _image(visual.material) is None or len(uv) != len(mesh.vertices):
        flat = np.asarray(visual.material.main_color)[:3].astype(np.uint8)
        return np.tile(flat, (len(faces), 3, 1))
    points = np.einsum("sk,fkc->fsc", _SAMPLES, uv[faces])  # (F, S, 2)
    read = np.asarray(visual.material.to_color(points.reshape(-1, 2)))[:, :3].reshape(len(faces), len(_SAMPLES), 3)
    return np.repeat(_few_colors(np.rint(read.mean(axis=1)).astype(np.uint8))[:, None], 3, axis=1)


def _few_colors(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The colours (F, 3) reduced to a palette."""
    from PIL import Image

    if len(np.unique(colors, axis=0)) <= _TEXTURE_COLORS:
        return colors
    reduced = Image.fromarray(colors[None]).quantize(_TEXTURE_COLORS).convert("RGB")
    return np.asarray(reduced, dtype=np.uint8)[0]


def _cut(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A textured mesh of few triangles cut into more, so that the texture is visible; other meshes unchanged."""
    import trimesh

    visual: Any = mesh.visual
    if visual.kind != "texture" or visual.uv is None or _image(visual.material) is None:
        return mesh
    vertices, faces, uv = np.asarray(mesh.vertices), np.asarray(mesh.faces), np.asarray(visual.uv)
    if len(uv) != len(vertices) or len(faces) >= _FINE_TEXTURE:
        return mesh
    while len(faces) < _FINE_TEXTURE:
        vertices, faces, attributes = trimesh.remesh.subdivide(vertices, faces, vertex_attributes={"uv": uv})
        uv = attributes["uv"]
    look = trimesh.visual.TextureVisuals(uv=uv, material=visual.material)
    return trimesh.Trimesh(vertices, faces, visual=look, process=False)


def _corner_normals(mesh: trimesh.Trimesh) -> Array:
    """(F, 3, 3): at each corner the normal of the faces around it that meet at less than 40 degrees."""
    faces = np.asarray(mesh.faces)
    triangles = np.asarray(mesh.vertices)[faces]
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])  # (F, 3)
    length = np.linalg.norm(area, axis=1, keepdims=True)
    unit = np.divide(area, length, out=np.tile([0.0, 0.0, 1.0], (len(area), 1)), where=length > 0)
    flat = np.repeat(unit[:, None], 3, axis=1)
    if len(faces) > _MAX_SMOOTHED:
        return flat
    _, point = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    point = point.reshape(-1)
    order = np.argsort(point, kind="stable")
    starts = np.searchsorted(point[order], np.arange(point.max() + 1))
    sizes = np.diff(np.append(starts, len(order)))
    total = np.zeros((len(point), 3))
    own = np.repeat(unit, 3, axis=0)
    for shift in range(int(min(sizes.max(), 64))):  # the shift-th face around every point
        at = sizes[point] > shift
        other = order[starts[point[at]] + shift] // 3
        near = np.einsum("ij,ij->i", unit[other], own[at]) > _SMOOTH
        total[at] += area[other] * near[:, None]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    smooth = np.divide(total, length, out=own.copy(), where=length > 0)
    return smooth.reshape(-1, 3, 3)


def read_xml(path: Path) -> Element:
    """The root element of an XML file; prefixes that are never declared are tolerated. Raises CorruptFileError, with
    the line, for a file that cannot be read or is no XML, and as :func:`check_file` does.
    """
    check_file(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CorruptFileError(f"{path} cannot be read: {error.strerror or error}") from error
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        if "unbound prefix" in str(error):
            try:
                return ElementTree.fromstring(_PREFIXED.sub(rb"\1\2.\3", data))
            except ElementTree.ParseError as other:
                error = other
        raise CorruptFileError(f"{path} is not well-formed XML: {error}") from error


def numbers(text: str | None, count: int, path: Path, where: str, default: tuple[float, ...] | None = None) -> Array:
    """``count`` finite numbers from text, ``default`` when there is none; CorruptFileError for anything else."""
    if text is None or not text.strip():
        if default is None:
            raise CorruptFileError(f"{path}: {where} is missing; it needs {count} number{'s' if count > 1 else ''}")
        return np.array(default, dtype=np.float64)
    try:
        values = np.array([float(word) for word in text.replace(",", " ").split()])
    except ValueError:
        hint = "; expand it with xacro first" if "$" in text else ""
        raise CorruptFileError(f"{path}: {where} is {text.strip()!r}, which is not numbers{hint}") from None
    if len(values) != count or not np.isfinite(values).all():
        raise CorruptFileError(f"{path}: {where} must be {count} finite number(s), got {text.strip()!r}")
    return values


def positive(text: str | None, count: int, path: Path, where: str) -> tuple[float, ...]:
    """``count`` numbers above 0; raises CorruptFileError otherwise."""
    values = numbers(text, count, path, where)
    if not (values > 0).all():
        raise CorruptFileError(f"{path}: {where} must be above 0, got {text!r}")
    return tuple(values.tolist())


def color_of(text: str | None, path: Path, where: str) -> Color | None:
    """(r, g, b) in 0..255 from "r g b a" in 0..1; None without text."""
    if text is None:
        return None
    values = numbers(text, len(text.split()), path, where)
    if len(values) < 3:
        raise CorruptFileError(f"{path}: {where} must be r g b [a] in 0..1, got {text!r}")
    red, green, blue = np.rint(255.0 * np.clip(values[:3], 0.0, 1.0)).astype(int).tolist()
    return (red, green, blue)


def find_mesh(uri: str, path: Path, where: str) -> Path:
    """The file that ``uri`` names in the model at ``path``: relative, absolute, file://, package:// or model://. A
    package is searched above the model and in ``ROS_PACKAGE_PATH``; InvalidInputError names the places searched.
    """
    text = uri.strip()
    scheme, separator, rest = text.partition("://")
    if not separator:
        scheme, rest = "", text
    rest = rest.replace("\\", "/")
    folder = path.parent
    candidates = [Path(rest)] if scheme == "file" else [folder / rest]
    if scheme in ("package", "model"):
        package, _, inside = rest.partition("/")
        for parent in (folder, *folder.parents):
            candidates += [parent / rest, parent / inside] if parent.name == package else [parent / rest]
        roots = filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))
        candidates += [candidate for root in roots for candidate in (Path(root) / rest, Path(root) / inside)]
        candidates.append(folder / inside)
    elif scheme not in ("", "file"):
        raise InvalidInputError(f"{path}: {where} refers to {uri!r}; only files, package:// and model:// can be read")
    for candidate in candidates:
        if candidate.is_file():
            return candidate.resolve()
    more = ", the folders above it or ROS_PACKAGE_PATH" if scheme in ("package", "model") else ""
    raise InvalidInputError(f"{path}: {where} refers to the mesh {uri!r}, which does not exist in {folder}{more}")
