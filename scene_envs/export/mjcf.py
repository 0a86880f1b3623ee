"""MJCF: one model per scene, for MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.assets.base import Asset, Joint
from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, number, numbers, quaternion
from scene_envs.export.urdf import relative, write_xml
from scene_envs.physics.mujoco import SOLIMP, SOLREF, TIMESTEP
from scene_envs.physics.parts import principal_inertia
from scene_envs.scene_types import Camera


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.xml``: one body per object, with a free joint of the same name unless it is welded. The links of a welded
    object are bodies in it, with their joints; they do not touch what they hang on.
    """
    root, world = new_model(
        f"{scene.scene_type.name}_{scene.index}", scene.scene_type.camera, scene.bodies, files, folder
    )
    for item in scene.objects:
        bodies = [_add_body(world, item.pieces[0], files)]
        for joint, link in zip(item.joints, item.pieces[1:], strict=True):
            bodies.append(_add_body(bodies[joint.parent], link, files, joint))
            pair = {"body1": bodies[joint.parent].get("name", ""), "body2": link.name}
            contact = root.find("contact")
            ET.SubElement(ET.SubElement(root, "contact") if contact is None else contact, "exclude", pair)
    return write_xml(root, folder / "scene.xml")


_MODEL = """<mujoco>
<compiler angle="radian"/>
<option timestep="{step}" integrator="implicitfast" cone="elliptic" impratio="10"><flag multiccd="enable"/></option>
<default>
<default class="visual"><geom type="mesh" contype="0" conaffinity="0" group="2" mass="0"/></default>
<default class="collision"><geom type="mesh" group="3" mass="0" friction="{friction} 0.005 0.0001" solref="{solref}"
solimp="{solimp}" gap="0"/></default>
</default>
<asset>
<texture type="skybox" builtin="flat" rgb1="0.95 0.95 0.95" rgb2="0.95 0.95 0.95" width="16" height="16"/>
</asset>
<worldbody><light pos="0.6 -0.9 3" dir="-0.2 0.3 -1" directional="true" diffuse="0.3 0.3 0.3"/></worldbody>
<visual><headlight ambient="0.35 0.35 0.35" diffuse="0.35 0.35 0.35" specular="0 0 0"/>
<quality shadowsize="4096"/></visual>
</mujoco>"""
"""Settings, classes of geometries and light. Newton takes a gap of 0.1 m where a file says nothing, and stacks burst;
the last numbers of ``solimp`` are MuJoCo's defaults.
"""


def new_model(
    name: str, camera: Camera, assets: Iterable[Asset], files: AssetFiles, folder: Path
) -> tuple[ET.Element, ET.Element]:
    """A model without bodies for a file in ``folder``, and its world: settings, the classes ``visual`` and
    ``collision`` of geometries, light and the camera ``scene``, and the meshes and materials of ``assets``.
    """
    numbers_of = {"step": number(TIMESTEP), "friction": number(files.friction)}
    root = ET.fromstring(_MODEL.format(**numbers_of, solref=numbers(SOLREF), solimp=numbers(SOLIMP[:3])))
    root.set("model", name)
    compiler, _, _, shared, world, _ = root
    for key in ("meshdir", "texturedir"):
        compiler.set(key, relative(files.root, folder))
    backward = np.subtract(camera.position, camera.target)
    right = np.cross(camera.up, backward)
    up = np.cross(backward, right)
    axes = np.concatenate([right / np.linalg.norm(right), up / np.linalg.norm(up)])
    fovy = number(camera.fov_y)
    ET.SubElement(world, "camera", name="scene", pos=numbers(camera.position), xyaxes=numbers(axes), fovy=fovy)
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


def _add_body(world: ET.Element, item: PlacedObject, files: AssetFiles, joint: Joint | None = None) -> ET.Element:
    asset, name = item.asset, files.name(item.asset)
    body = ET.SubElement(world, "body", name=item.name, pos=numbers(item.translation), quat=numbers(item.quaternion))
    if not item.welded:
        if joint is None:
            ET.SubElement(body, "freejoint", name=item.name)
        else:
            named = {"name": f"{item.name.partition('/')[0]}/{joint.name}", "axis": numbers(joint.axis)}
            way = {"range": numbers(joint.limits)} if np.isfinite(joint.limits[0]) else {"limited": "false"}
            rubs = {"damping": number(joint.damping), "frictionloss": number(joint.friction)}
            kind = "slide" if joint.kind == "prismatic" else "hinge"
            ET.SubElement(body, "joint", {**named, "type": kind, **way, **rubs})
        moments, axes = principal_inertia(item.inertia)
        place = {"pos": numbers(asset.center_of_mass), "quat": numbers(quaternion(axes))}
        ET.SubElement(body, "inertial", place, mass=number(item.mass), diaginertia=numbers(moments))
    tint = {} if min(item.color) == 1.0 else {"rgba": f"{numbers(item.color)} 1"}
    ET.SubElement(body, "geom", {"class": "visual", "mesh": f"{name}_visual", "material": name, **tint})
    own = {} if item.friction == files.friction else {"friction": f"{number(item.friction)} 0.005 0.0001"}
    for part in files.parts(asset):
        ET.SubElement(body, "geom", {"class": "collision", "mesh": f"{name}_{part.stem}", **own})
    return body
