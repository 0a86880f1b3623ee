"""Readers of SDF and URDF: the links of one model merged at zero joint positions."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array
from scene_envs.assets.importing.mesh_files import (
    Color,
    Inertial,
    Model,
    Shape,
    color_of,
    find_mesh,
    from_roll_pitch_yaw,
    moved_inertial,
    numbers,
    pose_of,
    positive,
    read_xml,
)
from scene_envs.errors import CorruptFileError, InvalidInputError

_RADII = {"cylinder": ("radius", "length"), "capsule": ("radius", "length"), "sphere": ("radius",)}
_ZERO = (0.0, 0.0, 0.0)


def read_sdf(path: Path) -> Model:
    """The model in an SDF file, in the model frame; the model's pose in its world is ignored. Raises CorruptFileError
    for a file that is no SDF or contradicts itself, InvalidInputError for several models, an include or a missing mesh.
    """
    model = _only_model(path)
    links = {link.get("name", ""): link for link in model.findall("link")}
    if not links:
        raise CorruptFileError(f"{path}: model {model.get('name')!r} holds no <link>")
    frames = _Frames(model, path)
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    inertials: list[Inertial] = []
    notes: list[str] = []
    for name, link in links.items():
        pose = frames.pose(name)
        for tag, shapes in (("visual", visuals), ("collision", collisions)):
            for index, element in enumerate(link.findall(tag), start=1):
                where = f"{tag} {index} of link {name!r}"
                shape = _sdf_shape(element, pose @ frames.local(element, name, where), path, where)
                if shape is None:
                    notes.append(f"{where} is an endless plane, which is left out")
                else:
                    shapes.append(shape)
        inertial = link.find("inertial")
        if inertial is not None:
            inertials.append(moved_inertial(pose, _sdf_inertial(inertial, path, f"inertial of link {name!r}")))
    movable = [j.get("name", "?") for j in model.findall("joint") if j.get("type") != "fixed"]
    if movable:
        notes.append(f"movable joints frozen at zero: {', '.join(movable)}")
    static = True if _flag(model.findtext("static")) else None
    if static:
        notes.append("the file says static: it is welded (`welded: false` makes it free)")
    return Model(tuple(visuals), tuple(collisions), tuple(inertials), static, tuple(notes))


def _only_model(path: Path) -> Element:
    root = read_xml(path)
    if root.tag != "sdf":
        raise CorruptFileError(f"{path} is not an SDF: its root is <{root.tag}>, not <sdf>")
    models = [*root.findall("model"), *root.findall("world/model")]
    if not models:
        has_include = root.find(".//include") is not None
        raise InvalidInputError(
            f"{path} holds no <model>"
            + ("; files that it includes are not followed, name them in library.yaml instead" if has_include else "")
        )
    if len(models) > 1:
        names = ", ".join(repr(model.get("name")) for model in models)
        raise InvalidInputError(f"{path} holds {len(models)} models ({names}); an asset is one, so put each in a file")
    for nested in ("model", "include"):
        if models[0].find(nested) is not None:
            raise InvalidInputError(
                f"{path}: model {models[0].get('name')!r} holds a nested <{nested}>, which is not read"
            )
    return models[0]


class _Frames:
    """Poses of links, joints and frames in the model frame, by the rules of SDFormat 1.7 and later."""

    def __init__(self, model: Element, path: Path) -> None:
        self._path = path
        self._elements: dict[str, tuple[Element, str]] = {}  # element, and the default base of its pose
        for link in model.findall("link"):
            self._elements[link.get("name", "")] = link, "__model__"
        for joint in model.findall("joint"):
            self._elements.setdefault(joint.get("name", ""), (joint, (joint.findtext("child") or "").strip()))
        for frame in model.findall("frame"):
            self._elements.setdefault(frame.get("name", ""), (frame, frame.get("attached_to") or "__model__"))

    def pose(self, name: str, waiting: tuple[str, ...] = ()) -> Array:
        """(4, 4) of the frame called ``name``."""
        if name in ("__model__", ""):
            return np.eye(4)
        if name not in self._elements:
            raise CorruptFileError(f"{self._path}: a pose is relative to {name!r}, which does not exist")
        if name in waiting:
            raise CorruptFileError(f"{self._path}: the poses of {', '.join(map(repr, waiting))} refer to each other")
        element, default = self._elements[name]
        pose = element.find("pose")
        base = default if pose is None else pose.get("relative_to") or default
        return self.pose(base, (*waiting, name)) @ _pose(pose, self._path, repr(name))

    def local(self, element: Element, link: str, where: str) -> Array:
        """(4, 4) of a visual or collision in its link's frame."""
        pose = element.find("pose")
        local = _pose(pose, self._path, where)
        base = None if pose is None else pose.get("relative_to")
        return np.linalg.inv(self.pose(link)) @ self.pose(base) @ local if base else local


