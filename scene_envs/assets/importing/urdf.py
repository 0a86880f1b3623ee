"""URDF reader: links merged at zero joint positions into one rigid model."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.importing.model import (
    Color,
    Inertial,
    Model,
    Shape,
    from_roll_pitch_yaw,
    moved_inertial,
    pose_of,
)
from scene_envs.assets.importing.xml_files import color_of, find_mesh, numbers, positive, read_xml
from scene_envs.errors import CorruptFileError

_ZERO = (0.0, 0.0, 0.0)


def read_urdf(path: Path) -> Model:
    """The model in a URDF file, in the frame of its root link.

    Movable joints are frozen at zero and listed in a note.

    Raises:
        CorruptFileError: not a URDF, or one that contradicts itself; the place is named.
        InvalidInputError: a mesh it refers to does not exist.
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
    visuals, collisions, inertials = [], [], []
    for name, link in links.items():
        for index, element in enumerate(link.findall("visual"), start=1):
            where = f"visual {index} of link {name!r}"
            visuals.append(_shape(element, poses[name], materials, path, where))
        for index, element in enumerate(link.findall("collision"), start=1):
            collisions.append(_shape(element, poses[name], {}, path, f"collision {index} of link {name!r}"))
        inertial = link.find("inertial")
        if inertial is not None:
            inertials.append(moved_inertial(poses[name], _inertial(inertial, path, f"inertial of link {name!r}")))
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


def _shape(element: Element, link: Array, materials: dict[str, Color | None], path: Path, where: str) -> Shape:
    pose = link @ _origin(element, path, where)
    material = element.find("material")
    color = None if material is None else _own_color(material, path) or materials.get(material.get("name", ""))
    geometry = element.find("geometry")
    kinds = [] if geometry is None else [child for child in geometry if isinstance(child.tag, str)]
    if not kinds:
        raise CorruptFileError(f"{path}: {where} has no geometry")
    kind = kinds[0]
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
    if kind.tag == "sphere":
        radius = positive(kind.get("radius"), 1, path, f"sphere radius of {where}")
        return Shape("sphere", radius, pose, where, None, color)
    if kind.tag in ("cylinder", "capsule"):
        sizes = (
            *positive(kind.get("radius"), 1, path, f"{kind.tag} radius of {where}"),
            *positive(kind.get("length"), 1, path, f"{kind.tag} length of {where}"),
        )
        return Shape("capsule" if kind.tag == "capsule" else "cylinder", sizes, pose, where, None, color)
    raise CorruptFileError(
        f"{path}: {where} is a <{kind.tag}>; known are mesh, box, cylinder, sphere and capsule"
    )  # fmt: skip


def _inertial(element: Element, path: Path, where: str) -> Inertial:
    mass_element, tensor = element.find("mass"), element.find("inertia")
    mass = numbers(None if mass_element is None else mass_element.get("value"), 1, path, f"mass in {where}", (0.0,))[0]
    xx, yy, zz, xy, xz, yz = (
        numbers(None if tensor is None else tensor.get(key), 1, path, f"{key} in {where}", (0.0,))[0]
        for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return moved_inertial(_origin(element, path, where), Inertial(float(mass), np.zeros(3), matrix))
