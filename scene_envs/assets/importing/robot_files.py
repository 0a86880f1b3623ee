"""Readers of models: the links of one SDF, URDF, MJCF (by MuJoCo's compiler) or USD merged at zero joint positions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, fromstring

import numpy as np
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array
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
    pose_of,
    positive,
    read_xml,
)
from scene_envs.assets.importing.solids import solid_of
from scene_envs.assets.shapes import MassProperties
from scene_envs.errors import CorruptFileError, InvalidInputError, MissingDependencyError

_Colors = Mapping[str, Color | None]
_TO_WORLD = "a joint holds it at `world`"


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
        self.inertials: list[MassProperties] = []

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
                    shapes.append(shape)
        return self.shapes["collision"][before:]

    def model(self, movable: list[str], welded: str) -> Model:
        """The model, with the reason why it is welded, "" where it is not."""
        if movable:
            self.notes.append(f"movable joints frozen at zero: {', '.join(movable)}")
        if welded:
            self.notes.append(f"{welded}: it is welded (`welded: false` makes it free)")
        visuals, collisions = map(tuple, self.shapes.values())
        return Model(visuals, collisions, tuple(self.inertials), bool(welded) or None, tuple(self.notes))


def read_sdf(path: Path) -> Model:
    """The model in an SDF file, in the model frame; the model's pose in its world is ignored. Raises CorruptFileError
    for a file that is no SDF or contradicts itself, InvalidInputError for several models, an include or a missing mesh.
    """
    root = read_xml(path)
    model = _only_model(root, path)
    links, frames, reading = _links(model, path), _sdf_frames(model, path), _Reading(root, "SDF", path)
    for name, link in links.items():
        pose = frames.pose(name)
        collisions = reading.add(link, partial(frames.place, name), {})
        inertial, where = link.find("inertial"), f"inertial of link {name!r}"
        if inertial is None:
            continue
        if not _flag(inertial.get("auto")):
            moment = 0.0 if inertial.find("inertia") is None else 1.0  # of SDFormat; without any, the shape decides
            found = _inertial(inertial, path, where, (1.0, moment))
            reading.inertials.append(moved_inertial(pose @ _pose(inertial.find("pose"), path, where), found))
        elif collisions:
            default = _density(inertial, path, where) or 1000.0  # that of SDFormat
            filled = [heavier(solid_of(shape), shape.density or default) for shape in collisions]
            merged = merged_inertial(filled)
            mass = numbers(inertial.findtext("mass"), 1, path, f"mass in {where}", (merged.mass,))[0]
            reading.inertials.append(heavier(merged, float(mass) / merged.mass))
    ends = {
        joint: [(joint.findtext(end) or "").strip() for end in ("parent", "child")]
        for joint in [*model.findall("joint"), *root.findall("world/joint")]
    }
    for name in {name for joint in model.findall("joint") for name in ends[joint]} - {"world"}:
        frames.pose(name)
    movable = [joint.get("name", "?") for joint in ends if joint.get("type") != "fixed"]
    held = _TO_WORLD if any("world" in names for names in ends.values()) else ""
    return reading.model(movable, "the file says static" if _flag(model.findtext("static")) else held)


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
    poses, movable = _link_poses(robot, links, path)
    materials: dict[str, Color | None] = {}
    for material in [*robot.findall("material"), *robot.findall("link/visual/material")]:
        if material.find("color") is not None:  # it may be defined inside any visual
            materials[material.get("name", "")] = _color(material, {}, path, f"material {material.get('name')!r}")
    for name, link in links.items():
        reading.add(link, partial(_placed, path, poses[name]), materials)
        for inertial in link.findall("inertial")[:1]:
            where = f"inertial of link {name!r}"
            pose = _placed(path, poses[name], inertial, where)
            reading.inertials.append(moved_inertial(pose, _inertial(inertial, path, where, (0.0, 0.0))))
    massless = reading.inertials and all(inertial.mass == 0 for inertial in reading.inertials)
    held = _TO_WORLD if any(joint.get("type") not in ("floating", "planar") for joint in holding) else ""
    return reading.model(movable, "the file gives mass 0" if massless else held)


def _link_poses(robot: Element, links: dict[str, Element], path: Path) -> tuple[dict[str, Array], list[str]]:
    """(4, 4) of each link in the root link's frame, and the names of movable joints."""
    places: dict[str, tuple[str, Array]] = {}
    for joint in robot.findall("joint"):
        name = joint.get("name", "?")
        ends = [element.get("link", "") if (element := joint.find(t)) is not None else "" for t in ("parent", "child")]
        for end in ends:
            if end not in links:
                raise CorruptFileError(f"{path}: joint {name!r} connects link {end!r}, which does not exist")
        if ends[1] in places:
            raise CorruptFileError(f"{path}: link {ends[1]!r} is the child of two joints; a URDF is a tree")
        places[ends[1]] = ends[0], _placed(path, np.eye(4), joint, f"joint {name!r}")
    roots = [name for name in links if name not in places]
    if len(roots) != 1:
        found = ", ".join(map(repr, roots)) or "none (its joints form a loop)"
        raise CorruptFileError(f"{path}: a URDF has one root link, this one has {found}")
    frames = _Frames(path, {roots[0]: ("", np.eye(4)), **places})
    movable = [joint.get("name", "?") for joint in robot.findall("joint") if joint.get("type") != "fixed"]
    return {name: frames.pose(name) for name in links}, movable


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
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    notes = _unread(fromstring(spec.to_xml()), "MJCF")
    for geom in range(model.ngeom):
        name = f"geom {model.geom(geom).name or geom!r}"
        shape = _geom(model, geom, base @ pose_of(data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)), path, name)
        if shape is None or int(model.geom_bodyid[geom]) not in bodies:
            kind, body = mujoco.mjtGeom(model.geom_type[geom]).name[7:].lower(), model.geom_bodyid[geom]
            notes.append(f"{name}, a {kind} of body {model.body(body).name!r}, is left out")
            continue
        if collides := bool(model.geom_contype[geom] | model.geom_conaffinity[geom]):
            collisions.append(shape)
        if model.geom_group[geom] <= 2 or not collides:  # MuJoCo draws the groups 0 to 2
            visuals.append(shape)
    inertials = []
    for body in (body for body in bodies if model.body_mass[body] > 0):
        pose = base @ pose_of(data.xipos[body], data.ximat[body].reshape(3, 3))
        own = MassProperties(float(model.body_mass[body]), np.zeros(3), np.diag(model.body_inertia[body]))
        inertials.append(moved_inertial(pose, own))
    if ((model.geom_contype | model.geom_conaffinity) & ~1).any():
        notes.append("not read: contype and conaffinity above 1, because all objects of a scene collide")
    free = [j for j in range(model.njnt) if model.jnt_type[j] == 0 and model.jnt_bodyid[j] == root]
    held = [j for j in range(model.njnt) if j not in free and model.jnt_bodyid[j] in bodies]
    if movable := [model.joint(j).name or f"joint {j}" for j in held]:
        notes.append(f"movable joints frozen at zero: {', '.join(movable)}")
    drags = ("dof_armature", "dof_damping", "dof_frictionloss", "jnt_stiffness") if free else ()
    drag = [key[4:] for key in drags if getattr(model, key)[free[0]].any()]
    notes += [f"not read: {name} of the free joint" for name in drag]
    if not free:
        notes.append("it has no free joint: it is welded (`welded: false` makes it free)")
    return Model(tuple(visuals), tuple(collisions), tuple(inertials), None if free else True, tuple(notes))


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
        self.inertials: list[MassProperties] = []

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
        self.inertials.append(found)


def _one(colors: Any) -> Color | None:
    """The colour of one surface, if it has one."""
    return (int(colors[0, 0]), int(colors[0, 1]), int(colors[0, 2])) if len(colors) == 1 else None


def _number(prim: Any, name: str) -> float:
    """A number of a prim; 0 where it has none."""
    return float((prim.GetAttribute(name).Get(0.0) if prim and prim.HasAttribute(name) else None) or 0.0)


def _and_above(prim: Any) -> list[Any]:
    """The prim and those above it."""
    return [] if prim.IsPseudoRoot() else [prim, *_and_above(prim.GetParent())]