def _pose(element: Element | None, path: Path, where: str) -> Array:
    if element is None:
        return np.eye(4)
    if element.get("rotation_format") == "quat_xyzw":
        values = numbers(element.text, 7, path, f"pose of {where}", (0.0,) * 6 + (1.0,))
        return pose_of(values[:3], np.asarray(Rotation.from_quat(values[3:]).as_matrix()))
    values = numbers(element.text, 6, path, f"pose of {where}", (0.0,) * 6)
    angles = np.radians(values[3:]) if _flag(element.get("degrees")) else values[3:]
    return pose_of(values[:3], from_roll_pitch_yaw(angles))


def _geometry(element: Element, path: Path, where: str) -> Element:
    """What stands first in the ``geometry`` of an element."""
    geometry = element.find("geometry")
    kinds = [] if geometry is None else [child for child in geometry if isinstance(child.tag, str)]
    if not kinds:
        raise CorruptFileError(f"{path}: {where} has no geometry")
    return kinds[0]


def _sdf_shape(element: Element, pose: Array, path: Path, where: str) -> Shape | None:
    kind = _geometry(element, path, where)
    color = color_of(element.findtext("material/diffuse"), path, f"colour of {where}")
    if kind.tag == "plane":
        return None
    if kind.tag == "mesh":
        uri = kind.findtext("uri")
        if not uri:
            raise CorruptFileError(f"{path}: the mesh of {where} has no <uri>")
        scale = numbers(kind.findtext("scale"), 3, path, f"mesh scale of {where}", (1.0, 1.0, 1.0))
        convex = any(child.tag.endswith("declare_convex") for child in kind)
        return Shape("mesh", tuple(scale.tolist()), pose, where, find_mesh(uri, path, where), color, convex)
    if kind.tag == "box":
        return Shape("box", positive(kind.findtext("size"), 3, path, f"box size of {where}"), pose, where, None, color)
    if kind.tag == "ellipsoid":
        radii = positive(kind.findtext("radii"), 3, path, f"radii of {where}")
        return Shape("ellipsoid", radii, pose, where, None, color)
    if kind.tag in _RADII:
        size = [positive(kind.findtext(key), 1, path, f"{kind.tag} {key} of {where}")[0] for key in _RADII[kind.tag]]
        return Shape(kind.tag, tuple(size), pose, where, None, color)  # type: ignore[arg-type]
    known = "mesh, box, cylinder, sphere, capsule and ellipsoid"
    raise CorruptFileError(f"{path}: {where} is a <{kind.tag}>; known are {known}")


