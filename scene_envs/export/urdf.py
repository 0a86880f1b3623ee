"""URDF: one robot per asset, and a list of the objects of each scene."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset
from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, number, numbers

BULLET_MARGIN = 1e-3
"""Bullet grows each convex mesh by this much (m); the parts of its URDF are smaller by as much."""
DRAKE = "http://drake.mit.edu"
"""XML namespace of the elements that only Drake reads."""
_MODULUS = 1e8
"""Hydroelastic modulus (Pa): objects at rest sink by micrometres."""


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``objects.json``: name, URDF, pose and whether it is welded, per object; URDFs go into the assets' folders."""
    objects = [
        {
            "name": item.name,
            "urdf": relative(object_urdf(item, files, folder), folder),
            "bullet_urdf": relative(object_urdf(item, files, folder, "_bullet"), folder),
            "translation": item.translation.tolist(),
            "quaternion_wxyz": item.quaternion.tolist(),
            "welded": item.welded,
        }
        for item in scene.objects
    ]
    path = folder / "objects.json"
    path.write_text(json.dumps({"scene_type": scene.scene_type.name, "objects": objects}, indent=1) + "\n")
    return path


def object_urdf(item: PlacedObject, files: AssetFiles, folder: Path, kind: str = "") -> Path:
    """``<name>.urdf`` with exact parts, or of kind ``_bullet``, with parts that have their true size in PyBullet,
    which adds a margin. An object with values of its own has it in ``folder``. Mass may be 0 here.
    """
    asset = item.asset
    if (item.mass, item.friction, item.texture, item.tinted) != (asset.mass, files.friction, "none", False):
        return _write(item, files, kind, folder / f"{item.name}{kind}.urdf")
    name = f"{files.name(asset)}{kind}.urdf"
    return files.once(asset, f"urdf{kind}", lambda own: _write(item, files, kind, own / name))


def drake_contact(asset: Asset, friction: float) -> dict[str, float | None]:
    """Contact properties for Drake, tag to value. Contact is hydroelastic, over a patch, because Drake's point contact
    has only one point per pair of parts, on which a box rocks. Static assets are rigid, all others compliant.
    """
    shape: dict[str, float | None] = {"rigid_hydroelastic": None}
    if not asset.static:
        shape = {"compliant_hydroelastic": None, "hydroelastic_modulus": _MODULUS}
    return {**shape, "mu_static": friction, "mu_dynamic": friction}


def inertia_entries(item: PlacedObject) -> dict[str, str]:
    """The six entries ``ixx`` … of the inertia (kg m^2) as text."""
    return {f"i{'xyz'[i]}{'xyz'[j]}": number(item.inertia[i, j]) for i in range(3) for j in range(i, 3)}


def relative(path: Path, folder: Path) -> str:
    """``path`` as seen from ``folder``, with forward slashes."""
    return Path(os.path.relpath(path, folder)).as_posix()


def write_xml(root: ET.Element, path: Path) -> Path:
    """Write an XML document, indented."""
    ET.indent(root)
    path.write_text('<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return path


def _write(item: PlacedObject, files: AssetFiles, kind: str, path: Path) -> Path:
    names = [files.name(item.asset), *(joint.link for joint in item.joints)]
    root = ET.Element("robot", {"name": names[0], "xmlns:drake": DRAKE})
    for name, piece in zip(names, item.pieces, strict=True):
        _add_link(root, name, piece, files, kind, path)
    for joint in item.joints:
        is_endless = np.isinf(joint.limits[0])
        element = ET.SubElement(root, "joint", name=joint.name, type="continuous" if is_endless else joint.kind)
        ET.SubElement(element, "parent", link=names[joint.parent])
        ET.SubElement(element, "child", link=joint.link)
        ET.SubElement(element, "origin", xyz=numbers(joint.pose[:3, 3]), rpy=numbers(roll_pitch_yaw(joint.pose)))
        ET.SubElement(element, "axis", xyz=numbers(joint.axis))
        ET.SubElement(element, "dynamics", damping=number(joint.damping), friction=number(joint.friction))
        if not is_endless:  # a file without effort and velocity is none; no motor drives it, at any speed
            low, high = map(number, joint.limits)
            ET.SubElement(element, "limit", lower=low, upper=high, effort="0", velocity="1000")
    return write_xml(root, path)


def _add_link(root: ET.Element, name: str, item: PlacedObject, files: AssetFiles, kind: str, path: Path) -> None:
    asset = item.asset
    link = ET.SubElement(root, "link", name=name)
    contact = ET.SubElement(link, "contact")  # read by PyBullet, which multiplies the coefficients of the two bodies
    ET.SubElement(contact, "lateral_friction", value=number(math.sqrt(item.friction)))
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=numbers(asset.center_of_mass), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=number(item.mass))
    ET.SubElement(inertial, "inertia", inertia_entries(item))
    visual, file = ET.SubElement(link, "visual"), files.visual(asset, item.texture)
    ET.SubElement(ET.SubElement(visual, "geometry"), "mesh", filename=relative(file, path.parent))
    if item.tinted:
        material = ET.SubElement(visual, "material", name=f"{item.name}.color")
        ET.SubElement(material, "color", rgba=f"{numbers(item.color)} 1")
    for part in files.inset_parts(asset, BULLET_MARGIN) if kind else files.parts(asset):
        collision = ET.SubElement(link, "collision", name=part.stem)
        mesh = ET.SubElement(ET.SubElement(collision, "geometry"), "mesh", filename=relative(part, path.parent))
        ET.SubElement(mesh, "drake:declare_convex")
        proximity = ET.SubElement(collision, "drake:proximity_properties")
        for tag, value in drake_contact(asset, item.friction).items():
            ET.SubElement(proximity, f"drake:{tag}", {} if value is None else {"value": number(value)})


def roll_pitch_yaw(rotation: Array) -> Array:
    """(3,) angles (rad) about the fixed axes x, y, z, in this order, whose rotation is ``rotation`` (3, 3).

    Roll is what is left once yaw is undone, so that the rotation is exact at a pitch of 90 degrees too.

    >>> roll_pitch_yaw(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])).round(6).tolist()
    [0.0, 0.0, 1.570796]
    """
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    sin, cos = np.sin(yaw), np.cos(yaw)
    pitch = np.arctan2(-rotation[2, 0], cos * rotation[0, 0] + sin * rotation[1, 0])
    roll = np.arctan2(sin * rotation[0, 2] - cos * rotation[1, 2], cos * rotation[1, 1] - sin * rotation[0, 1])
    return np.array([roll, pitch, yaw]) + 0.0
