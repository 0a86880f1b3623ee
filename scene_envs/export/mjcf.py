"""MJCF: one model per scene, for MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np

from scene_envs.arrays import Array
from scene_envs.assets.base import Joint
from scene_envs.export.placed import (
    AssetFiles,
    Light,
    PlacedObject,
    PlacedScene,
    camera_axes,
    number,
    numbers,
    quaternion,
)
from scene_envs.export.urdf import relative, write_xml
from scene_envs.physics.mujoco import SOLIMP, SOLREF, TIMESTEP
from scene_envs.physics.parts import principal_inertia


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.xml``: one body per object, with a free joint of the same name unless it is welded. The links of a welded
    object are bodies in it, with their joints; they do not touch what they hang on.
    """
    pieces = [piece for item in scene.objects for piece in item.pieces]
    root, world = new_model(f"{scene.scene_type.name}_{scene.index}", scene, pieces, files, folder)
    for item in scene.objects:
        bodies = [_add_body(root, world, item.pieces[0], files)]
        for joint, link in zip(item.joints, item.pieces[1:], strict=True):
            bodies.append(_add_body(root, bodies[joint.parent], link, files, joint))
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
<worldbody/>
<visual><headlight ambient="0.35 0.35 0.35" diffuse="0.35 0.35 0.35" specular="0 0 0"/>
<quality shadowsize="4096"/></visual>
</mujoco>"""
"""Settings, and classes of geometries. Newton takes a gap of 0.1 m where a file says nothing, and stacks burst;
the last numbers of ``solimp`` are MuJoCo's defaults.
"""


def new_model(
    name: str, scene: PlacedScene, objects: Iterable[PlacedObject], files: AssetFiles, folder: Path
) -> tuple[ET.Element, ET.Element]:
    """A model without bodies for a file in ``folder``, and its world: settings, the classes ``visual`` and
    ``collision`` of geometries, the light ``lamp`` and the camera ``scene`` of ``scene``, and the meshes and materials
    of ``objects``.
    """
    numbers_of = {"step": number(TIMESTEP), "friction": number(files.friction)}
    root = ET.fromstring(_MODEL.format(**numbers_of, solref=numbers(SOLREF), solimp=numbers(SOLIMP[:3])))
    root.set("model", name)
    compiler, _, _, shared, world, _ = root
    for key in ("meshdir", "texturedir"):
        compiler.set(key, relative(files.root, folder))
    light, camera = {"name": "lamp", "pos": "0.6 -0.9 3", "directional": "true"}, scene.camera
    ET.SubElement(world, "light", light, dir=numbers(scene.light.direction), diffuse=numbers(diffuse(scene.light)))
    axes = numbers(camera_axes(camera.position, camera.target, camera.up)[:, :2].T)
    place = {"pos": numbers(camera.position), "xyaxes": axes, "fovy": number(camera.fov_y)}
    ET.SubElement(world, "camera", place, name="scene")
    looks = {files.look(item): item for item in sorted(objects, key=lambda item: (item.category, item.texture))}
    for name, item in looks.items():
        visual = files.visual(item.asset, item.texture)
        file = relative(visual.with_suffix(".png"), files.root)
        ET.SubElement(shared, "texture", name=name, type="2d", file=file)
        ET.SubElement(shared, "material", name=name, texture=name, specular="0.2")
        ET.SubElement(shared, "mesh", name=f"{name}_visual", file=relative(visual, files.root), inertia="shell")
    for asset in dict.fromkeys(item.asset for item in looks.values()):
        for part in files.parts(asset):
            ET.SubElement(shared, "mesh", name=f"{files.name(asset)}_{part.stem}", file=relative(part, files.root))
    return root, world


def diffuse(light: Light) -> Array:
    """(3,) red, green and blue of the lamp in MuJoCo, where other light comes from the viewer."""
    return 0.3 * light.intensity * np.array(light.color)


def _add_body(
    root: ET.Element, world: ET.Element, item: PlacedObject, files: AssetFiles, joint: Joint | None = None
) -> ET.Element:
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
    look = {"class": "visual", "mesh": f"{files.look(item)}_visual", "material": files.look(item)}
    if item.tinted:  # MuJoCo Warp reads colours of materials, and MuJoCo those of geometries unless they are grey
        tint = {"name": f"{item.name}.color", "rgba": f"{numbers(item.color)} 1"}
        ET.SubElement(root[3], "material", tint, texture=look["material"], specular="0.2")
        look |= {"material": tint["name"], "rgba": tint["rgba"]}
    ET.SubElement(body, "geom", look)
    own = {} if item.friction == files.friction else {"friction": f"{number(item.friction)} 0.005 0.0001"}
    for part in files.parts(asset):
        ET.SubElement(body, "geom", {"class": "collision", "mesh": f"{name}_{part.stem}", **own})
    return body
