"""SDF reader: the links of one model merged at zero joint positions."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from scene_envs.arrays import Array
from scene_envs.assets.importing.model import Inertial, Model, Shape, from_roll_pitch_yaw, moved_inertial, pose_of
from scene_envs.assets.importing.xml_files import color_of, find_mesh, numbers, positive, read_xml
from scene_envs.errors import CorruptFileError, InvalidInputError

_RADII = {"cylinder": ("radius", "length"), "capsule": ("radius", "length"), "sphere": ("radius",)}


def read_sdf(path: Path) -> Model:
    """The model in an SDF file, in the model frame; the pose of the model in its world is ignored.

    Raises:
        CorruptFileError: not an SDF, or one that contradicts itself; the place is named.
        InvalidInputError: several models, an include, or a mesh that does not exist.
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
                shape = _shape(element, pose @ frames.local(element, name, where), path, where)
                if shape is None:
                    notes.append(f"{where} is an endless plane, which is left out")
                else:
                    shapes.append(shape)
        inertial = link.find("inertial")
        if inertial is not None:
            inertials.append(moved_inertial(pose, _inertial(inertial, path, f"inertial of link {name!r}")))
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


def _shape(element: Element, pose: Array, path: Path, where: str) -> Shape | None:
    geometry = element.find("geometry")
    kinds = [] if geometry is None else [child for child in geometry if isinstance(child.tag, str)]
    if not kinds:
        raise CorruptFileError(f"{path}: {where} has no geometry")
    kind, color = kinds[0], color_of(element.findtext("material/diffuse"), path, f"colour of {where}")
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
    raise CorruptFileError(
        f"{path}: {where} is a <{kind.tag}>; known are mesh, box, cylinder, sphere, capsule and ellipsoid"
    )  # fmt: skip


def _inertial(element: Element, path: Path, where: str) -> Inertial:
    mass = numbers(element.findtext("mass"), 1, path, f"mass in {where}", (1.0,))[0]  # the default of SDFormat
    xx, yy, zz, xy, xz, yz = (
        numbers(element.findtext(f"inertia/{key}"), 1, path, f"{key} in {where}", (default,))[0]
        for key, default in (("ixx", 1.0), ("iyy", 1.0), ("izz", 1.0), ("ixy", 0.0), ("ixz", 0.0), ("iyz", 0.0))
    )
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return moved_inertial(_pose(element.find("pose"), path, where), Inertial(float(mass), np.zeros(3), matrix))


def _flag(text: str | None) -> bool:
    return (text or "").strip().lower() in ("1", "true")
