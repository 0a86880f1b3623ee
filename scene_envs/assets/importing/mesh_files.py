"""Model files as data: shapes and inertials, meshes with a colour per corner, and checked numbers of XML files."""

from __future__ import annotations

import copy
import json
import os
import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from unittest.mock import patch
from urllib.parse import unquote
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np
from numpy.typing import NDArray

from scene_envs.arrays import Array
from scene_envs.assets.base import Joint
from scene_envs.assets.importing.limits import check_file, check_triangles, gltf_header, seconds_left
from scene_envs.assets.shapes import MassProperties
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError, SceneEnvsError

if TYPE_CHECKING:
    import trimesh


Color = tuple[int, int, int]
Indices = NDArray[np.int64]
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
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_UPRIGHT = {"X_UP": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), "Z_UP": np.eye(3)}
FORMATS: dict[str, Any] = json.loads(Path(__file__).with_name("formats.json").read_text("utf-8"))
"""What is read and left out of formats: children and @attributes of elements, those with a * any number of times."""
_BEFORE_XML = re.compile(rb"\A(?:\s|\xef\xbb\xbf|<!--.*?-->)+(?=<\?xml\s)", re.DOTALL)


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
    part: tuple[str, bool] | None = None  # the one object of a mesh file, and whether its box is centred at the origin
    density: float | None = None  # kg/m^3, given by the model
    surface: trimesh.Trimesh | None = None  # the mesh itself, where it is no file of its own
    link: int = 0  # number of the joint of the model that moves it, counted from 1; 0 for what does not move


@dataclass(frozen=True, eq=False)
class Model:
    """A model file at zero joint positions, in one frame."""

    visuals: tuple[Shape, ...]  # shapes to draw
    collisions: tuple[Shape, ...]  # shapes for collisions
    inertials: tuple[tuple[int, MassProperties], ...] = ()  # of the links that have one, with their joint as of shapes
    static: bool | None = None  # whether the model is fixed to the world; None when the file does not say
    notes: tuple[str, ...] = field(default=())  # choices of the reader that the file may not intend
    joints: tuple[Joint, ...] = ()  # joints that move, each after its parent, with poses in the frame of the model
    faults: tuple[str, ...] = ()  # what is wrong with joints, which are frozen


def moved_inertial(pose: Array, inertial: MassProperties) -> MassProperties:
    """The inertial of a link in the frame that ``pose`` (4, 4) maps to."""
    turn = pose[:3, :3]
    center = turn @ inertial.center_of_mass + pose[:3, 3]
    return MassProperties(inertial.mass, center, turn @ inertial.inertia @ turn.T)


def heavier(inertial: MassProperties, factor: float) -> MassProperties:
    """The inertial of the same body with ``factor`` times the density."""
    return MassProperties(inertial.mass * factor, inertial.center_of_mass, inertial.inertia * factor)


def merged_inertial(inertials: Sequence[MassProperties]) -> MassProperties:
    """The inertial of several bodies joined to one: masses add, inertias by the parallel-axis theorem."""
    mass = sum(inertial.mass for inertial in inertials)
    weights = [inertial.mass / mass if mass > 0 else 1.0 / len(inertials) for inertial in inertials]
    center = sum((w * i.center_of_mass for w, i in zip(weights, inertials, strict=True)), np.zeros(3))
    total = np.zeros((3, 3))
    for inertial in inertials:
        arm = inertial.center_of_mass - center
        total += inertial.inertia + inertial.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return MassProperties(mass, center, total)


