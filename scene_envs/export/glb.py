"""GLB: one coloured mesh file per scene, for viewers and renderers. No physics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb

from scene_envs.export.asset_files import AssetFiles
from scene_envs.export.placed import PlacedScene

Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""World frame (z up) to the frame of glTF (y up)."""


def write_scene(scene: PlacedScene, files: AssetFiles, folder: Path) -> Path:
    """``scene.glb``: a node per object under a node ``z_up``, which turns the world frame to that of glTF."""
    graph = trimesh.Scene(base_frame="world")
    graph.graph.update("z_up", "world", matrix=Y_UP)
    for asset in scene.assets:
        graph.geometry[files.name(asset)] = files.textured(asset)
    for item in scene.objects:
        graph.graph.update(item.name, "z_up", matrix=item.matrix, geometry=files.name(item.asset))
    path = folder / "scene.glb"
    path.write_bytes(export_glb(graph, include_normals=True))
    return path
