"""SDF: one world per scene, for Gazebo, Drake and others."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.arrays import Array
from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, number, numbers
from scene_envs.export.urdf import DRAKE, drake_contact, inertia_entries, relative, roll_pitch_yaw, write_xml


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``world.sdf``: one model per object, static when it is welded.

    Rotations are roll, pitch and yaw, which every reader knows; PyBullet's takes quaternions for such angles.
    """
    root = ET.Element("sdf", {"version": "1.9", "xmlns:drake": DRAKE})
    world = ET.SubElement(root, "world", name=f"{scene.scene_type.name}_{scene.index}")
    light = ET.SubElement(world, "light", type="directional", name="sun")
    _text(light, "pose", "0 0 10 0 0 0")
    _text(light, "direction", numbers(scene.light.direction))
    _text(light, "diffuse", f"{numbers(0.9 * np.array(scene.light.color))} 1")
    _text(light, "intensity", number(scene.light.intensity))
    for item in scene.objects:
        _add_model(world, item, files, folder)
    return write_xml(root, folder / "world.sdf")


def _add_model(world: ET.Element, item: PlacedObject, files: AssetFiles, folder: Path) -> None:
    model = ET.SubElement(world, "model", name=item.name)
    _text(model, "pose", _pose(item.matrix))
    if item.welded and not item.joints:
        _text(model, "static", "true")
    names = [files.name(item.asset), *(joint.link for joint in item.joints)]
    links = [_add_link(model, *each, files, folder) for each in zip(names, item.pieces, strict=True)]
    for link, frame in zip(links[1:], item.frames[1:], strict=True):
        _text(link, "pose", _pose(frame))
    if item.joints:  # a static model has no joints that move
        _add_joint(model, f"{item.name}_weld", "fixed", "world", names[0])
    for joint in item.joints:
        is_endless = np.isinf(joint.limits[0])
        kind = "continuous" if is_endless else joint.kind
        axis = ET.SubElement(_add_joint(model, joint.name, kind, names[joint.parent], joint.link), "axis")
        _text(axis, "xyz", numbers(joint.axis))
        dynamics, limit = ET.SubElement(axis, "dynamics"), ET.SubElement(axis, "limit")
        _text(dynamics, "damping", number(joint.damping))
        _text(dynamics, "friction", number(joint.friction))
        for tag, value in zip(("lower", "upper"), (-1e16, 1e16) if is_endless else joint.limits, strict=True):
            _text(limit, tag, number(value))


def _pose(matrix: Array) -> str:
    return numbers(np.concatenate([matrix[:3, 3], roll_pitch_yaw(matrix)]))


def _add_joint(model: ET.Element, name: str, kind: str, parent: str, child: str) -> ET.Element:
    while any(element.get("name") == name for element in model):  # links and joints share their names
        name += "_joint"
    joint = ET.SubElement(model, "joint", name=name, type=kind)
    _text(joint, "parent", parent)
    _text(joint, "child", child)
    return joint


def _add_link(model: ET.Element, name: str, item: PlacedObject, files: AssetFiles, folder: Path) -> ET.Element:
    asset, link = item.asset, ET.SubElement(model, "link", name=name)
    if item.mass > 0:
        inertial = ET.SubElement(link, "inertial")
        _text(inertial, "pose", f"{numbers(asset.center_of_mass)} 0 0 0")
        _text(inertial, "mass", number(item.mass))
        inertia = ET.SubElement(inertial, "inertia")
        for tag, text in inertia_entries(item).items():
            _text(inertia, tag, text)
    visual = ET.SubElement(link, "visual", name="visual")
    file = files.visual(asset, item.texture)
    _add_mesh(visual, file, folder)
    if item.tinted:  # a material of a visual replaces that of its mesh
        material = ET.SubElement(visual, "material")
        _text(material, "diffuse", f"{numbers(item.color)} 1")
        metal = ET.SubElement(ET.SubElement(material, "pbr"), "metal")
        _text(metal, "albedo_map", relative(file.with_suffix(".png"), folder))
        _text(metal, "roughness", "0.7")
        _text(metal, "metalness", "0")
    for part in files.parts(asset):
        collision = ET.SubElement(link, "collision", name=part.stem)
        ET.SubElement(_add_mesh(collision, part, folder), "drake:declare_convex")
        ode = ET.SubElement(ET.SubElement(ET.SubElement(collision, "surface"), "friction"), "ode")
        _text(ode, "mu", number(item.friction))
        _text(ode, "mu2", number(item.friction))
        proximity = ET.SubElement(collision, "drake:proximity_properties")
        for tag, value in drake_contact(asset, item.friction).items():
            _text(proximity, f"drake:{tag}", "" if value is None else number(value))
    return link


def _add_mesh(parent: ET.Element, path: Path, folder: Path) -> ET.Element:
    mesh = ET.SubElement(ET.SubElement(parent, "geometry"), "mesh")
    _text(mesh, "uri", relative(path, folder))
    return mesh


def _text(parent: ET.Element, tag: str, text: str) -> ET.Element:
    element = ET.SubElement(parent, tag)
    element.text = text
    return element