def read_mesh(path: Path) -> list[trimesh.Trimesh]:
    """The triangle meshes of a file, in its axes and unit.

    Objects of an OBJ and nodes of a scene stay apart. glTF is y up by its specification and is turned to z up. Metadata
    of each mesh are its ``names`` in the file, ``notes`` on what is not loaded, and the rotation ``upright`` (3, 3) of
    the up axis that a COLLADA file names, which RViz, Gazebo and PyBullet do not apply inside a URDF, to z up. Raises
    InvalidInputError (no such file, unknown format, beyond the limits), CorruptFileError (unreadable, no triangles, not
    finite) and MissingDependencyError (COLLADA without pycollada).
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InvalidInputError(
            f"{path}: meshes of type {suffix or '(none)'!r} cannot be read; known: {', '.join(MESH_SUFFIXES)}"
        )
    if not path.is_file():
        raise InvalidInputError(f"{path} does not exist")
    import trimesh

    content = _Content(path)
    try:
        _PREPARED.get(suffix, lambda content: None)(content)
        scene = content.load()
        for geometry in scene.geometry.values():
            _check_texture(geometry, path)
        found = scene.dump()
        pieces = [mesh for mesh in found if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    except SceneEnvsError:
        raise
    except ImportError as error:
        raise MissingDependencyError(
            f"{path} needs a package that is not installed ({error}); COLLADA files need "
            "`pip install 'scene-envs[collada]'`"
        ) from error
    except Exception as error:
        reason = "; ".join([" ".join(str(error).split()) or type(error).__name__, *dict.fromkeys(content.notes)])
        raise CorruptFileError(f"{path} cannot be read as a {suffix[1:].upper()} mesh: {reason}") from error
    if len(pieces) < len(found):
        content.notes.append(f"{len(found) - len(pieces)} object(s) of points or lines left out")
    if not pieces:
        raise CorruptFileError("; ".join([f"{path} holds no triangles", *dict.fromkeys(content.notes)]))
    for mesh in pieces:
        _check_mesh(mesh, path)
    check_triangles(path, sum(len(mesh.faces) for mesh in pieces))
    seconds_left()
    for mesh in pieces:
        mesh.vertices = mesh.vertices @ content.axes.T
        own = {str(mesh.metadata.get(key)) for key in ("name", "node")}
        mesh.metadata["upright"] = content.upright
        mesh.metadata["names"] = own | content.names_of(str(mesh.metadata.get("name")))
        mesh.metadata["notes"] = tuple(f"{path.name}: {note}" for note in dict.fromkeys(content.notes))
    return pieces


class _Content:
    """The content of a mesh file on its way to trimesh, which reads less than the formats hold."""

    def __init__(self, path: Path) -> None:
        self.path, self.type = path, path.suffix.lower()[1:]
        self.data = _read(path)
        if not self.data:
            raise CorruptFileError(f"{path} is empty")
        if self.data.startswith(b"version https://git-lfs"):
            raise CorruptFileError(f"{path} is a Git LFS pointer, not the mesh itself; fetch it with `git lfs pull`")
        self.axes, self.upright = np.eye(3), np.eye(3)  # to the axes and unit of its meshes, and from these to z up
        self.notes: list[str] = []  # what is not loaded
        self.scales: list[float] = []  # of the geometries, in the order of trimesh; 1 where there are fewer
        self.joints: list[list[int]] = []  # nodes that move the skins of a glTF
        self.names: dict[str, str] = {}  # of the objects of the file, by what trimesh begins their names with

    def load(self) -> Any:
        """The scene that trimesh makes of the data."""
        import trimesh

        options: dict[str, Any] = {"obj": {"split_objects": True}, "dae": {"ignore_broken": False}}.get(self.type, {})
        resolver = trimesh.resolvers.FilePathResolver(str(self.path))
        if self.type in ("glb", "gltf"):
            parts = getattr(trimesh.exchange.gltf, f"load_{self.type}")(BytesIO(self.data), resolver)
            for mesh, scale in zip(parts["geometry"].values(), self.scales, strict=False):
                mesh["vertices"] = mesh["vertices"] * scale
            _pose_gltf(parts, self.joints)
            return trimesh.load_scene(parts)
        try:
            with ExitStack() as patches:
                if self.type == "dae":
                    import collada

                    patches.enter_context(patch("collada.polylist.Polylist.triangleset", _triangleset))
                    patches.enter_context(patch("collada.Collada", partial(_pose_dae, collada.Collada)))
                scene = trimesh.load_scene(BytesIO(self.data), self.type, resolver, process=False, **options)
        except Exception as error:
            if self.type != "dae" or not _drop_looks(self, error):
                raise
            return self.load()
        for geometry in scene.geometry.values() if self.type == "ply" else ():
            _cut_again(geometry)
        return scene

    def names_of(self, name: str) -> set[str]:
        """The names in the file of an object that trimesh calls ``name``."""
        begin = [known for known in self.names if name == known or name.startswith(f"{known}_")]
        longest = max(begin, key=len, default="")
        return {longest, self.names[longest]} if longest else set()

    def expect(self, names: Iterable[str], what: str) -> None:
        """Note the files of these names that are not there."""
        for name in dict.fromkeys(names):
            if name and not any((self.path.parent / n).is_file() for n in (name, unquote(name.replace("\\", "/")))):
                self.notes.append(f"its {what} {name!r} is not there")


def cut_polygons(points: Array, corners: Indices, counts: Indices) -> tuple[Indices, Indices]:
    """Triangles (T, 3) of polygons of any shape, as positions in ``corners``, which are rows of ``points`` (V, 3), and
    their polygons (T,). A polygon has ``counts`` corners. Convex ones are fans, others lose one ear after another.

    >>> dart = np.array([[0.0, 0, 0], [2, 1, 0], [0, 2, 0], [1, 1, 0]])
    >>> cut_polygons(dart, np.arange(4), np.array([4]))[0].tolist()
    [[3, 0, 1], [1, 2, 3]]
    """
    starts, at = np.cumsum(counts) - counts, np.arange(len(corners))
    own = np.repeat(np.arange(len(counts)), counts)
    after = np.where(at + 1 < (starts + counts)[own], at + 1, starts[own])
    ring = points[corners]
    arms, edges = ring - ring[starts[own]], ring[after] - ring
    normals = np.stack([np.bincount(own, part, len(counts)) for part in np.cross(arms, arms[after]).T], axis=1)
    turns = (np.cross(edges, edges[after]) * normals[own]).sum(axis=1)
    bent = (turns <= 1e-9 * (normals**2).sum(axis=1)[own]) & (counts[own] > 3)
    inner = (at > starts[own]) & (after > at)
    rows, polygons = np.column_stack([starts[own], at, after])[inner], own[inner]
    for index in np.unique(own[bent]):
        first, last = np.searchsorted(polygons, (index, index + 1))
        rows[first:last] = starts[index] + _ears(ring[starts[index] :][: counts[index]], normals[index])
    return rows, polygons


def _ears(ring: Array, normal: Array) -> Indices:
    """Triangles (n - 2, 3) of a polygon (n, 3) with its normal, ear after ear."""
    axis = int(np.abs(normal).argmax())
    flat = ring[:, (axis + 1) % 3] + 1j * ring[:, (axis + 2) % 3] * (np.sign(normal[axis]) or 1.0)  # counterclockwise

    def side(a: complex, b: complex, c: Any) -> Any:  # above 0 where c lies left of a to b
        return (np.conj(b - a) * (c - a)).imag

    tiny = 1e-9 * float(np.abs(flat - flat[0]).max()) ** 2
    left, found = list(range(len(ring))), []
    while len(left) > 3:
        for ear in (*range(len(left)), 0):
            a, b, c = flat[left[ear - 1]], flat[left[ear]], flat[left[(ear + 1) % len(left)]]
            others = np.setdiff1d(flat[left], (a, b, c))
            inside = (side(a, b, others) >= -tiny) & (side(b, c, others) >= -tiny) & (side(c, a, others) >= -tiny)
            if side(a, b, c) > tiny and not inside.any():
                break
        found.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    return np.array([*found, left])


def _prepare_obj(content: _Content) -> None:
    """Polygons cut into triangles, relative indices made absolute, and what is not loaded."""
    from trimesh.util import decode_text

    text = decode_text(content.data).replace("\r\n", "\n").replace("\\\n", " ")
    if re.search(r"^[ \t]+\S|^[a-z]+\t", text, re.MULTILINE):
        text = re.sub(r"^[ \t]*([a-z]\w*)[ \t]+", r"\1 ", text, flags=re.MULTILINE)
    content.names |= {name: name for name in re.findall(r"^o (.+?)\s*$", text, re.MULTILINE)}
    libraries = re.findall(r"^mtllib (.+?)\s*$", text, re.MULTILINE)
    content.expect(libraries[:1], "material file")
    content.notes += [f"its second material file {name!r} is not read" for name in libraries[1:]]
    for library in [content.path.parent / name for name in libraries[:1]]:
        materials = decode_text(library.read_bytes()) if library.is_file() else ""
        content.expect(re.findall(r"^\s*map_Kd\s+(.+?)\s*$", materials, re.MULTILINE | re.IGNORECASE), "texture")
    content.notes += [f"its file {name!r} is not read" for name in re.findall(r"^call (\S+)", text, re.MULTILINE)]
    if re.search(r"^(?:l|p|curv2?|surf) ", text, re.MULTILINE):
        content.notes.append("its points, lines and curves are left out")
    if re.search(r"^f(?: +[^\s#]+){4}|^f[^\n]*[ /]-", text, re.MULTILINE):
        text = _cut_faces(text.split("\n"), content.path)
    content.data = text.encode()


def _cut_faces(lines: list[str], path: Path) -> str:
    """The text of an OBJ with triangles for its polygons."""
    points: list[list[float]] = []
    faces: dict[int, list[str]] = {}  # corners by line
    sizes = {"v": 0, "vt": 0, "vn": 0}
    for number, line in enumerate(lines):
        key, _, rest = line.partition(" ")
        if key in sizes:
            sizes[key] += 1
            if key == "v":
                points.append([float(word) for word in rest.split()[:3]])
        elif key == "f":
            lines[number], faces[number] = "", rest.partition("#")[0].split()
            for at, corner in enumerate(faces[number] if "-" in rest else ()):  # a relative index counts back from here
                split = zip(corner.split("/"), sizes.values(), strict=False)
                place = [str(size + 1 + int(word)) if word[:1] == "-" else word for word, size in split]
                faces[number][at] = "/".join(place)
    words = [corner for corners in faces.values() for corner in corners]
    index = np.array([int(word.partition("/")[0]) - 1 for word in words], dtype=np.int64)
    if len(wrong := index[(index < 0) | (index >= len(points))]):
        raise CorruptFileError(f"{path}: a face refers to vertex {wrong[0] + 1} of {len(points)}")
    counts = np.array([len(corners) for corners in faces.values()], dtype=np.int64)
    numbers, found = list(faces), cut_polygons(np.array(points), index, counts)
    for row, polygon in zip(found[0].tolist(), found[1].tolist(), strict=True):
        lines[numbers[polygon]] += "f " + " ".join(words[at] for at in row) + "\n"
    return "\n".join(lines)


def _prepare_dae(content: _Content) -> None:
    """Unit and up axis; lines left out, which trimesh does not read, and cameras, lights and animations."""
    root = _parsed(content.data, content.path)
    if (unit := root.find("asset/unit")) is not None:
        content.axes = np.eye(3) * positive(unit.get("meter", "1"), 1, content.path, "unit of the asset")[0]
    content.upright = _UPRIGHT.get((root.findtext("asset/up_axis") or "").strip(), Y_UP)
    images = [(i.text or "").strip() for i in root.findall("library_images/image//init_from")]
    known = {i.get(key) for key, tag in (("id", "image"), ("sid", "newparam")) for i in root.iter(tag)}
    images += [i.get("texture", "") for i in root.iter("texture") if i.get("texture") not in known]
    content.expect([image.removeprefix("file://") for image in images], "texture")
    content.names |= {geometry.get("id", ""): geometry.get("name", "") for geometry in root.iter("geometry")}
    unused, named = FORMATS["COLLADA"].values()
    unused = unused if root.find(".//instance_controller") is not None else [*unused, "controllers"]
    content.notes += ["its morph targets are not applied"] * (root.find(".//morph") is not None)
    for parent in list(root.iter()):
        for child in list(parent):
            kind = child.tag.removeprefix("instance_").removeprefix("library_")
            if kind in named or kind in unused:
                content.notes += [f"its {named[kind]} are left out"] if kind in named else []
                parent.remove(child)
    content.data = ElementTree.tostring(root)


def _triangleset(polygons: Any) -> Any:
    """The triangles of polygons of pycollada, which itself cuts concave ones as fans."""
    from collada.triangleset import TriangleSet

    cut = cut_polygons(polygons.vertex, polygons.vertex_index, np.asarray(polygons.vcounts))[0]
    return TriangleSet(polygons.sources, polygons.material, polygons.index[cut].ravel(), polygons.xmlnode)


def _pose_dae(load: Any, *args: Any, **kwargs: Any) -> Any:
    """A COLLADA document whose skinned meshes have the shape that their joints give them; ``load`` reads it."""
    from collada import scene

    document, places, skinned = load(*args, **kwargs), {}, []

    def visit(children: list[Any], base: Array, above: tuple[str, ...]) -> None:
        for node in [*children]:
            if isinstance(node, scene.ControllerNode):
                children.remove(node)
                if hasattr(node.controller, "joint_matrices"):
                    skinned.append(node)
                else:
                    children.append(scene.GeometryNode(node.controller.source_geometry, node.materials))
            elif isinstance(node, scene.Node):
                place, roots = base @ node.matrix, (*above, node.id)
                names = [node.xmlnode.get(key) for key in ("sid", "id", "name")]
                places.update({(root, name): place for root in roots for name in names if (root, name) not in places})
                visit(node.children, place, roots)

    visit(document.scene.nodes, np.eye(4), ("",))
    for node in skinned:
        skin, matrices = node.controller, [node.controller.bind_shape_matrix]
        roots = [(element.text or "").strip()[1:] for element in node.xmlnode.findall(document.tag("skeleton"))]
        for joint in skin.weight_joints:
            found = [places[root, joint] for root in (*roots, "") if (root, joint) in places]
            if not found:
                raise ValueError(f"the joint '{joint}' of the skin {skin.id!r} is not in its scene")
            matrices.append(found[0] @ skin.joint_matrices[joint] @ skin.bind_shape_matrix)
        joints, weights = np.concatenate(skin.joint_index), skin.weights.data[np.concatenate(skin.weight_index)]
        rows = np.repeat(np.arange(len(skin.vcounts)), skin.vcounts)
        geometry = copy.copy(skin.geometry)
        geometry.primitives = [copy.copy(primitive) for primitive in geometry.primitives]
        for primitive in geometry.primitives:
            source = copy.copy(primitive.sources["VERTEX"][0][4])
            source.data = _skinned(source.data, rows, joints + 1, weights.ravel(), np.array(matrices, dtype=float))
            primitive._vertex = source.data
            primitive.sources = {**primitive.sources, "VERTEX": [(*primitive.sources["VERTEX"][0][:4], source)]}
        document.scene.nodes.append(scene.GeometryNode(geometry, node.materials))
    return document


def _skinned(points: Array, rows: Indices, joints: Indices, weights: Array, matrices: Array) -> Array:
    """Points (V, 3) moved by the mean of ``matrices`` (J, 4, 4), with a row, a joint and a weight for each influence;
    those without any are moved by the first.
    """
    total = np.bincount(rows, weights, len(points))
    free = np.flatnonzero(total == 0)
    rows, joints, weights = np.append(rows, free), np.append(joints, 0 * free), np.append(weights, 1.0 + 0 * free)
    moved = np.zeros((len(points), 3))
    for joint in np.unique(joints):
        at = np.flatnonzero((joints == joint) & (weights != 0))
        turned = points[rows[at]] @ matrices[joint, :3, :3].T + matrices[joint, :3, 3]
        np.add.at(moved, rows[at], weights[at, None] * turned)
    return moved / np.where(total == 0, 1.0, total)[:, None]


def _drop_looks(content: _Content, error: Exception) -> bool:
    """Leave out the materials of a COLLADA file, which pycollada cannot read; False when there are none."""
    root = _parsed(content.data, content.path)
    looks = ("library_images", "library_effects", "library_materials", "bind_material")
    found = [(parent, child) for parent in root.iter() for child in parent if child.tag in looks]
    for parent, child in found:
        parent.remove(child)
    if found:
        content.notes.append(f"its materials cannot be read ({' '.join(str(error).split())}); drawn without")
        content.data = ElementTree.tostring(root)
    return bool(found)


def _prepare_off(content: _Content) -> None:
    """The same mesh as an OBJ; InvalidInputError for points of other dimensions than three."""
    from trimesh.util import comment_strip, decode_text

    kind, _, text = comment_strip(decode_text(content.data)).rpartition("OFF")
    if {"4", "n"} & {*kind}:
        raise InvalidInputError(
            f"{content.path} is a {kind.strip()}OFF, whose points are not in space; export it as OFF"
        )
    rows = [line.split() for line in text.split("\n") if line.strip()]
    vertices, faces = int(rows[0][0]), int(rows[0][1])
    points, polygons = rows[1 : vertices + 1], rows[vertices + 1 : vertices + faces + 1]
    lines = ["v " + " ".join(row[:3]) for row in points]
    lines += ["f " + " ".join(str(int(word) + 1) for word in row[1 : int(row[0]) + 1]) for row in polygons]
    if any(len(row) > 3 for row in points) or any(len(row) > int(row[0]) + 1 for row in polygons):
        content.notes.append("its colours, normals and texture coordinates are not read")
    content.type, content.data = "obj", "\n".join(lines).encode()
    _prepare_obj(content)


def _prepare_stl(content: _Content) -> None:
    """Colours are not loaded: some programs write them into the header or behind each triangle."""
    if len(content.data) == 84 + 50 * int.from_bytes(content.data[80:84], "little"):  # a binary one
        rows = np.frombuffer(content.data[84:], np.uint8).reshape(-1, 50)
        content.notes += ["its colours are not read"] * bool(rows[:, 48:].any() or b"COLOR=" in content.data[:80])


def _prepare_ply(content: _Content) -> None:
    """What is not loaded: elements besides vertices and faces, and textures that are not there."""
    head = content.data.partition(b"end_header")[0].decode("ascii", "replace")
    content.expect(re.findall(r"^comment TextureFile (.+?)\s*$", head, re.MULTILINE), "texture")
    if content.notes:
        content.data = content.data.replace(b"TextureFile", b"texture")
    names = re.findall(r"^element\s+(?!vertex\s|face\s)(\w+)", head, re.MULTILINE)
    content.notes += [f"its elements {name!r} are left out" for name in names]


def _cut_again(mesh: Any) -> None:
    """Triangles of the polygons of a PLY, which trimesh cuts as fans."""
    raw = mesh.metadata["_ply_raw"]
    data = raw.get("face", {}).get("data")
    names = data if isinstance(data, dict) else getattr(getattr(data, "dtype", None), "names", None) or ()
    for name in [name for name in names if name.startswith("vertex_ind")]:
        found = data[name] if isinstance(data, dict) else data[name]["f1"]
        counts, corners = np.array([len(face) for face in found]), np.concatenate([*found]).astype(np.int64)
        if (counts > 3).any() and len(mesh.vertices) == raw["vertex"]["length"] > corners.max():
            mesh.faces = corners[cut_polygons(np.asarray(mesh.vertices), corners, counts)[0]]


def _read(path: Path) -> bytes:
    """The content of a file; CorruptFileError where it cannot be read, and errors as of :func:`check_file`."""
    check_file(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise CorruptFileError(f"{path} cannot be read: {error.strerror or error}") from error


def _check_mesh(mesh: trimesh.Trimesh, path: Path) -> None:
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise CorruptFileError(
            f"{path}: vertices of shape {vertices.shape} and faces of shape {faces.shape} are no triangles in space"
        )
    if not np.isfinite(vertices).all():
        row = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise CorruptFileError(f"{path}: vertex {row} is {vertices[row].tolist()}; coordinates must be finite")
    if len(wrong := faces[(faces < 0) | (faces >= len(vertices))]):
        raise CorruptFileError(f"{path}: a triangle refers to vertex {int(wrong[0])} of {len(vertices)}")


def _check_texture(mesh: Any, path: Path) -> None:
    """Refuse a texture of too many pixels before it is decoded: a file of a few kB may hold a gigabyte of pixels."""
    image = _image(getattr(getattr(mesh, "visual", None), "material", None))
    width, height = getattr(image, "size", (0, 0))
    if width * height > _MAX_PIXELS:
        raise InvalidInputError(
            f"{path} has a texture of {width:,} x {height:,} pixels, more than the {_MAX_PIXELS:,} that one may have; "
            "scale it down"
        )


def _prepare_gltf(content: _Content) -> None:
    """Scales of quantised positions, and what is not loaded; refuses by its name what trimesh does not read."""
    content.axes = Y_UP
    looks, lost = (tuple(names.split()) for names in FORMATS["glTF"].values())
    header = gltf_header(content.data, content.type == "glb")
    accessors, nodes, meshes = header.get("accessors", []), header.get("nodes", []), header.get("meshes", [])
    primitives = [primitive for mesh in meshes for primitive in mesh["primitives"]]
    lacking = [name for name in header.get("extensionsRequired", ()) if not name.startswith(looks)]
    lacking += [name for node in nodes for name in node.get("extensions", ()) if name == "EXT_mesh_gpu_instancing"]
    lacking += ["triangle strips or fans" for primitive in primitives if primitive.get("mode", 4) in (5, 6)]
    lacking += ["sparse accessors" for accessor in accessors if "sparse" in accessor]
    lacking += ["a mesh below a camera" for node in nodes if "camera" in node and {"mesh", "children"} & {*node}]
    lacking += ["no scene"] * (not header.get("scenes"))
    for attributes in (p["attributes"] for n in nodes if "skin" in n for p in meshes[n["mesh"]]["primitives"]):
        lacking += ["a skin without joints or weights"] * (not {"JOINTS_0", "WEIGHTS_0"} <= {*attributes})
    for primitive in primitives:
        position = accessors[primitive["attributes"]["POSITION"]]
        if "bufferView" not in position and "sparse" not in position:
            lacking += primitive.get("extensions") or ["meshes without data"]
        step = np.iinfo("bBhH"[position["componentType"] - 5120]).max if position.get("normalized") else 1
        content.scales += [1.0 / step] * (primitive.get("mode", 4) in (0, 1, 4))
        uv = primitive["attributes"].get("TEXCOORD_0")
        lacking += ["quantised texture coordinates"] * (uv is not None and accessors[uv]["componentType"] != 5126)
    if lacking:
        raise InvalidInputError(
            f"{content.path} holds {', '.join(dict.fromkeys(lacking))}, which cannot be read; export it without "
            "(compression and instancing are options of the exporter)"
        )
    used = {n for n in header.get("extensionsUsed", ()) if n in lost or not n.startswith(looks)}
    own = {n for some in (*nodes, *primitives, *header.get("materials", ())) for n in some.get("extensions", ())}
    used |= {n for n in own if n in lost or not n.startswith(looks)} | {"animations"} & {*header}
    used |= {"COLOR_0 beside a material" for p in primitives if "COLOR_0" in p["attributes"] and "material" in p}
    colors = [m.get("pbrMetallicRoughness", {}).get("baseColorTexture", {}) for m in header.get("materials", ())]
    used |= {f"texture by TEXCOORD_{image['texCoord']}" for image in colors if image.get("texCoord")}
    content.notes += ["its line strips are left out"] * any(p.get("mode") in (2, 3) for p in primitives)
    used |= {"morph targets" for some in [*nodes, *meshes] if any(some.get("weights", ()))}
    content.notes += [f"its {name} is not applied" for name in sorted(used)]
    uris = [image.get("uri", "data:") for image in header.get("images", ())]
    content.expect([uri for uri in uris if not uri.startswith("data:")], "texture")
    content.names |= {mesh["name"]: mesh["name"] for mesh in meshes if "name" in mesh}
    roots = {*range(len(nodes))} - {child for node in nodes for child in node.get("children", ())}
    if apart := len(roots - {*header["scenes"][header.get("scene", 0)].get("nodes", ())}):
        content.notes.append(f"{apart} node(s) outside its scene are left out")

    if not (skins := header.get("skins")):
        return
    for index, node in enumerate(nodes):  # what trimesh keeps of them
        node["extras"] = {"index": index, "skin": node.get("skin")}
    for attributes in (primitive["attributes"] for primitive in primitives):
        attributes |= {f"_{name}": at for name, at in attributes.items() if name.startswith(("JOINTS_", "WEIGHTS_"))}
        attributes |= {f"_{i}": s["inverseBindMatrices"] for i, s in enumerate(skins) if "inverseBindMatrices" in s}
    content.joints = [skin.get("joints", []) for skin in skins]
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    rest = content.data[20 + int.from_bytes(content.data[12:16], "little") :]
    head = struct.pack("<4s3I4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    content.data = head + text + rest if content.type == "glb" else text


def _pose_gltf(parts: dict[str, Any], skins: list[list[int]]) -> None:
    """Give the meshes with a skin, of the parts of a scene, the shape that their joints give them."""
    base = parts["base_frame"]
    frames, nodes = {base: np.eye(4)}, {}
    for edge in parts["graph"]:  # the parents of a frame come before it
        frames[edge["frame_to"]] = frames[edge["frame_from"]] @ edge["matrix"]
        nodes[edge.get("metadata", {}).get("index")] = frames[edge["frame_to"]]
    for edge in [edge for edge in parts["graph"] if skins and "geometry" in edge]:
        if (skin := edge["metadata"]["skin"]) is None:
            continue
        if lost := {*skins[skin]} - {*nodes}:
            raise ValueError(f"the nodes {sorted(lost)}, joints of a skin, are not in its scene")
        old = edge.pop("geometry")
        mesh, new = {**parts["geometry"][old], "vertex_normals": None}, f"{old}_at the joints of {edge['frame_to']}"
        given = mesh.pop("vertex_attributes")
        joints, weights = (
            np.concatenate([given[key] for key in sorted(given) if key.startswith(kind)], axis=1)
            for kind in ("_JOINTS_", "_WEIGHTS_")
        )
        binds = given.get(f"_{skin}", np.eye(4)).swapaxes(-1, -2)  # matrices of glTF have their columns first
        matrices = np.array([nodes[joint] for joint in skins[skin]]) @ binds
        rows = np.repeat(np.arange(len(joints)), joints.shape[1])
        mesh["vertices"] = _skinned(mesh["vertices"], rows, joints.ravel(), weights.ravel(), matrices)
        parts["geometry"][new] = mesh
        parts["graph"].append({"frame_from": base, "frame_to": new, "matrix": np.eye(4), "geometry": new})


_PREPARED = {
    ".obj": _prepare_obj, ".off": _prepare_off, ".dae": _prepare_dae, ".glb": _prepare_gltf, ".gltf": _prepare_gltf,
    ".stl": _prepare_stl, ".ply": _prepare_ply,
}  # fmt: skip


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
    corners = np.asarray(mesh.vertices)[faces].reshape(-1, 3)
    _, point = _different_rows(corners)
    normals = _corner_normals(mesh, point)
    rows = np.column_stack([np.round(normals.reshape(-1, 3) * 1e4), colors.reshape(-1, 3)]).astype(np.int64)
    first, index = _different_rows(np.column_stack([point, rows]))
    rgba = np.column_stack([colors.reshape(-1, 3)[first], np.full(len(first), 255, dtype=np.uint8)])
    return trimesh.Trimesh(
        vertices=corners[first],
        faces=index.reshape(-1, 3),
        vertex_normals=normals.reshape(-1, 3)[first],
        vertex_colors=rgba,
        process=False,
    )


def _different_rows(rows: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where each different row of (n, k) stands first, in their order, and which of them each of the n is.

    As ``numpy.unique`` of an axis, in a quarter of its time.
    """
    order = np.lexsort(rows.T[::-1])
    is_new = np.append(True, (rows[order[1:]] != rows[order[:-1]]).any(axis=1))[: len(rows)]
    index = np.empty(len(rows), dtype=np.int64)
    index[order] = np.cumsum(is_new) - 1
    return order[is_new], index


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


