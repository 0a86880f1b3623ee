"""Readers of SDF and URDF: the links of one model merged at zero joint positions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from itertools import product
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
    heavier,
    merged_inertial,
    moved_inertial,
    numbers,
    pose_of,
    positive,
    read_xml,
)
from scene_envs.assets.importing.solids import solid_of
from scene_envs.errors import CorruptFileError, InvalidInputError

_RADII = {"cylinder": ("radius", "length"), "capsule": ("radius", "length"), "sphere": ("radius",)}
_ZERO = (0.0, 0.0, 0.0)
_FREE = ("floating", "planar")
"""Types of joints that leave their child free."""
_TO_WORLD = "a joint holds it at `world`: it is welded (`welded: false` makes it free)"
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def _table(text: str) -> dict[str, list[str]]:
    return {key.strip(): names.split() for key, names in (entry.split(": ") for entry in text.split(";"))}


READ = {
    "URDF": _table("""
        robot: link* joint* material*; link: @name inertial visual* collision*; joint: @name @type origin parent child;
        parent: @link; child: @link; origin: @xyz @rpy @quat_xyzw; inertial: origin mass inertia; mass: @value;
        inertia: @ixx @iyy @izz @ixy @ixz @iyz; visual: origin geometry material; collision: origin geometry;
        geometry: mesh box cylinder sphere capsule; mesh: @filename @scale drake:declare_convex; box: @size;
        cylinder: @radius @length; capsule: @radius @length; sphere: @radius; material: @name color; color: @rgba
    """),
    "SDF": _table("""
        sdf: model* world*; world: model* joint*; model: @name link* joint* frame* static;
        link: @name pose inertial visual* collision*; joint: @name @type pose parent child;
        frame: @name @attached_to pose; pose: @relative_to @rotation_format @degrees;
        inertial: @auto pose mass inertia density; inertia: ixx iyy izz ixy ixz iyz; visual: pose geometry material;
        collision: pose geometry density material_density;
        geometry: mesh box cylinder sphere capsule ellipsoid plane empty;
        mesh: @optimization uri scale submesh drake:declare_convex; submesh: name center; box: size;
        cylinder: radius length; capsule: radius length; sphere: radius; ellipsoid: radii; material: diffuse
    """),
}
"""What is read of a file: children and @attributes of each element, those with a * any number of times."""
IGNORED = {
    "URDF": _table("""
        names change no body: robot/@name robot/@version visual/@name collision/@name link/@type;
        joints are frozen at zero: joint/axis joint/limit joint/dynamics joint/mimic joint/calibration
            joint/safety_controller robot/transmission;
        it is output for debugging: collision/verbose
    """),
    "SDF": _table("""
        names change no body: sdf/@version world/@name visual/@name collision/@name model/@namespace visual/meta;
        an asset has the frame of its model: model/pose model/@canonical_link model/@placement_frame world/frame;
        joints are frozen at zero: joint/axis joint/axis2 joint/physics joint/gearbox_ratio
            joint/gearbox_reference_body joint/thread_pitch joint/screw_thread_pitch;
        a scene has its own world: world/audio world/wind world/gravity world/magnetic_field world/atmosphere
            world/gui world/physics world/scene world/light world/spherical_coordinates world/state;
        they are settings of a simulator: model/self_collide model/allow_auto_disable model/enable_wind
            link/self_collide link/enable_wind link/must_be_base_link link/velocity_decay collision/laser_retro
            collision/max_contacts visual/laser_retro visual/cast_shadows visual/visibility_flags
            mesh/convex_decomposition;
        pictures show one opaque colour: visual/transparency material/ambient material/specular material/shininess
            material/emissive material/lighting material/render_order material/double_sided;
        planes are endless and left out: plane/normal plane/size
    """),
}
"""What is left out of a file on purpose, by reason. The report names everything else."""


def _unread(root: Element, kind: str) -> tuple[str, ...]:
    """A note that names the elements and attributes that are neither read nor left out on purpose, if any."""
    left_out = {name for names in IGNORED[kind].values() for name in names}
    found: Counter[str] = Counter()

    def visit(element: Element) -> None:
        read = READ[kind].get(element.tag, [])
        names = [f"@{key}" for key in element.attrib if key.partition(":")[0] != "xmlns"]
        for name, count in Counter([*names, *(child.tag for child in element)]).items():
            place = f"{element.tag}/{name}"
            if name not in read and f"{name}*" not in read and place not in left_out:
                found[place] += count
            elif name in read and count > 1:
                found[f"second {place}"] += count - 1
        if element.tag == "geometry" and len(element) > 1:
            found["second geometry"] += 1
        for child in element:
            if child.tag in read or f"{child.tag}*" in read:
                visit(child)

    visit(root)
    if not found:
        return ()
    return (f"not read: {', '.join(name + (f' ({n} times)' if n > 1 else '') for name, n in found.items())}",)


def _named(elements: list[Element], path: Path) -> dict[str, Element]:
    """Links by name; CorruptFileError for two of one name, of which one would be lost."""
    links = {link.get("name", ""): link for link in elements}
    if len(links) < len(elements):
        name = Counter(link.get("name", "") for link in elements).most_common(1)[0][0]
        raise CorruptFileError(f"{path} holds several links called {name!r}; give each its own name")
    return links


def read_sdf(path: Path) -> Model:
    """The model in an SDF file, in the model frame; the model's pose in its world is ignored. Raises CorruptFileError
    for a file that is no SDF or contradicts itself, InvalidInputError for several models, an include or a missing mesh.
    """
    root = read_xml(path)
    model = _only_model(root, path)
    links = _named(model.findall("link"), path)
    if not links:
        raise CorruptFileError(f"{path}: model {model.get('name')!r} holds no <link>")
    frames = _Frames(model, path)
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    inertials: list[Inertial] = []
    notes = list(_unread(root, "SDF"))
    for name, link in links.items():
        pose = frames.pose(name)
        before = len(collisions)
        densities: list[float | None] = []
        for tag, shapes in (("visual", visuals), ("collision", collisions)):
            for index, element in enumerate(link.findall(tag), start=1):
                where = f"{tag} {index} of link {name!r}"
                shape = _sdf_shape(element, pose @ frames.local(element, name, where), path, where)
                if isinstance(shape, str):
                    notes.append(f"{where} {shape}, which is left out")
                    continue
                shapes.append(shape)
                if tag == "collision":
                    densities.append(_density(element, path, where))
        inertial, where = link.find("inertial"), f"inertial of link {name!r}"
        if inertial is not None and _flag(inertial.get("auto")):
            default = _density(inertial, path, where) or 1000.0  # that of SDFormat
            solids = map(solid_of, collisions[before:])
            filled = [heavier(i, density or default) for i, density in zip(solids, densities, strict=True)]
            if filled:
                merged = merged_inertial(tuple(filled))
                mass = numbers(inertial.findtext("mass"), 1, path, f"mass in {where}", (merged.mass,))[0]
                inertials.append(heavier(merged, float(mass) / merged.mass))
        elif inertial is not None:
            inertials.append(moved_inertial(pose, _sdf_inertial(inertial, path, where)))
    joints = [*model.findall("joint"), *root.findall("world/joint")]
    for joint, end in product(model.findall("joint"), ("parent", "child")):
        if (name := (joint.findtext(end) or "").strip()) != "world":
            frames.pose(name)
    movable = [j.get("name", "?") for j in joints if j.get("type") != "fixed"]
    if movable:
        notes.append(f"movable joints frozen at zero: {', '.join(movable)}")
    static = True if _flag(model.findtext("static")) else None
    if static:
        notes.append("the file says static: it is welded (`welded: false` makes it free)")
    elif any("world" in ((joint.findtext(end) or "").strip() for end in ("parent", "child")) for joint in joints):
        static = True
        notes.append(_TO_WORLD)
    return Model(tuple(visuals), tuple(collisions), tuple(inertials), static, tuple(notes))


def _density(element: Element, path: Path, where: str) -> float | None:
    """The density (kg/m^3) that a collision or inertial gives, if any."""
    text = element.findtext("density") or element.findtext("material_density")
    return positive(text, 1, path, f"density of {where}")[0] if text else None


def _only_model(root: Element, path: Path) -> Element:
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
            raise CorruptFileError(f"{self._path}: a pose or a joint refers to {name!r}, which does not exist")
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
        return pose_of(values[:3], _from_quaternion(values[3:], path, where))
    values = numbers(element.text, 6, path, f"pose of {where}", (0.0,) * 6)
    angles = np.radians(values[3:]) if _flag(element.get("degrees")) else values[3:]
    return pose_of(values[:3], from_roll_pitch_yaw(angles))


def _from_quaternion(quaternion: Array, path: Path, where: str) -> Array:
    """(3, 3) rotation of a quaternion (x, y, z, w) of any length above 0."""
    if not quaternion.any():
        raise CorruptFileError(f"{path}: the quaternion of {where} is 0; no rotation is `0 0 0 1`")
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


def _geometry(element: Element, path: Path, where: str) -> Element:
    """What stands first in the ``geometry`` of an element."""
    geometry = element.find("geometry")
    kinds = [] if geometry is None else [child for child in geometry if isinstance(child.tag, str)]
    if not kinds:
        raise CorruptFileError(f"{path}: {where} has no geometry")
    return kinds[0]


def _is_point(element: Element, sizes: Iterable[str | None]) -> bool:
    """Whether a visual has a size of 0, which other readers take as well; sizes of collisions are above 0."""
    words = " ".join(size or "" for size in sizes).split()
    return element.tag == "visual" and any(not word.strip("+-0.,") for word in words)


def _sdf_shape(element: Element, pose: Array, path: Path, where: str) -> Shape | str:
    """The shape of a visual or collision, or why it is none."""
    kind = _geometry(element, path, where)
    color = color_of(element.findtext("material/diffuse"), path, f"colour of {where}")
    if kind.tag in ("plane", "empty"):
        return "is an endless plane" if kind.tag == "plane" else "is empty"
    if kind.tag != "mesh" and _is_point(element, (child.text for child in kind)):
        return "has a size of 0"
    if kind.tag == "mesh":
        uri = kind.findtext("uri")
        if not uri:
            raise CorruptFileError(f"{path}: the mesh of {where} has no <uri>")
        scale = numbers(kind.findtext("scale"), 3, path, f"mesh scale of {where}", (1.0, 1.0, 1.0))
        convex = kind.find("drake:declare_convex") is not None or kind.get("optimization") == "convex_hull"
        name = (kind.findtext("submesh/name") or "").strip()
        part = (name, _flag(kind.findtext("submesh/center"))) if name else None
        return Shape("mesh", tuple(scale.tolist()), pose, where, find_mesh(uri, path, where), color, convex, part)
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
    default = 0.0 if element.find("inertia") is None else 1.0  # of SDFormat; without any, the shape decides
    xx, yy, zz, xy, xz, yz = (
        numbers(element.findtext(f"inertia/{key}"), 1, path, f"{key} in {where}", (default * (key[1] == key[2]),))[0]
        for key in _MOMENTS
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
    links = _named(robot.findall("link"), path)
    if not links:
        raise CorruptFileError(f"{path} holds no <link>")
    if any(element.tag.startswith("xacro:") for element in robot.iter()):
        raise CorruptFileError(f"{path} holds <xacro:...> elements; expand it with xacro first")
    parents = [parent.get("link") for parent in robot.findall("joint/parent")]
    if "world" in parents:  # a link that need not be declared
        links.setdefault("world", Element("link", name="world"))
    poses, movable = _link_poses(robot, links, path)
    materials = {m.get("name", ""): _own_color(m, path) for m in robot.findall("material")}
    for link in links.values():  # a material may be defined inside any visual
        for material in link.findall("visual/material"):
            if material.find("color") is not None:
                materials[material.get("name", "")] = _own_color(material, path)
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    inertials = []
    notes = list(_unread(robot, "URDF"))
    for name, link in links.items():
        for tag, shapes, known in (("visual", visuals, materials), ("collision", collisions, {})):
            for index, element in enumerate(link.findall(tag), start=1):
                where = f"{tag} {index} of link {name!r}"
                shape = _urdf_shape(element, poses[name], known, path, where)
                if isinstance(shape, str):
                    notes.append(f"{where} {shape}, which is left out")
                else:
                    shapes.append(shape)
        inertial = link.find("inertial")
        if inertial is not None:
            inertials.append(moved_inertial(poses[name], _urdf_inertial(inertial, path, f"inertial of link {name!r}")))
    if movable:
        notes.append(f"movable joints frozen at zero: {', '.join(movable)}")
    static = True if inertials and all(inertial.mass == 0 for inertial in inertials) else None
    if static:
        notes.append("the file gives mass 0: it is welded (`welded: false` makes it free)")
    elif _held(robot):
        static = True
        notes.append(_TO_WORLD)
    return Model(tuple(visuals), tuple(collisions), tuple(inertials), static, tuple(notes))


def _held(robot: Element) -> bool:
    """Whether a joint that does not leave its child free hangs on the link ``world``."""
    joints = [joint for joint in robot.findall("joint") if joint.get("type") not in _FREE]
    return any(parent.get("link") == "world" for joint in joints for parent in joint.findall("parent"))


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
    if origin.get("quat_xyzw"):
        if origin.get("rpy"):
            raise CorruptFileError(f"{path}: the origin of {where} has both rpy and quat_xyzw; keep one of them")
        quaternion = numbers(origin.get("quat_xyzw"), 4, path, f"origin quat_xyzw of {where}")
        return pose_of(xyz, _from_quaternion(quaternion, path, where))
    rpy = numbers(origin.get("rpy"), 3, path, f"origin rpy of {where}", _ZERO)
    return pose_of(xyz, from_roll_pitch_yaw(rpy))


def _own_color(material: Element, path: Path) -> Color | None:
    element = material.find("color")
    return None if element is None else color_of(element.get("rgba"), path, f"material {material.get('name')!r}")


def _urdf_shape(
    element: Element, link: Array, materials: dict[str, Color | None], path: Path, where: str
) -> Shape | str:
    """The shape of a visual or collision, or why it is none."""
    pose = link @ _origin(element, path, where)
    material = element.find("material")
    color = None if material is None else _own_color(material, path) or materials.get(material.get("name", ""))
    kind = _geometry(element, path, where)
    if kind.tag != "mesh" and _is_point(element, kind.attrib.values()):
        return "has a size of 0"
    if kind.tag == "mesh":
        filename = kind.get("filename")
        if not filename:
            raise CorruptFileError(f"{path}: the mesh of {where} has no filename")
        scale = kind.get("scale")
        count = len((scale or "").split())
        size = numbers(scale, 1 if count == 1 else 3, path, f"mesh scale of {where}", (1.0, 1.0, 1.0))
        convex = kind.find("drake:declare_convex") is not None
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
        for key in _MOMENTS
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return moved_inertial(_origin(element, path, where), Inertial(float(mass), np.zeros(3), matrix))
