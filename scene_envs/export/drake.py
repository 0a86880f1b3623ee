"""Drake model directives: one file per scene, over the URDF of each asset."""

from __future__ import annotations

import re
from pathlib import Path

from scene_envs.errors import InvalidInputError
from scene_envs.export.placed import AssetFiles, PlacedScene, angle_axis, number
from scene_envs.export.urdf import object_urdf, relative
from scene_envs.files import write_text


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.dmd.yaml``; its package is the whole export, whose ``package.xml`` is written here too."""
    package = _write_package(files)
    lines = ["directives:"]
    for item in scene.objects:
        file = f"package://{package}/{relative(object_urdf(item, files, folder), files.root.parent)}"
        angle, axis = angle_axis(item.rotation)
        place, turn = (f"[{', '.join(map(number, values))}]" for values in (item.translation, axis))
        pose = f"translation: {place}, rotation: !AngleAxis {{angle_deg: {number(angle)}, axis: {turn}}}"
        link = files.name(item.asset)  # in quotes, or YAML takes an asset called ``no`` for false
        free = f', default_free_body_pose: {{"{link}": {{base_frame: world, {pose}}}}}'
        lines.append(f"- add_model: {{name: {item.name}, file: '{file}'{'' if item.welded else free}}}")
        if item.welded:
            lines.append(f"- add_weld: {{parent: world, child: '{item.name}::{link}', X_PC: {{{pose}}}}}")
    path = folder / "scene.dmd.yaml"
    path.write_text("\n".join([*lines, ""]))
    return path


def _write_package(files: AssetFiles) -> str:
    """Write ``package.xml`` into the export folder unless it exists; returns the name in it."""
    path = files.root.parent / "package.xml"
    if path.exists() and (text := path.read_text().strip()):
        found = re.search(r"<name>\s*([^<\s]+)\s*</name>", text)
        if not found:
            raise InvalidInputError(
                f"{path} has no <name>, so that Drake cannot find the assets; name the package there, or "
                "export into another folder"
            )
        return found[1]
    write_text(
        path,
        f'<?xml version="1.0"?>\n<package format="2">\n  <name>{files.package}</name>\n  <version>1.0.0</version>\n'
        "  <description>Scenes and their assets.</description>\n</package>\n",
    )
    return files.package
