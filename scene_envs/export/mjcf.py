"""MJCF: one model per scene, for MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.assets.base import Asset
from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, number, numbers, quaternion
from scene_envs.export.urdf import relative, write_xml
from scene_envs.physics.mujoco import SOLIMP, SOLREF, TIMESTEP
from scene_envs.physics.parts import principal_inertia
from scene_envs.scene_types import Camera


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.xml``: one body per object, with a free joint of the same name unless it is welded."""
    root, world = new_model(
        f"{scene.scene_type.name}_{scene.index}", scene.scene_type.camera, scene.assets, files, folder
    )
    for item in scene.objects:
        _add_body(world, item, files)
    return write_xml(root, folder / "scene.xml")


def new_model(
    name: str, camera: Camera, assets: Iterable[Asset], files: AssetFiles, folder: Path
) -> tuple[ET.Element, ET.Element]:
    """A model without bodies for a file in ``folder``, and its world: settings, the classes ``visual`` and
    ``collision`` of geometries, camera and light, and the meshes and materials of ``assets``.
    """
    root = ET.Element("mujoco", model=name)
    directory = relative(files.root, folder)
    ET.SubElement(root, "compiler", angle="radian", meshdir=directory, texturedir=directory)
    option = ET.SubElement(
        root, "option", timestep=number(TIMESTEP), integrator="implicitfast", cone="elliptic", impratio="10"
    )
    ET.SubElement(option, "flag", multiccd="enable")
    defaults = ET.SubElement(root, "default")
    visual = ET.SubElement(defaults, "default", {"class": "visual"})
    ET.SubElement(visual, "geom", type="mesh", contype="0", conaffinity="0", group="2", mass="0")
    collision = ET.SubElement(defaults, "default", {"class": "collision"})
    contact = {"friction": f"{number(files.friction)} 0.005 0.0001", "solref": numbers(SOLREF)}
    contact["solimp"] = numbers(SOLIMP[:3])  # the others are MuJoCo's defaults
    contact["gap"] = "0"  # Newton takes 0.1 m where a file says nothing, and stacks burst
    ET.SubElement(collision, "geom", {"type": "mesh", "group": "3", "mass": "0", **contact})
    shared, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    _add_view(root, shared, world, camera)
    for asset in assets:
        _add_asset(shared, asset, files)
    return root, world


def _add_asset(parent: ET.Element, asset: Asset, files: AssetFiles) -> None:
    name, visual = files.name(asset), files.visual(asset)
    texture = relative(visual.with_suffix(".png"), files.root)
    ET.SubElement(parent, "texture", name=name, type="2d", file=texture)
    ET.SubElement(parent, "material", name=name, texture=name, specular="0.2")
    ET.SubElement(parent, "mesh", name=f"{name}_visual", file=relative(visual, files.root), inertia="shell")
    for part in files.parts(asset):
        ET.SubElement(parent, "mesh", name=f"{name}_{part.stem}", file=relative(part, files.root))


def _add_body(world: ET.Element, item: PlacedObject, files: AssetFiles) -> None:
    asset, name = item.asset, files.name(item.asset)
    body = ET.SubElement(world, "body", name=item.name, pos=numbers(item.translation), quat=numbers(item.quaternion))
    if not item.welded:
        ET.SubElement(body, "freejoint", name=item.name)
        moments, axes = principal_inertia(item.inertia)
        ET.SubElement(
            body,
            "inertial",
            pos=numbers(asset.center_of_mass),
            quat=numbers(quaternion(axes)),
            mass=number(item.mass),
            diaginertia=numbers(moments),
        )
    tint = {} if min(item.color) == 1.0 else {"rgba": f"{numbers(item.color)} 1"}
    ET.SubElement(body, "geom", {"class": "visual", "mesh": f"{name}_visual", "material": name, **tint})
    own = {} if item.friction == files.friction else {"friction": f"{number(item.friction)} 0.005 0.0001"}
    for part in files.parts(asset):
        ET.SubElement(body, "geom", {"class": "collision", "mesh": f"{name}_{part.stem}", **own})


def _add_view(root: ET.Element, shared: ET.Element, world: ET.Element, camera: Camera) -> None:
    """Light, a pale background, and the scene type's camera under the name ``scene``."""
    visual = ET.SubElement(root, "visual")
    ET.SubElement(visual, "headlight", ambient="0.35 0.35 0.35", diffuse="0.35 0.35 0.35", specular="0 0 0")
    ET.SubElement(visual, "quality", shadowsize="4096")
    ET.SubElement(
        shared,
        "texture",
        type="skybox",
        builtin="flat",
        rgb1="0.95 0.95 0.95",
        rgb2="0.95 0.95 0.95",
        width="16",
        height="16",
    )
    ET.SubElement(world, "light", pos="0.6 -0.9 3", dir="-0.2 0.3 -1", directional="true", diffuse="0.3 0.3 0.3")
    backward = np.subtract(camera.position, camera.target)
    right = np.cross(camera.up, backward)
    up = np.cross(backward, right)
    axes = np.concatenate([right / np.linalg.norm(right), up / np.linalg.norm(up)])
    fovy = number(camera.fov_y)
    ET.SubElement(world, "camera", name="scene", pos=numbers(camera.position), xyaxes=numbers(axes), fovy=fovy)
