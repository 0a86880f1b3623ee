"""Readers of models: the links of one SDF, URDF, MJCF (by MuJoCo's compiler) or USD merged at zero joint positions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal
from xml.etree.ElementTree import Element, fromstring

import numpy as np
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array
from scene_envs.assets.base import Joint
from scene_envs.assets.importing.limits import check_file, check_triangles
from scene_envs.assets.importing.mesh_files import (
    FORMATS,
    Y_UP,
    Color,
    Model,
    Shape,
    color_of,
    cut_polygons,
    find_mesh,
    heavier,
    merged_inertial,
    moved_inertial,
    numbers,
    positive,
    read_xml,
)
from scene_envs.assets.importing.solids import solid_of
from scene_envs.assets.shapes import MassProperties, pose_of
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError

_Colors = Mapping[str, Color | None]
_TO_WORLD = "a joint holds it at `world`"
_OF_JOINTS = ("limit", "dynamics", "mimic")


def _unread(root: Element, kind: str) -> list[str]:
    """A note that names the elements and attributes that are neither read nor left out on purpose, if any."""
    left_out = " ".join(FORMATS[kind]["left out"].values()).split()
    found: Counter[str] = Counter()

    def visit(element: Element) -> None:
        read = FORMATS[kind]["read"].get(element.tag, "").split()
        names = [f"@{key}" for key in element.attrib if key.partition(":")[0] != "xmlns"]
        for name, count in Counter([*names, *(child.tag for child in element)]).items():
            place = f"{element.tag}/{name}"
            if name not in read and f"{name}*" not in read and place not in left_out:
                found[place] += count
            elif name in read and count > 1:
                found[f"second {place}"] += count - 1
        found["second geometry"] += len(element) - 1 if element.tag == "geometry" and len(element) else 0
        for child in element:
            if child.tag in read or f"{child.tag}*" in read:
                visit(child)

    visit(root)
    names = [name + (f" ({count} times)" if count > 1 else "") for name, count in found.items() if count]
    return [f"not read: {', '.join(names)}"] if names else []


def _links(model: Element, path: Path) -> dict[str, Element]:
    """Links by name; CorruptFileError for none, and for two of one name, of which one would be lost."""
    elements = model.findall("link")
    if not elements:
        raise CorruptFileError(f"{path}: {model.tag} {model.get('name')!r} holds no <link>")
    links = {link.get("name", ""): link for link in elements}
    if len(links) < len(elements):
        name = Counter(link.get("name", "") for link in elements).most_common(1)[0][0]
        raise CorruptFileError(f"{path} holds several links called {name!r}; give each its own name")
    return links


class _Reading:
    """What was read of the links of a model."""

    def __init__(self, root: Element, kind: str, path: Path) -> None:
        self.kind, self.path, self.notes = kind, path, _unread(root, kind)
        self.shapes: dict[str, list[Shape]] = {"visual": [], "collision": []}
        self.inertials: list[tuple[int, MassProperties]] = []
        self.frozen: list[str] = []
        self.faults: list[str] = []
        self.joints: list[Joint] = []
        self.rows: dict[str, int] = {}  # of links that joints move

    def joint(self, element: Element, link: str, pose: Array, turn: Array) -> Joint | None:
        """The joint that moves ``link``, with its pose (4, 4) in the model and the rotation (3, 3) of its axis to the
        frame of this pose; None for a fixed one, and for one that is frozen and therefore noted.
        """
        kind, name, is_urdf = element.get("type", ""), element.get("name", "?"), self.kind == "URDF"
        axis, where = element.find("axis"), f"joint {name!r}"
        owner = element if is_urdf else axis
        limit, dynamics, mimic = (None if owner is None else owner.find(tag) for tag in _OF_JOINTS)
        if kind not in ("revolute", "continuous", "prismatic") or mimic is not None:
            self.frozen += [] if kind == "fixed" else [f"{name} ({kind if mimic is None else 'mimic'})"]
            return None

        def number(key: str, where_from: Element | None, default: float) -> float:
            text = (_text(where_from, key) or "").strip()
            if text.lower().lstrip("+-") in ("inf", "infinity"):
                return float(text)
            value = float(numbers(text, 1, self.path, f"{key} of {where}", (default,))[0])
            return value if abs(value) < 1e16 else float(np.copysign(np.inf, value))  # as SDFormat says

        default = (1.0, 0.0, 0.0) if is_urdf else (0.0, 0.0, 1.0)
        vector = numbers(_text(axis, "xyz"), 3, self.path, f"axis of {where}", default)
        far = 0.0 if is_urdf and kind != "continuous" else np.inf
        ends = None if kind == "continuous" else limit
        low, high = number("lower", ends, 0.0 - far), number("upper", ends, far)
        rubs = number("damping", dynamics, 0.0), number("friction", dynamics, 0.0)
        length = float(np.linalg.norm(vector))
        if is_urdf and limit is None and kind != "continuous":
            fault = f"is {kind} and has no <limit>; give it lower and upper, or make it continuous or fixed"
        elif low > high:
            fault = f"has a lower limit of {low:g} above its upper one of {high:g}; exchange them"
        elif not length or not 0.0 <= min(rubs) <= max(rubs) < np.inf:
            fault = f"has the axis {vector.tolist()}, damping and friction {rubs}; 0 0 1, 0 and 0 would do"
        else:
            moves: Literal["prismatic", "revolute"] = "prismatic" if kind == "prismatic" else "revolute"
            found = Joint(name, link, 0, moves, pose, turn @ vector / length, (low, high), *rubs)
            self.frozen += _why_still(found)
            return None if _why_still(found) else found
        self.faults.append(f"{self.path}: {where} {fault}")
        return None

    def add(self, link: Element, place: Callable[[Element, str], Array], materials: _Colors) -> list[Shape]:
        """Read the shapes of a link, whose poses in the model frame ``place`` gives; returns its collisions."""
        before = len(self.shapes["collision"])
        for tag, shapes in self.shapes.items():
            for index, element in enumerate(link.findall(tag), start=1):
                where = f"{tag} {index} of link {link.get('name', '')!r}"
                shape = _shape(element, self.kind, place(element, where), materials, self.path, where)
                if isinstance(shape, str):
                    self.notes.append(f"{where} {shape}, which is left out")
                else:
                    shapes.append(replace(shape, link=self.rows.get(link.get("name", ""), 0)))
        return self.shapes["collision"][before:]

    def model(self, welded: str) -> Model:
        """The model, with the reason why it is welded, "" where it is not."""
        if self.frozen:
            self.notes.append(f"movable joints frozen at zero: {', '.join(self.frozen)}")
        if welded:
            self.notes.append(f"{welded}: it is welded (`welded: false` makes it free)")
        visuals, collisions = map(tuple, self.shapes.values())
        joints = tuple(self.joints), tuple(self.faults)
        return Model(visuals, collisions, tuple(self.inertials), bool(welded) or None, tuple(self.notes), *joints)


def _numbered(holding: Mapping[Any, tuple[Any, Joint | None]]) -> tuple[dict[Any, int], list[Joint], list[str]]:
    """Number of each link, the joints in this order, and the names of those in loops, from what holds each link."""
    left, rows, joints = dict(holding), dict[Any, int](), list[Joint]()
    while ready := [link for link in left if left[link][0] not in left]:
        for link in ready:
            parent, joint = left.pop(link)
            rows[link] = rows.get(parent, 0)
            if joint is not None:
                joints.append(replace(joint, parent=rows[link]))
                rows[link] = len(joints)
    return rows, joints, [f"{joint.name} (in a loop)" for _, joint in left.values() if joint is not None]


def _why_still(joint: Joint) -> list[str]:
    """The name of a joint with the reason why its limits freeze it; nothing for one that moves."""
    low, high = joint.limits
    if np.isinf(joint.limits).sum() == 1 or (np.isinf(low) and joint.kind == "prismatic"):
        return [f"{joint.name} ({joint.kind}, without a lower and an upper limit)"]
    way = f"{joint.name} (its limits are {low:g} to {high:g}" + (")" if low <= 0 <= high else ", without 0)")
    return [] if low <= 0.0 <= high and low < high else [way]


def read_sdf(path: Path) -> Model:
    """The model in an SDF file, in the model frame; the model's pose in its world is ignored. Raises CorruptFileError
    for a file that is no SDF or contradicts itself, InvalidInputError for several models, an include or a missing mesh.
    """
    root = read_xml(path)
    model = _only_model(root, path)
    links, frames, reading = _links(model, path), _sdf_frames(model, path), _Reading(root, "SDF", path)
    ends = {
        joint: [(joint.findtext(end) or "").strip() for end in ("parent", "child")]
        for joint in [*model.findall("joint"), *root.findall("world/joint")]
    }
    for name in {name for joint in model.findall("joint") for name in ends[joint]} - {"world"}:
        frames.pose(name)
    children = [child for _, child in ends.values()]
    static = _flag(model.findtext("static"))
    holding: dict[str, tuple[str, Joint | None]] = {}
    for joint, (parent, child) in ends.items():
        why = "the file says static" if static else "in a loop" if children.count(child) > 1 else ""
        if why := why or ("" if child in links else f"{child} is no link"):
            reading.frozen += [] if joint.get("type") == "fixed" else [f"{joint.get('name', '?')} ({why})"]
        if child in links:
            holding[child] = parent, None if why else _sdf_joint(joint, child, frames, reading, root.get("version"))
    reading.rows, reading.joints, looped = _numbered(holding)
    reading.frozen += looped
    for name, link in links.items():
        pose = frames.pose(name)
        collisions = reading.add(link, partial(frames.place, name), {})
        inertial, where = link.find("inertial"), f"inertial of link {name!r}"
        if inertial is None:
            continue
        if not _flag(inertial.get("auto")):
            moment = 0.0 if inertial.find("inertia") is None else 1.0  # of SDFormat; without any, the shape decides
            found = _inertial(inertial, path, where, (1.0, moment))
            own = moved_inertial(pose @ _pose(inertial.find("pose"), path, where), found)
        elif collisions:
            default = _density(inertial, path, where) or 1000.0  # that of SDFormat
            filled = [heavier(solid_of(shape), shape.density or default) for shape in collisions]
            merged = merged_inertial(filled)
            mass = numbers(inertial.findtext("mass"), 1, path, f"mass in {where}", (merged.mass,))[0]
            own = heavier(merged, float(mass) / merged.mass)
        else:
            continue
        reading.inertials.append((reading.rows.get(name, 0), own))
    held = _TO_WORLD if any("world" in names for names in ends.values()) else ""
    return reading.model("the file says static" if static else held)


def _sdf_joint(element: Element, link: str, frames: _Frames, reading: _Reading, version: str | None) -> Joint | None:
    """The joint that moves ``link``; before SDF 1.5 its axis is in the frame of the model."""
    name, axis = element.get("name", ""), element.find("axis/xyz")
    is_old = version in ("1.0", "1.2", "1.3", "1.4") or _flag(element.findtext("axis/use_parent_model_frame"))
    base = "__model__" if is_old else (None if axis is None else axis.get("expressed_in")) or name
    pose = frames.pose(name)
    return reading.joint(element, link, pose, pose[:3, :3].T @ frames.pose(base)[:3, :3])


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
    """Poses of frames in the model frame; each has a base, "" for the model, and a pose (4, 4) in it."""

    def __init__(self, path: Path, places: dict[str, tuple[str, Array]]) -> None:
        self._path, self._places = path, places

    def pose(self, name: str, waiting: tuple[str, ...] = ()) -> Array:
        """(4, 4) of the frame called ``name``."""
        if name in ("__model__", ""):
            return np.eye(4)
        if name not in self._places:
            raise CorruptFileError(f"{self._path}: a pose or a joint refers to {name!r}, which does not exist")
        if name in waiting:
            raise CorruptFileError(f"{self._path}: {', '.join(map(repr, waiting))} hang on each other in a loop")
        base, pose = self._places[name]
        return self.pose(base, (*waiting, name)) @ pose

    def place(self, link: str, element: Element, where: str) -> Array:
        """(4, 4) of a visual or collision of a link in the model frame."""
        pose = element.find("pose")
        base = None if pose is None else pose.get("relative_to")
        return self.pose(base or link) @ _pose(pose, self._path, where)


def _sdf_frames(model: Element, path: Path) -> _Frames:
    """The frames of links, joints and frames, by the rules of SDFormat 1.7 and later."""
    places: dict[str, tuple[str, Array]] = {}
    for element in [element for tag in ("link", "joint", "frame") for element in model.findall(tag)]:
        name, pose = element.get("name", ""), element.find("pose")
        base = (element.findtext("child") or "").strip() if element.tag == "joint" else element.get("attached_to", "")
        base = base if pose is None else pose.get("relative_to") or base
        places.setdefault(name, (base, _pose(pose, path, repr(name))))
    return _Frames(path, places)


def _pose(element: Element | None, path: Path, where: str) -> Array:
    if element is None:
        return np.eye(4)
    if element.get("rotation_format") == "quat_xyzw":
        values = numbers(element.text, 7, path, f"pose of {where}", (0.0,) * 6 + (1.0,))
        return pose_of(values[:3], _from_quaternion(values[3:], path, where))
    values = numbers(element.text, 6, path, f"pose of {where}", (0.0,) * 6)
    turn = Rotation.from_euler("xyz", values[3:], degrees=_flag(element.get("degrees")))
    return pose_of(values[:3], turn.as_matrix())


def _from_quaternion(quaternion: Array, path: Path, where: str) -> Array:
    """(3, 3) rotation of a quaternion (x, y, z, w) of any length above 0."""
    if not quaternion.any():
        raise CorruptFileError(f"{path}: the quaternion of {where} is 0; no rotation is `0 0 0 1`")
    return np.asarray(Rotation.from_quat(quaternion).as_matrix())


def _shape(element: Element, form: str, pose: Array, materials: _Colors, path: Path, where: str) -> Shape | str:
    """The shape of a visual or collision, or why it is none."""
    geometry = element.find("geometry")
    if geometry is None or not len(geometry):
        raise CorruptFileError(f"{path}: {where} has no geometry")
    kind = geometry[0]
    known = FORMATS[form]["read"]["geometry"].split()
    if kind.tag not in known:
        raise CorruptFileError(f"{path}: {where} is a <{kind.tag}>; known are {', '.join(known)}")
    if kind.tag in ("plane", "empty"):
        return "is an endless plane" if kind.tag == "plane" else "is empty"
    color = _color(element.find("material"), materials, path, where)
    if kind.tag == "mesh":
        uri, scale = _text(kind, "filename" if form == "URDF" else "uri"), _text(kind, "scale")
        if not uri:
            raise CorruptFileError(f"{path}: the mesh of {where} names no file")
        count = 1 if len((scale or "").split()) == 1 else 3
        size = np.broadcast_to(numbers(scale, count, path, f"mesh scale of {where}", (1.0, 1.0, 1.0)), 3)
        convex = kind.find("drake:declare_convex") is not None or kind.get("optimization") == "convex_hull"
        name = (kind.findtext("submesh/name") or "").strip()
        part = (name, _flag(kind.findtext("submesh/center"))) if name else None
        shape = Shape("mesh", tuple(size.tolist()), pose, where, find_mesh(uri, path, where), color, convex, part)
    else:
        counts = FORMATS["primitives"][kind.tag]
        words = " ".join(_text(kind, key) or "" for key in counts).split()
        if element.tag == "visual" and any(not word.strip("+-0.,") for word in words):  # other readers take it
            return "has a size of 0"
        sizes = [positive(_text(kind, k), n, path, f"{kind.tag} {k} of {where}") for k, n in counts.items()]
        shape = Shape(kind.tag, sum(sizes, ()), pose, where, None, color)  # type: ignore[arg-type]
    return replace(shape, density=_density(element, path, where))


def _text(element: Element | None, key: str) -> str | None:
    """An attribute of a URDF or the text of a child in an SDF."""
    return None if element is None else element.get(key) or element.findtext(key)


def _color(material: Element | None, known: _Colors, path: Path, where: str) -> Color | None:
    """The colour of a material, its own or that of its name."""
    if material is None:
        return None
    color = material.find("color")
    text = material.findtext("diffuse") if color is None else color.get("rgba")
    return color_of(text, path, f"colour of {where}") or known.get(material.get("name", ""))


def _inertial(element: Element, path: Path, where: str, default: tuple[float, float]) -> MassProperties:
    """The inertial in its own frame; ``default`` has the mass (kg) and the moments (kg m^2) where they are missing."""
    mass = element.find("mass")
    text = None if mass is None else mass.get("value", mass.text)
    kilograms = numbers(text, 1, path, f"mass in {where}", default[:1])[0]
    matrix = np.zeros((3, 3))
    for row, column in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
        key = f"i{'xyz'[row]}{'xyz'[column]}"
        missing = (default[1] * (row == column),)
        value = numbers(_text(element.find("inertia"), key), 1, path, f"{key} in {where}", missing)[0]
        matrix[row, column] = matrix[column, row] = value
    return MassProperties(float(kilograms), np.zeros(3), matrix)


def _flag(text: str | None) -> bool:
    return (text or "").strip().lower() in ("1", "true")


def read_urdf(path: Path) -> Model:
    """The model in a URDF file, in the frame of its root link; movable joints are frozen at zero and listed in a note.
    Raises CorruptFileError for a file that is no URDF or contradicts itself, InvalidInputError for a missing mesh.
    """
    robot = read_xml(path)
    if robot.tag != "robot":
        raise CorruptFileError(f"{path} is not a URDF: its root is <{robot.tag}>, not <robot>")
    if any(element.tag.startswith("xacro:") for element in robot.iter()):
        raise CorruptFileError(f"{path} holds <xacro:...> elements; expand it with xacro first")
    links, reading = _links(robot, path), _Reading(robot, "URDF", path)
    holding = [j for j in robot.findall("joint") for parent in j.findall("parent") if parent.get("link") == "world"]
    if holding:  # a link that need not be declared
        links.setdefault("world", Element("link", name="world"))
    places: dict[str, tuple[str, Array]] = {}  # parent of a link, and its pose there
    held_by: dict[str, Element] = {}
    for joint in robot.findall("joint"):
        name = joint.get("name", "?")
        ends = [element.get("link", "") if (element := joint.find(t)) is not None else "" for t in ("parent", "child")]
        for end in ends:
            if end not in links:
                raise CorruptFileError(f"{path}: joint {name!r} connects link {end!r}, which does not exist")
        if ends[1] in places:
            raise CorruptFileError(f"{path}: link {ends[1]!r} is the child of two joints; a URDF is a tree")
        places[ends[1]], held_by[ends[1]] = (ends[0], _placed(path, np.eye(4), joint, f"joint {name!r}")), joint
    roots = [name for name in links if name not in places]
    if len(roots) != 1:
        found = ", ".join(map(repr, roots)) or "none (its joints form a loop)"
        raise CorruptFileError(f"{path}: a URDF has one root link, this one has {found}")
    frames = _Frames(path, {roots[0]: ("", np.eye(4)), **places})
    poses = {name: frames.pose(name) for name in links}
    still = np.eye(3)
    moved = {link: (places[link][0], reading.joint(j, link, poses[link], still)) for link, j in held_by.items()}
    reading.rows, reading.joints, _ = _numbered(moved)
    materials: dict[str, Color | None] = {}
    for material in [*robot.findall("material"), *robot.findall("link/visual/material")]:
        if material.find("color") is not None:  # it may be defined inside any visual
            materials[material.get("name", "")] = _color(material, {}, path, f"material {material.get('name')!r}")
    for name, link in links.items():
        reading.add(link, partial(_placed, path, poses[name]), materials)
        for inertial in link.findall("inertial")[:1]:
            where = f"inertial of link {name!r}"
            pose = _placed(path, poses[name], inertial, where)
            own = moved_inertial(pose, _inertial(inertial, path, where, (0.0, 0.0)))
            reading.inertials.append((reading.rows.get(name, 0), own))
    massless = reading.inertials and all(inertial.mass == 0 for _, inertial in reading.inertials)
    held = _TO_WORLD if any(joint.get("type") not in ("floating", "planar") for joint in holding) else ""
    return reading.model("the file gives mass 0" if massless else held)


def _placed(path: Path, base: Array, element: Element, where: str) -> Array:
    """(4, 4) of the origin of an element in the frame that has the pose ``base``."""
    origin = element.find("origin")
    if origin is None:
        return base
    xyz = numbers(origin.get("xyz"), 3, path, f"origin xyz of {where}", (0.0, 0.0, 0.0))
    if origin.get("rpy") and origin.get("quat_xyzw"):
        raise CorruptFileError(f"{path}: the origin of {where} has both rpy and quat_xyzw; keep one of them")
    if origin.get("quat_xyzw"):
        quaternion = numbers(origin.get("quat_xyzw"), 4, path, f"origin quat_xyzw of {where}")
        return base @ pose_of(xyz, _from_quaternion(quaternion, path, where))
    rpy = numbers(origin.get("rpy"), 3, path, f"origin rpy of {where}", (0.0, 0.0, 0.0))
    return base @ pose_of(xyz, Rotation.from_euler("xyz", rpy).as_matrix())


def read_mjcf(path: Path) -> Model:
    """The one body of an MJCF file, with those below it, as MuJoCo compiles them, in the frame of that body; movable
    joints are frozen at their reference. A body without a free joint is welded. Raises CorruptFileError for a file that
    MuJoCo does not compile, and InvalidInputError for several bodies or none.
    """
    import mujoco

    check_file(path)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for mesh in spec.meshes:
            check_file(path.parent / spec.meshdir / mesh.file)
        for texture in spec.textures:  # none is read, whatever its size, and its file may be lost
            texture.file, texture.cubefiles, texture.builtin = "", [""] * 6, mujoco.mjtBuiltin.mjBUILTIN_FLAT
            texture.width = texture.height = 1
        model: Any = spec.compile()
    except ValueError as error:
        raise CorruptFileError(f"{path} cannot be read as MJCF: {' '.join(str(error).split())}") from error
    data: Any = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    roots = [body for body in range(1, model.nbody) if model.body_parentid[body] == 0]
    if len(roots) > 1:
        names = ", ".join(repr(model.body(body).name) for body in roots)
        raise InvalidInputError(f"{path} holds {len(roots)} bodies ({names}); an asset is one, so put each in a file")
    if not roots and not model.ngeom:
        raise InvalidInputError(f"{path} holds no <body> and no <geom>")
    root = roots[0] if roots else 0  # the world itself where it holds all geoms
    bodies = [body for body in range(model.nbody) if root in (0, int(model.body_rootid[body]))]
    base = np.linalg.inv(pose_of(data.xpos[root], data.xmat[root].reshape(3, 3)))
    reading = _Reading(fromstring(spec.to_xml()), "MJCF", path)
    rows, reading.joints, reading.frozen = _hinges(model, data, root, bodies, base)
    for geom in range(model.ngeom):
        name = f"geom {model.geom(geom).name or geom!r}"
        shape = _geom(model, geom, base @ pose_of(data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)), path, name)
        if shape is None or int(model.geom_bodyid[geom]) not in bodies:
            kind, body = mujoco.mjtGeom(model.geom_type[geom]).name[7:].lower(), model.geom_bodyid[geom]
            reading.notes.append(f"{name}, a {kind} of body {model.body(body).name!r}, is left out")
            continue
        shape = replace(shape, link=rows[int(model.geom_bodyid[geom])])
        if collides := bool(model.geom_contype[geom] | model.geom_conaffinity[geom]):
            reading.shapes["collision"].append(shape)
        if model.geom_group[geom] <= 2 or not collides:  # MuJoCo draws the groups 0 to 2
            reading.shapes["visual"].append(shape)
    for body in (body for body in bodies if model.body_mass[body] > 0):
        pose = base @ pose_of(data.xipos[body], data.ximat[body].reshape(3, 3))
        own = MassProperties(float(model.body_mass[body]), np.zeros(3), np.diag(model.body_inertia[body]))
        reading.inertials.append((rows[body], moved_inertial(pose, own)))
    if ((model.geom_contype | model.geom_conaffinity) & ~1).any():
        reading.notes.append("not read: contype and conaffinity above 1, because all objects of a scene collide")
    if reading.joints and any(getattr(model, key).any() for key in ("dof_armature", "jnt_stiffness")):
        reading.notes.append("not read: armature and stiffness of joints")
    free = [j for j in range(model.njnt) if model.jnt_type[j] == 0 and model.jnt_bodyid[j] == root]
    drags = ("dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness") if free else ()
    drag = [key[4:] for key in drags if getattr(model, key)[free[0]].any()]
    reading.notes += [f"not read: {name} of the free joint" for name in drag]
    return reading.model("" if free else "it has no free joint")


def _hinges(
    model: Any, data: Any, root: int, bodies: list[int], base: Any
) -> tuple[dict[int, int], list[Joint], list[str]]:
    """For each body the number of the joint that moves it, the joints, and the names of frozen ones."""
    follows = set(model.eq_obj1id[model.eq_type == 2].tolist())  # mjEQ_JOINT
    holding, frozen = dict[int, tuple[int, Joint | None]](), list[str]()
    for body in bodies:
        own = [j for j in range(model.njnt) if model.jnt_bodyid[j] == body and model.jnt_type[j] != 0]
        held, why = None, "of the first body" if body == root else "several of a body" if len(own) > 1 else ""
        for j in own:
            reason = "ball" if model.jnt_type[j] == 1 else "mimic" if j in follows else why
            dof, zero = model.jnt_dofadr[j], model.qpos0[model.jnt_qposadr[j]]
            low, high = (model.jnt_range[j] - zero).tolist() if model.jnt_limited[j] else (-np.inf, np.inf)
            joint = Joint(
                name=model.joint(j).name or f"joint_{j}",
                link=model.body(body).name or f"body_{body}",
                parent=0,
                kind="prismatic" if model.jnt_type[j] == 2 else "revolute",
                pose=base @ pose_of(data.xanchor[j], data.xmat[body].reshape(3, 3)),
                axis=model.jnt_axis[j].astype(float),
                limits=(low, high),
                damping=float(model.dof_damping[dof]),
                friction=float(model.dof_frictionloss[dof]),
            )
            still = [f"{joint.name} ({reason})"] if reason else _why_still(joint)
            frozen += still
            held = None if still else joint
        holding[body] = int(model.body_parentid[body]) if body else -1, held
    rows, joints, _ = _numbered(holding)
    return rows, joints, frozen


def _geom(model: Any, geom: int, pose: Array, path: Path, name: str) -> Shape | None:
    """A geom as MuJoCo takes it: meshes collide as their hulls."""
    kind, material, size = int(model.geom_type[geom]), int(model.geom_matid[geom]), model.geom_size[geom].astype(float)
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    is_textured = material >= 0 and (model.mat_texid[material] >= 0).any()
    color = None if is_textured else _one(np.rint(255.0 * rgba[None]))
    if kind == 7:
        import trimesh

        mesh = model.mesh(int(model.geom_dataid[geom]))
        check_triangles(path, int(mesh.facenum[0]))
        points = model.mesh_vert[mesh.vertadr[0] :][: mesh.vertnum[0]].astype(float)
        faces = model.mesh_face[mesh.faceadr[0] :][: mesh.facenum[0]]
        surface = trimesh.Trimesh(points, faces, process=False)
        return Shape("mesh", (1.0, 1.0, 1.0), pose, name, path, color, True, surface=surface)
    sizes: dict[int, tuple[Any, tuple[float, ...]]] = {
        2: ("sphere", (size[0],)), 3: ("capsule", (size[0], 2 * size[1])), 4: ("ellipsoid", tuple(size)),
        5: ("cylinder", (size[0], 2 * size[1])), 6: ("box", tuple(2 * size)),
    }  # fmt: skip
    return Shape(*sizes[kind], pose, name, None, color) if kind in sizes else None


def open_stage(path: Path) -> Any:
    """The stage of a USD file; MissingDependencyError without usd-core, CorruptFileError for what is no USD."""
    try:
        from pxr import Tf, Usd
    except ImportError as error:
        raise MissingDependencyError(f"{path} needs usd-core; `pip install 'scene-envs[export]'`") from error
    check_file(path)
    try:
        stage: Any = Usd.Stage.Open(str(path))
        stage.Reload()  # a layer that this process has open is not read again
    except Tf.ErrorException as error:
        raise CorruptFileError(f"{path} cannot be read as USD: {' '.join(str(error).split())[:300]}") from error
    return stage


def read_usd(path: Path) -> Model:
    """The body in a USD file with UsdPhysics, in the frame of the stage, z up, in metres. Colliders without a rigid
    body are welded; a stage without physics is a mesh. Raises MissingDependencyError without usd-core, CorruptFileError
    for a file that cannot be composed, and InvalidInputError for one that does not state its unit, or holds several
    bodies that no joint connects, or shapes that are sheared.
    """
    stage = open_stage(path)
    from pxr import Gf, UsdGeom, UsdPhysics, UsdSkel

    if lost := [" ".join(str(error).split()) for error in stage.GetCompositionErrors()]:
        raise CorruptFileError(f"{path} refers to what cannot be loaded: {lost[0][:300]}")
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        raise InvalidInputError(f"{path} does not state `metersPerUnit`; set it, 1 for metres or 0.01 for centimetres")
    reading = _Stage(path, stage)
    stage.SetEditTarget(stage.GetSessionLayer())
    while instances := [prim for prim in stage.Traverse() if prim.IsInstance()]:
        for prim in instances:
            prim.SetInstanceable(False)
    UsdSkel.BakeSkinning(stage.Traverse(), Gf.Interval(0.0))
    prims = list(stage.Traverse())
    found = [prim for prim in prims if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    bodies = [prim for prim in found if UsdPhysics.RigidBodyAPI(prim).GetRigidBodyEnabledAttr().Get()]
    joints = [UsdPhysics.Joint(prim) for prim in prims if prim.IsA(UsdPhysics.Joint)]
    if len(found) > 1 and not joints:
        names = ", ".join(str(prim.GetPath()) for prim in found)
        raise InvalidInputError(f"{path} holds {len(found)} bodies ({names}); an asset is one, so put each in a file")
    if many := [prim.GetPath() for prim in prims if prim.IsA(UsdGeom.PointInstancer)]:
        raise InvalidInputError(f"{path}: {many[0]} is a point instancer, which is not read; make its instances prims")
    lacking = ("kinematicEnabled", "velocity", "angularVelocity", "restitution")  # what an asset does not have
    for prim in prims:
        values = [(name, prim.GetAttribute(f"physics:{name}")) for name in lacking]
        reading.notes += [f"not read: {n} of {prim.GetPath()}" for n, value in values if value and np.any(value.Get())]
        if prim.IsA(UsdGeom.Gprim):
            reading.add(prim)
    for body in bodies:
        reading.weigh(body)
    notes = list(dict.fromkeys(reading.notes))
    if movable := [j.GetPrim().GetName() for j in joints if not j.GetPrim().IsA(UsdPhysics.FixedJoint)]:
        notes.append(f"movable joints frozen where they are: {', '.join(movable)}")
    held = any(not end.GetTargets() for joint in joints for end in (joint.GetBody0Rel(), joint.GetBody1Rel()))
    why = "it has colliders and no rigid body" if reading.collisions and not bodies else ""
    if why := "a joint holds it at the world" if held or 0 < len(bodies) < len(found) else why:  # disabled is static
        notes.append(f"{why}: it is welded (`welded: false` makes it free)")
    shapes = tuple(reading.visuals), tuple(shape for _, shape in reading.collisions)
    return Model(*shapes, tuple(reading.inertials), bool(why) or None, tuple(notes))


class _Stage:
    """What was read of the prims of a stage, in metres, kilograms and z up."""

    def __init__(self, path: Path, stage: Any) -> None:
        from pxr import UsdGeom, UsdPhysics

        self.path, self.kilograms = path, UsdPhysics.GetStageKilogramsPerUnit(stage)
        self.unit = UsdGeom.GetStageMetersPerUnit(stage)
        self.axes = self.unit * (Y_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else np.eye(3))
        self.notes = [] if stage.HasAuthoredMetadata("upAxis") else ["upAxis is not stated: y is up, as USD says"]
        self.visuals: list[Shape] = []
        self.collisions: list[tuple[Any, Shape]] = []  # with their prims
        self.inertials: list[tuple[int, MassProperties]] = []

    def _matrix(self, prim: Any) -> tuple[Array, Array]:
        """(3, 3) and (3,) m that take coordinates of a prim, in its unit, to the model frame."""
        from pxr import UsdGeom

        rows = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0))
        return self.axes @ rows[:3, :3].T, self.axes @ rows[3, :3]

    def add(self, prim: Any) -> None:
        """Read a shape as a visual, a collider or both."""
        from pxr import UsdGeom, UsdPhysics

        owner = next((p for p in _and_above(prim) if p.HasAPI(UsdPhysics.CollisionAPI)), None)
        collides = owner is not None and UsdPhysics.CollisionAPI(owner).GetCollisionEnabledAttr().Get() is not False
        image = UsdGeom.Imageable(prim)
        drawn = image.ComputePurpose() in ("default", "render") and image.ComputeVisibility(0.0) != "invisible"
        shape = self._mesh(prim, owner) if prim.IsA(UsdGeom.Mesh) else self._primitive(prim)
        if shape is None:
            self.notes.append(f"{prim.GetPath()} is a {prim.GetTypeName()}, which is left out")
        else:
            self.collisions += [(prim, shape)] if collides else []
            self.visuals += [shape] if drawn else []

    def _mesh(self, prim: Any, owner: Any) -> Shape:
        """A mesh, a hull where its collider (of ``owner``) is one."""
        import trimesh
        from pxr import UsdShade

        where, colors, (matrix, place) = str(prim.GetPath()), self._colors(prim), self._matrix(prim)
        names = ("points", "faceVertexIndices", "faceVertexCounts")
        found, corners, counts = (np.array(prim.GetAttribute(name).Get(0.0) or ()) for name in names)
        corners, counts, points = corners.astype(int), counts.astype(int), found.reshape(-1, 3).astype(float)
        if counts.sum() != len(corners) or not len(corners) or not 0 <= corners.min() <= corners.max() < len(points):
            raise CorruptFileError(f"{self.path}: the faces of {where} do not fit to its points")
        self.notes += [f"{where}: its holes are filled"] if prim.GetAttribute("holeIndices").Get(0.0) else []
        smooth = prim.GetAttribute("subdivisionScheme")
        self.notes += [f"{where}: it is not subdivided"] * (smooth.HasAuthoredValue() and smooth.Get() != "none")
        parts = UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets()
        self.notes += [f"not read: materials of parts of {where}"] if parts else []
        cut, polygons = cut_polygons(points, corners, counts)
        check_triangles(self.path, len(cut))
        inside_out = (prim.GetAttribute("orientation").Get() == "leftHanded") != (np.linalg.det(matrix) < 0)
        faces = corners[cut][:, :: -1 if inside_out else 1]
        surface: Any = trimesh.Trimesh(points @ matrix.T + place, faces, process=False)
        if len(colors) == len(counts):
            surface.visual.face_colors = colors[polygons]
        elif len(colors) == len(points):
            surface.visual.vertex_colors = colors
        else:
            self.notes += [f"{where}: its {len(colors)} colours are not read"] if len(colors) > 1 else []
        how = owner.GetAttribute("physics:approximation").Get() if owner else None
        is_hull = how in ("convexHull", "boundingCube", "boundingSphere")
        self.notes += [f"{where}: its {how} is taken as its hull"] if is_hull and how != "convexHull" else []
        return Shape("mesh", (1.0,) * 3, np.eye(4), where, self.path, _one(colors), is_hull, surface=surface)

    def _primitive(self, prim: Any) -> Shape | None:
        where, color, (matrix, place) = str(prim.GetPath()), _one(self._colors(prim)), self._matrix(prim)
        kind, scales = prim.GetTypeName(), np.linalg.norm(matrix, axis=0)
        turn = matrix / scales * np.sign(np.linalg.det(matrix))  # primitives look the same in a mirror
        if np.abs(turn.T @ turn - np.eye(3)).max() > 1e-6:
            raise InvalidInputError(f"{self.path}: {where} is sheared; make it a mesh")
        if kind == "Cube":
            return Shape("box", tuple(_number(prim, "size") * scales), pose_of(place, turn), where, None, color)
        if kind == "Sphere":
            return Shape("ellipsoid", tuple(_number(prim, "radius") * scales), pose_of(place, turn), where, None, color)
        if kind not in ("Cylinder", "Capsule"):
            return None
        order = np.roll(np.arange(3), -"XYZ".index(prim.GetAttribute("axis").Get()) - 1)  # the axis last
        scales, pose = scales[order], pose_of(place, turn[:, order])
        if np.ptp(scales[: 2 if kind == "Cylinder" else 3]) > 1e-6 * scales.max():
            raise InvalidInputError(f"{self.path}: {where} is scaled unevenly; make it a mesh")
        size = (float(_number(prim, "radius") * scales[0]), float(_number(prim, "height") * scales[2]))
        return Shape("cylinder" if kind == "Cylinder" else "capsule", size, pose, where, None, color)

    def _colors(self, prim: Any) -> Any:
        """(N, 3) in 0..255 from the linear colours of a prim, N 0 without any."""
        from pxr import UsdGeom, UsdShade

        values = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor").ComputeFlattened(0.0) or ()
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        for shader in material.GetPrim().GetChildren() if material else ():
            diffuse = shader.GetAttribute("inputs:diffuseColor")
            if diffuse and diffuse.HasAuthoredValue() and not diffuse.HasAuthoredConnections():
                values = [diffuse.Get()]
            if shader.GetAttribute("inputs:file"):
                self.notes.append(f"not read: the textures of {material.GetPath()}")
        rubs = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        if _number(rubs, "physics:dynamicFriction") or _number(rubs, "physics:staticFriction"):
            self.notes.append("not read: friction of materials, because all objects of a scene have the same")
        linear = np.clip(np.array(values, dtype=float).reshape(-1, 3), 0.0, 1.0)
        shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        return np.rint(255.0 * shown).astype(np.uint8)

    def weigh(self, body: Any) -> None:
        """Mass properties of a body by the rules of UsdPhysics: its own, else those of its colliders."""
        from pxr import UsdPhysics, UsdShade

        matrix, place = self._matrix(body)
        names = ("mass", "centerOfMass", "diagonalInertia", "principalAxes")
        mass, center, moments, axes = (body.GetAttribute(f"physics:{name}").Get() for name in names)
        has_center, has_moments = center is not None and np.isfinite(center).all(), moments is not None and any(moments)
        nearest = [next((p for p in _and_above(q) if p.HasAPI(UsdPhysics.RigidBodyAPI)), q) for q, _ in self.collisions]
        own = [found for found, owner in zip(self.collisions, nearest, strict=True) if owner == body]
        found = MassProperties((mass or 0.0) * self.kilograms, place, np.zeros((3, 3)))
        if own and not (mass and has_center and has_moments):
            solids = []
            for prim, shape in own:
                solid, weight = solid_of(shape), _number(prim, "physics:mass") * self.kilograms
                material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
                density = next(filter(None, (_number(p, "physics:density") for p in (prim, body, material))), 0.0)
                density *= self.kilograms / self.unit**3
                solids.append(heavier(solid, weight / solid.mass if weight else density or 1000.0))
            filled = merged_inertial(solids)
            found = heavier(filled, (found.mass or filled.mass) / filled.mass)
        if has_center:
            found = found._replace(center_of_mass=matrix @ np.array(center) + place)
        if has_moments:
            quaternion = [*axes.GetImaginary(), axes.GetReal()] if axes and axes.GetLength() else [0.0, 0.0, 0.0, 1.0]
            turn = matrix / np.linalg.norm(matrix, axis=0) @ Rotation.from_quat(quaternion).as_matrix()
            found = found._replace(inertia=(turn * np.array(moments) * self.kilograms * self.unit**2) @ turn.T)
        self.inertials.append((0, found))


def _one(colors: Any) -> Color | None:
    """The colour of one surface, if it has one."""
    return (int(colors[0, 0]), int(colors[0, 1]), int(colors[0, 2])) if len(colors) == 1 else None


def _number(prim: Any, name: str) -> float:
    """A number of a prim; 0 where it has none."""
    return float((prim.GetAttribute(name).Get(0.0) if prim and prim.HasAttribute(name) else None) or 0.0)


def _and_above(prim: Any) -> list[Any]:
    """The prim and those above it."""
    return [] if prim.IsPseudoRoot() else [prim, *_and_above(prim.GetParent())]
