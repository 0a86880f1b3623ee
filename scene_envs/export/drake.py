"""Drake model directives: one file per scene, over the URDF of each asset."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from scene_envs.errors import InvalidInputError
from scene_envs.export.placed import AssetFiles, PlacedObject, PlacedScene, angle_axis, number
from scene_envs.export.urdf import object_urdf, relative
from scene_envs.files import write_text


class _AngleAxis(dict[str, Any]):
    """Mapping that is written with the YAML tag ``!AngleAxis``."""


class _Dumper(yaml.SafeDumper):
    """YAML writer: block style outside, flow style for lists of numbers, doubles in full precision."""


_Dumper.add_representer(
    _AngleAxis, lambda dumper, value: dumper.represent_mapping("!AngleAxis", value, flow_style=True)
)
_Dumper.add_representer(float, lambda dumper, value: dumper.represent_scalar("tag:yaml.org,2002:float", number(value)))


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.dmd.yaml``; its package is the whole export, whose ``package.xml`` is written here too."""
    package = _write_package(files)
    directives = [directive for item in scene.objects for directive in _directives(item, files, folder, package)]
    path = folder / "scene.dmd.yaml"
    text = yaml.dump({"directives": directives}, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=200)
    path.write_text(text)
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


def _directives(item: PlacedObject, files: AssetFiles, folder: Path, package: str) -> list[dict[str, Any]]:
    link = files.name(item.asset)
    file = f"package://{package}/{relative(object_urdf(item, files, folder), files.root.parent)}"
    model: dict[str, Any] = {"name": item.name, "file": file}
    angle, axis = angle_axis(item.rotation)
    pose = {
        "translation": item.translation.tolist(),
        "rotation": _AngleAxis(angle_deg=angle, axis=axis.tolist()),
    }
    if not item.welded:
        model["default_free_body_pose"] = {link: {"base_frame": "world", **pose}}
        return [{"add_model": model}]
    weld = {"parent": "world", "child": f"{item.name}::{link}", "X_PC": pose}
    return [{"add_model": model}, {"add_weld": weld}]
