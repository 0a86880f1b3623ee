"""SDF: one world per scene, for Gazebo, Drake and others."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.arrays import Array
from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, number, numbers
from scene_envs.export.urdf import DRAKE, drake_contact, inertia_entries, relative, write_xml


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
    asset = item.asset
    model = ET.SubElement(world, "model", name=item.name)
    _text(model, "pose", numbers(np.concatenate([item.translation, roll_pitch_yaw(item.rotation)])))
    if item.welded:
        _text(model, "static", "true")
    link = ET.SubElement(model, "link", name=files.name(asset))
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


def _add_mesh(parent: ET.Element, path: Path, folder: Path) -> ET.Element:
    mesh = ET.SubElement(ET.SubElement(parent, "geometry"), "mesh")
    _text(mesh, "uri", relative(path, folder))
    return mesh


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


def _text(parent: ET.Element, tag: str, text: str) -> ET.Element:
    element = ET.SubElement(parent, tag)
    element.text = text
    return element
