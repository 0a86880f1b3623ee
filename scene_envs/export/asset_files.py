"""The ``assets`` folder of an export: meshes of each asset, written once and shared by scenes and formats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from scene_envs.arrays import Array
from scene_envs.assets.base import Asset, ConvexPart
from scene_envs.assets.shapes import convex_hull
from scene_envs.export.placed import identifiers

_MAX_COLORS = 1024
_CELL = 4
"""Width of a colour's cell in the palette, pixels."""


class AssetFiles:
    """Writer of asset files; each file is written on first use.

    Args:
        folder: Folder of the assets, ``root``.
        assets: All assets of the export; their unique identifiers are derived from all names together.
        friction: Friction coefficient that formats write into their files.
        package: Name of the whole export, for formats whose paths need one.
    """

    def __init__(self, folder: Path, assets: Sequence[Asset], friction: float, package: str) -> None:
        self.root = folder
        self.friction = friction
        self.package = package
        self._names = identifiers(asset.name for asset in assets)
        self._done: dict[tuple[str, str], Any] = {}
        self._textured: dict[str, trimesh.Trimesh] = {}

    def name(self, asset: Asset) -> str:
        """The asset's name as an identifier, which is also the name of its folder."""
        return self._names[asset.name]

    def folder(self, asset: Asset) -> Path:
        """Folder of the asset's files."""
        folder = self.root / self.name(asset)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def once(self, asset: Asset, what: str, write: Callable[[Path], Any]) -> Any:
        """The result of ``write(folder)``, called once per asset and ``what``."""
        key = (asset.name, what)
        if key not in self._done:
            self._done[key] = write(self.folder(asset))
        return self._done[key]

    def visual(self, asset: Asset) -> Path:
        """``visual.obj`` with normals, its colours in ``visual.png``; one material, ``visual.mtl``."""
        return self.once(asset, "visual", lambda folder: _write_visual(visual_mesh(asset), folder))

    def textured(self, asset: Asset) -> trimesh.Trimesh:
        """The mesh with its palette in memory, for formats that embed meshes; writes nothing."""
        if asset.name not in self._textured:
            self._textured[asset.name] = textured_mesh(asset)
        return self._textured[asset.name]

    def parts(self, asset: Asset) -> list[Path]:
        """``part_00.obj`` …, the fine convex parts."""
        return self.once(asset, "part", lambda folder: _write_parts(asset.fine, folder, "part"))

    def inset_parts(self, asset: Asset, inset: float) -> list[Path]:
        """``inset_00.obj`` …, the fine parts with every face moved inward by ``inset`` m, for Bullet."""

        def write(folder: Path) -> list[Path]:
            from scene_envs.physics.geometry import inset_hull
            from scene_envs.physics.parts import PartGeometry

            hulls = [convex_hull(inset_hull(PartGeometry.of(part), inset)) for part in asset.fine]
            return _write_parts(hulls, folder, "inset")

        return self.once(asset, "inset", write)


def visual_mesh(asset: Asset) -> trimesh.Trimesh:
    """The asset's coloured mesh, or its convex parts in the class colour where it has none."""
    mesh: trimesh.Trimesh | None = asset.visual
    if mesh is not None and len(mesh.faces):
        return mesh
    parts = [trimesh.Trimesh(part.vertices, part.faces, process=False) for part in asset.fine]
    joined = trimesh.util.concatenate(parts)
    assert isinstance(joined, trimesh.Trimesh)
    joined.visual = trimesh.visual.ColorVisuals(joined, vertex_colors=np.array([*asset.color, 255], dtype=np.uint8))
    return joined


