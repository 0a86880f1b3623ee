"""Texts of COLLADA and glTF files of one mesh, for tests of imports."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import trimesh

BOX = (0.2, 0.1, 0.04)


def dae(primitives: str, points: np.ndarray, **parts: str) -> str:
    """A COLLADA file of one geometry."""
    numbers = " ".join(map(str, np.asarray(points).ravel().tolist()))
    node = parts.get("node") or f'<instance_geometry url="#g">{parts.get("bind", "")}</instance_geometry>'
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="{parts.get("meter", "1")}"/><up_axis>{parts.get("up", "Z_UP")}</up_axis></asset>{
        parts.get("looks", "")
    }
<library_geometries><geometry id="g" name="body"><mesh><source id="p"><float_array id="a">{numbers}</float_array>
<technique_common><accessor source="#a" count="{len(points)}" stride="3"><param name="X" type="float"/><param name="Y"
type="float"/><param name="Z" type="float"/></accessor></technique_common></source><vertices id="v"><input
semantic="POSITION" source="#p"/></vertices>{primitives}</mesh></geometry></library_geometries>{parts.get("more", "")}
<library_visual_scenes><visual_scene id="s"><node id="n">{node}</node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def triangles(mesh: trimesh.Trimesh, material: str = "") -> str:
    rows = " ".join(map(str, mesh.faces.ravel().tolist()))
    return (
        f'<triangles count="{len(mesh.faces)}" {material}><input semantic="VERTEX" source="#v" offset="0"/>'
        f"<p>{rows}</p></triangles>"
    )


def block() -> trimesh.Trimesh:
    return trimesh.creation.box(BOX)


def gltf(points: np.ndarray, faces: np.ndarray, **changes: Any) -> bytes:
    """A glTF file of one mesh; ``changes`` replace what its header holds."""
    data = points.tobytes() + faces.astype("<u2").tobytes()
    kind = {"f": 5126, "h": 5122, "b": 5120, "B": 5121}[points.dtype.char]
    position = {
        "bufferView": 0,
        "componentType": kind,
        "count": len(points),
        "type": "VEC3",
        "normalized": kind != 5126,
    }
    width = points.shape[1] * points.itemsize
    header: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(data), "uri": "it.bin"}],
        "bufferViews": [
            {"buffer": 0, "byteLength": points.nbytes, "byteStride": width},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": 2 * faces.size},
        ],
        "accessors": [position, {"bufferView": 1, "componentType": 5123, "count": faces.size, "type": "SCALAR"}],
        "meshes": [{"name": "body", "primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    return json.dumps({**header, **changes}).encode(), data  # type: ignore[return-value]


POINTS = block().vertices.astype("<f4")
