"""Files of one scene without physics: ``.npz`` and a coloured ``.glb``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb

from scene_envs.export.placed import AssetFiles, PlacedScene, linear, textured_mesh

Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""World frame (z up) to the frame of glTF (y up)."""


def write_npz(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.npz``, which ``numpy.load`` alone can read, of the n objects of a scene in slot order: ``translations``
    (n, 3) float64 m, ``rotations`` (n, 3, 3) float64, ``categories`` and ``slots`` (n,) int64, ``welded`` (n,) bool,
    ``names`` (n,) text, ``asset_names`` (C,) text in category order, and ``scene_type``, one text.
    """
    path, objects = folder / "scene.npz", scene.objects
    arrays: dict[str, Any] = {
        "translations": np.array([item.translation for item in objects], dtype=np.float64).reshape(-1, 3),
        "rotations": np.array([item.rotation for item in objects], dtype=np.float64).reshape(-1, 3, 3),
        "categories": np.array([item.category for item in objects], dtype=np.int64),
        "slots": np.array([item.slot for item in objects], dtype=np.int64),
        "welded": np.array([item.welded for item in objects], dtype=bool),
        "names": np.array([item.name for item in objects], dtype=str),
        "asset_names": np.array(scene.scene_type.assets, dtype=str),
        "scene_type": np.array(scene.scene_type.name),
    }
    np.savez(path, **arrays)
    return path


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.glb``: a node per object under a node ``z_up``, which turns the world frame to that of glTF."""
    graph = trimesh.Scene(base_frame="world")
    graph.graph.update("z_up", "world", matrix=Y_UP)
    for item in scene.objects:
        name, mesh = files.look(item), textured_mesh(item.asset, item.texture)
        if item.tinted:
            name, mesh = f"{item.name}.color", mesh.copy()
            visual: Any = mesh.visual
            visual.material.baseColorFactor = np.rint(255.0 * np.append(linear(item.color), 1.0)).astype(np.uint8)
        graph.geometry[name] = mesh
        graph.graph.update(item.name, "z_up", matrix=item.matrix, geometry=name)
    path = folder / "scene.glb"
    path.write_bytes(export_glb(graph, include_normals=True))
    return path
