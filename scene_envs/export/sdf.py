"""SDF: one world per scene, for Gazebo, Drake and others."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, number, numbers
from scene_envs.export.urdf import DRAKE, drake_contact, relative, write_xml


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``world.sdf``: one model per object, static when it is welded; poses are quaternions."""
    root = ET.Element("sdf", {"version": "1.9", "xmlns:drake": DRAKE})
    world = ET.SubElement(root, "world", name=f"{scene.scene_type.name}_{scene.index}")
    light = ET.SubElement(world, "light", type="directional", name="sun")
    _text(light, "pose", "0 0 10 0 0 0")
    _text(light, "direction", "-0.3 0.4 -1")
    _text(light, "diffuse", "0.9 0.9 0.9 1")
    for item in scene.objects:
        _add_model(world, item, files, folder)
    return write_xml(root, folder / "world.sdf")


def _add_model(world: ET.Element, item: PlacedObject, files: AssetFiles, folder: Path) -> None:
    asset = item.asset
    model = ET.SubElement(world, "model", name=item.name)
    pose = _text(model, "pose", numbers(np.concatenate([item.translation, np.roll(item.quaternion, -1)])))
    pose.set("rotation_format", "quat_xyzw")
    if item.welded:
        _text(model, "static", "true")
    link = ET.SubElement(model, "link", name=files.name(asset))
    if asset.mass > 0:
        inertial = ET.SubElement(link, "inertial")
        _text(inertial, "pose", f"{numbers(asset.center_of_mass)} 0 0 0")
        _text(inertial, "mass", number(asset.mass))
        inertia = ET.SubElement(inertial, "inertia")
        for i, a in enumerate("xyz"):
            for j in range(i, 3):
                _text(inertia, f"i{a}{'xyz'[j]}", number(asset.inertia[i, j]))
    visual = ET.SubElement(link, "visual", name="visual")
    _add_mesh(visual, files.visual(asset), folder)
    for part in files.parts(asset):
        collision = ET.SubElement(link, "collision", name=part.stem)
        ET.SubElement(_add_mesh(collision, part, folder), "drake:declare_convex")
        ode = ET.SubElement(ET.SubElement(ET.SubElement(collision, "surface"), "friction"), "ode")
        _text(ode, "mu", number(files.friction))
        _text(ode, "mu2", number(files.friction))
        proximity = ET.SubElement(collision, "drake:proximity_properties")
        for tag, value in drake_contact(asset, files.friction).items():
            _text(proximity, f"drake:{tag}", "" if value is None else number(value))


def _add_mesh(parent: ET.Element, path: Path, folder: Path) -> ET.Element:
    mesh = ET.SubElement(ET.SubElement(parent, "geometry"), "mesh")
    _text(mesh, "uri", relative(path, folder))
    return mesh


def _text(parent: ET.Element, tag: str, text: str) -> ET.Element:
    element = ET.SubElement(parent, tag)
    element.text = text
    return element