def _sdf_inertial(element: Element, path: Path, where: str) -> Inertial:
    mass = numbers(element.findtext("mass"), 1, path, f"mass in {where}", (1.0,))[0]  # the default of SDFormat
    xx, yy, zz, xy, xz, yz = (
        numbers(element.findtext(f"inertia/{key}"), 1, path, f"{key} in {where}", (default,))[0]
        for key, default in (("ixx", 1.0), ("iyy", 1.0), ("izz", 1.0), ("ixy", 0.0), ("ixz", 0.0), ("iyz", 0.0))
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return moved_inertial(_pose(element.find("pose"), path, where), Inertial(float(mass), np.zeros(3), matrix))


def _flag(text: str | None) -> bool:
    return (text or "").strip().lower() in ("1", "true")


def read_urdf(path: Path) -> Model:
    """The model in a URDF file, in the frame of its root link; movable joints are frozen at zero and listed in a note.
    Raises CorruptFileError for a file that is no URDF or contradicts itself, InvalidInputError for a missing mesh.
    """
    robot = read_xml(path)
    if robot.tag != "robot":
        raise CorruptFileError(f"{path} is not a URDF: its root is <{robot.tag}>, not <robot>")
    links = {link.get("name", ""): link for link in robot.findall("link")}
    if not links:
        raise CorruptFileError(f"{path} holds no <link>")
    poses, movable = _link_poses(robot, links, path)
    materials = {m.get("name", ""): _own_color(m, path) for m in robot.findall("material")}
    for link in links.values():  # a material may be defined inside any visual
        for material in link.findall("visual/material"):
            if material.find("color") is not None:
                materials[material.get("name", "")] = _own_color(material, path)
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    inertials = []
    for name, link in links.items():
        for tag, shapes, known in (("visual", visuals, materials), ("collision", collisions, {})):
            for index, element in enumerate(link.findall(tag), start=1):
                shapes.append(_urdf_shape(element, poses[name], known, path, f"{tag} {index} of link {name!r}"))
        inertial = link.find("inertial")
        if inertial is not None:
            inertials.append(moved_inertial(poses[name], _urdf_inertial(inertial, path, f"inertial of link {name!r}")))
    notes = [f"movable joints frozen at zero: {', '.join(movable)}"] if movable else []
    static = True if inertials and all(inertial.mass == 0 for inertial in inertials) else None
    if static:
        notes.append("the file gives mass 0: it is welded (`welded: false` makes it free)")
    return Model(tuple(visuals), tuple(collisions), tuple(inertials), static, tuple(notes))


def _link_poses(robot: Element, links: dict[str, Element], path: Path) -> tuple[dict[str, Array], list[str]]:
    """(4, 4) of each link in the root link's frame, and the names of movable joints."""
    parents: dict[str, tuple[str, Array]] = {}
    movable = []
    for joint in robot.findall("joint"):
        name = joint.get("name", "?")
        ends = [element.get("link", "") if (element := joint.find(t)) is not None else "" for t in ("parent", "child")]
        for end in ends:
            if end not in links:
                raise CorruptFileError(f"{path}: joint {name!r} connects link {end!r}, which does not exist")
        parent, child = ends
        if child in parents:
            raise CorruptFileError(f"{path}: link {child!r} is the child of two joints; a URDF is a tree")
        parents[child] = (parent, _origin(joint, path, f"joint {name!r}"))
        if joint.get("type") != "fixed":
            movable.append(name)
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        found = ", ".join(map(repr, roots)) or "none (its joints form a loop)"
        raise CorruptFileError(f"{path}: a URDF has one root link, this one has {found}")
    poses = {roots[0]: np.eye(4)}
    while len(poses) < len(links):
        reached = {child: poses[p] @ pose for child, (p, pose) in parents.items() if p in poses and child not in poses}
        if not reached:
            loop = sorted(set(links) - set(poses))
            raise CorruptFileError(f"{path}: links {', '.join(map(repr, loop))} hang on each other in a loop")
        poses |= reached
    return poses, movable


def _origin(element: Element, path: Path, where: str) -> Array:
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    xyz = numbers(origin.get("xyz"), 3, path, f"origin xyz of {where}", _ZERO)
    rpy = numbers(origin.get("rpy"), 3, path, f"origin rpy of {where}", _ZERO)
    return pose_of(xyz, from_roll_pitch_yaw(rpy))


def _own_color(material: Element, path: Path) -> Color | None:
    element = material.find("color")
    return None if element is None else color_of(element.get("rgba"), path, f"material {material.get('name')!r}")


def _urdf_shape(element: Element, link: Array, materials: dict[str, Color | None], path: Path, where: str) -> Shape:
    pose = link @ _origin(element, path, where)
    material = element.find("material")
    color = None if material is None else _own_color(material, path) or materials.get(material.get("name", ""))
    kind = _geometry(element, path, where)
    if kind.tag == "mesh":
        filename = kind.get("filename")
        if not filename:
            raise CorruptFileError(f"{path}: the mesh of {where} has no filename")
        scale = kind.get("scale")
        count = len((scale or "").split())
        size = numbers(scale, 1 if count == 1 else 3, path, f"mesh scale of {where}", (1.0, 1.0, 1.0))
        convex = any(child.tag.endswith("declare_convex") for child in kind)
        sizes = tuple(np.broadcast_to(size, 3).tolist())
        return Shape("mesh", sizes, pose, where, find_mesh(filename, path, where), color, convex)
    if kind.tag == "box":
        return Shape("box", positive(kind.get("size"), 3, path, f"box size of {where}"), pose, where, None, color)
    if kind.tag in _RADII:
        sizes = tuple(positive(kind.get(k), 1, path, f"{kind.tag} {k} of {where}")[0] for k in _RADII[kind.tag])
        return Shape(kind.tag, sizes, pose, where, None, color)  # type: ignore[arg-type]
    raise CorruptFileError(f"{path}: {where} is a <{kind.tag}>; known are mesh, box, cylinder, sphere and capsule")


def _urdf_inertial(element: Element, path: Path, where: str) -> Inertial:
    mass_element, tensor = element.find("mass"), element.find("inertia")
    mass = numbers(None if mass_element is None else mass_element.get("value"), 1, path, f"mass in {where}", (0.0,))[0]
    xx, yy, zz, xy, xz, yz = (
        numbers(None if tensor is None else tensor.get(key), 1, path, f"{key} in {where}", (0.0,))[0]
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return moved_inertial(_origin(element, path, where), Inertial(float(mass), np.zeros(3), matrix))