@dataclass(frozen=True, eq=False)
class Palette:
    """The colours of a mesh as a texture with one cell per colour."""

    image: NDArray[np.uint8]  # (H, W, 3) the texture
    uv: Array  # (K, 2) middle of each cell, v upward
    cells: NDArray[np.int64]  # (F,) cell of each face

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> Palette:
        """The palette of a mesh, of at most 1024 colours; if there are more, they are rounded."""
        colors, cells = np.unique(_few_colors(face_colors(mesh)), axis=0, return_inverse=True)
        side = int(np.ceil(np.sqrt(len(colors))))
        pixels = np.zeros((side * side, 3), dtype=np.uint8)
        pixels[: len(colors)] = colors
        image = pixels.reshape(side, side, 3).repeat(_CELL, axis=0).repeat(_CELL, axis=1)
        index = np.arange(len(colors))
        uv = np.stack([(index % side + 0.5) / side, 1.0 - (index // side + 0.5) / side], axis=1)
        return cls(image, uv, cells.ravel())


def textured_mesh(asset: Asset) -> trimesh.Trimesh:
    """The asset's mesh with a palette texture on a matt material; corners of several colours are split."""
    from PIL import Image

    mesh = visual_mesh(asset)
    palette = Palette.of(mesh)
    corners = np.stack([mesh.faces, np.repeat(palette.cells[:, None], 3, axis=1)], axis=-1).reshape(-1, 2)
    unique, faces = np.unique(corners, axis=0, return_inverse=True)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(palette.image), metallicFactor=0.0, roughnessFactor=0.7
    )
    return trimesh.Trimesh(
        mesh.vertices[unique[:, 0]],
        faces.reshape(-1, 3),
        vertex_normals=mesh.vertex_normals[unique[:, 0]],
        visual=trimesh.visual.TextureVisuals(uv=palette.uv[unique[:, 1]], material=material),
        process=False,
    )


def face_colors(mesh: trimesh.Trimesh) -> NDArray[np.uint8]:
    """(F, 3) colour of each face; textures are sampled at the corners."""
    visual: Any = mesh.visual
    if visual.kind == "texture":
        visual = visual.to_color()
        corners = np.asarray(visual.vertex_colors)[mesh.faces]
        return np.round(corners[..., :3].mean(axis=1)).astype(np.uint8)  # type: ignore[no-any-return]
    return np.asarray(visual.face_colors)[:, :3].astype(np.uint8)


def obj_text(vertices: Array, faces: NDArray[np.int64]) -> str:
    """A Wavefront file of one mesh without colours; vertices in m."""
    lines = [f"v {x:.12g} {y:.12g} {z:.12g}" for x, y, z in (vertices + 0.0).tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    return "\n".join(lines) + "\n"


def _write_parts(parts: Sequence[ConvexPart], folder: Path, prefix: str) -> list[Path]:
    paths = []
    for index, part in enumerate(parts):
        path = folder / f"{prefix}_{index:02d}.obj"
        path.write_text(obj_text(part.vertices, part.faces))
        paths.append(path)
    return paths


def _write_visual(mesh: trimesh.Trimesh, folder: Path) -> Path:
    """The mesh with one texture cell per colour: most loaders read textures, and few read colours of vertices."""
    from PIL import Image

    palette = Palette.of(mesh)
    Image.fromarray(palette.image).save(folder / "visual.png")
    (folder / "visual.mtl").write_text("newmtl palette\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd visual.png\n")
    lines = ["mtllib visual.mtl", "usemtl palette"]
    lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in (mesh.vertices + 0.0).tolist()]
    lines += [f"vn {x:.5g} {y:.5g} {z:.5g}" for x, y, z in (mesh.vertex_normals + 0.0).tolist()]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in palette.uv.tolist()]
    for (a, b, c), t in zip((mesh.faces + 1).tolist(), (palette.cells + 1).tolist(), strict=True):
        lines.append(f"f {a}/{t}/{a} {b}/{t}/{b} {c}/{t}/{c}")
    path = folder / "visual.obj"
    path.write_text("\n".join(lines) + "\n")
    return path


def _few_colors(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The colours, rounded to the largest number of bits per channel with which they fit into the palette."""
    for bits in range(8, 2, -1):
        step = 1 << (8 - bits)
        rounded = np.minimum(colors.astype(np.int64) // step * step + step // 2, 255).astype(np.uint8)
        if len(np.unique(rounded, axis=0)) <= _MAX_COLORS:
            break
    return rounded