def _corner_normals(mesh: trimesh.Trimesh, point: NDArray[np.int64]) -> Array:
    """(F, 3, 3): at each corner, of the points (3 F,), the normal of the faces around it that meet at less than 40
    degrees.
    """
    faces = np.asarray(mesh.faces)
    triangles = np.asarray(mesh.vertices)[faces]
    area = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])  # (F, 3)
    length = np.linalg.norm(area, axis=1, keepdims=True)
    unit = np.divide(area, length, out=np.tile([0.0, 0.0, 1.0], (len(area), 1)), where=length > 0)
    flat = np.repeat(unit[:, None], 3, axis=1)
    if len(faces) > _MAX_SMOOTHED:
        return flat
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
    """The root element of an XML file. Names keep their prefixes, which need no declaration, and comments may come
    before the declaration, as in other readers. Raises CorruptFileError, with the line, for a file that cannot be read
    or is no XML, and as :func:`check_file` does.
    """
    return _parsed(_read(path), path)


def _parsed(data: bytes, path: Path) -> Element:
    """The root element of the content of the XML file at ``path``."""
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.CharacterDataHandler = builder.start, builder.data
    parser.EndElementHandler = builder.end
    try:
        parser.Parse(_BEFORE_XML.sub(b"", data), True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last two: its encoding
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
    """The file that ``uri`` names in the model at ``path``: relative, absolute, file://, package:// or model://.

    A package is a folder above the model, or beside one of these, with that name or with that name in its
    ``package.xml``, or a folder of the paths of ROS and Gazebo. InvalidInputError names the places searched.
    """
    text = uri.strip()
    scheme, separator, rest = text.partition("://")
    if not separator:
        scheme, rest = "", text
    if scheme not in ("", "file", "package", "model"):
        raise InvalidInputError(f"{path}: {where} refers to {uri!r}; only files, package:// and model:// can be read")
    for named in dict.fromkeys((rest, unquote(rest))):
        for candidate in _places(scheme, Path(named.replace("\\", "/")), path.parent):
            if candidate.is_file():
                return candidate.resolve()
    more = f", a package above or beside it, or the folders of {FORMATS['package paths']}" if scheme else ""
    raise InvalidInputError(f"{path}: {where} refers to the mesh {uri!r}, which does not exist in {path.parent}{more}")


def _places(scheme: str, rest: Path, folder: Path) -> Iterator[Path]:
    """Files that a URI of this scheme and path may name, in the order of the search."""
    yield rest if scheme == "file" else folder / rest
    paths = [os.environ.get(name, "") for name in FORMATS["package paths"].split()] if scheme else []
    roots = [Path(root) for path in paths for root in path.split(os.pathsep) if root]
    roots += [root / "share" for root in roots]  # a prefix of ROS 2
    yield from (root / rest for root in roots)
    if scheme not in ("package", "model"):
        return
    package, inside = rest.parts[0] if rest.parts else "", Path(*rest.parts[1:])
    above = (folder, *folder.parents)
    yield from (parent / inside if parent.name == package else parent / rest for parent in above)
    yield from (root / inside for root in roots if root.name == package)
    for parent in (*above, *roots):
        for manifest in (parent / "package.xml", *sorted(parent.glob("*/package.xml"))):
            with suppress(OSError, SceneEnvsError):
                if (read_xml(manifest).findtext("name") or "").strip() == package:
                    yield manifest.parent / inside
    yield folder / inside
