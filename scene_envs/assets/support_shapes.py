"""Shapes of assets for supports: extreme points, height of the upper side, hollows and tiers."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from scipy.ndimage import binary_fill_holes, grey_dilation
from torch import Tensor

from scene_envs.arrays import Array, Mask
from scene_envs.assets.base import Asset, AssetLibrary, ConvexPart

_GRID = 48
"""Cells along each side of a height map."""
_WIDEN = 0.01
"""Height maps reach at least this far (m) beyond the asset, so that rims meet rims in spite of small offsets."""
_HOLLOW = 0.03
"""An asset is a container when it is hollow to at least this depth (m)."""
_TIER_AREA = 0.3
"""A level of a static asset is a tier when it covers this share of the asset's bounding rectangle."""
_LEVEL = 0.005
"""Flat faces within this height (m) belong to one level."""


@dataclass(frozen=True, eq=False)
class LibraryShapes:
    """Shapes of C assets as padded float64 tensors on one device, in asset frames, m."""

    points: Tensor  # (C, 3, V) extreme points
    center: Tensor  # (C, 3) centre of mass
    bounds: Tensor  # (C, 2, 3) lowest and highest corner
    top: Tensor  # (C, G, G) height of the upper side per cell; -inf outside the asset
    wide: Tensor  # (C, G, G) height of the upper side, widened by about a centimetre
    covered: Tensor  # (C, G, G) bool, the widened outline with its holes filled
    low: Tensor  # (C, 2) lowest corner of the maps
    cell: Tensor  # (C, 2) size of a cell
    rim: Tensor  # (C,) height of the lowest way out of a container; -inf for other assets
    tiers: Tensor  # (C, L) heights of tiers from the top, NaN beyond their number; assets with fewer than two have none
    static: Tensor  # (C,) bool

    def cells(self, category: Tensor, points: Tensor) -> tuple[Tensor, ...]:
        """Indices (category, i, j) of asset-frame ``points`` (..., 3) into the maps; cells at the edge are empty."""
        where = ((points[..., :2] - self.low[category]) / self.cell[category]).floor().clamp(0, _GRID - 1).long()
        return category, where[..., 0], where[..., 1]


@lru_cache(maxsize=32)
def library_shapes(library: AssetLibrary, device: torch.device) -> LibraryShapes:
    """The shapes of ``library``, made once, and copied to each device once."""
    if device.type != "cpu":
        made = library_shapes(library, torch.device("cpu"))
        return LibraryShapes(**{name: table.to(device) for name, table in vars(made).items()})
    assets = list(library)
    top, wide, covered, low, cell = map(np.stack, zip(*map(_maps, assets), strict=True))
    points = [_extreme_points(asset.fine) for asset in assets]
    size = max(len(p) for p in points)
    levels = [_tiers(asset) for asset in assets]
    most = max(1, *(len(level) for level in levels))
    tables = {name: np.stack([getattr(asset, name) for asset in assets]) for name in ("bounds", "static")}
    tables["rim"] = np.array([_rim(asset, *maps) for asset, *maps in zip(assets, top, wide, low, cell, strict=True)])
    tables["center"] = np.stack([asset.center_of_mass for asset in assets])
    tables |= {"top": top, "wide": wide, "covered": covered, "low": low, "cell": cell}
    tables["points"] = np.stack([np.concatenate([p, np.repeat(p[:1], size - len(p), axis=0)]).T for p in points])
    tables["tiers"] = np.stack([np.concatenate([level, np.full(most - len(level), np.nan)]) for level in levels])
    return LibraryShapes(**{name: torch.from_numpy(table.copy()) for name, table in tables.items()})


def _maps(asset: Asset) -> tuple[Array, Array, Mask, Array, Array]:
    """Height maps ``top``, ``wide``, ``covered``, ``low``, ``cell`` over the outline, two cells and 1 cm wider all
    round.
    """
    low, high = asset.bounds[:, :2]
    margin = np.maximum(_WIDEN, 3.0 * (high - low) / (_GRID - 6))
    cell = (high - low + 2.0 * margin) / _GRID
    low = low - margin
    x, y = (low[axis] + (np.arange(_GRID) + 0.5) * cell[axis] for axis in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    top = np.max([upper_side(part, grid) for part in asset.fine], axis=0)
    reach = np.maximum(1, np.round(_WIDEN / cell)).astype(int)
    wide = grey_dilation(top, size=tuple(2 * reach + 1), mode="constant", cval=-np.inf)
    wide[[0, -1]], wide[:, [0, -1]] = -np.inf, -np.inf
    return top, wide, binary_fill_holes(np.isfinite(wide)), low, cell


def upper_side(part: ConvexPart, grid: Array) -> Array:
    """(G, G): height of a convex part above each point of ``grid`` (G, G, 2); -inf outside it."""
    corners = part.vertices[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0] / length[length > 0, None]
    offsets = np.einsum("fi,fi->f", normals, corners[length > 0, 0])
    slack = offsets - grid @ normals[:, :2].T  # (G, G, F): n_z z <= slack inside
    up, down = normals[:, 2] > 1e-6, normals[:, 2] < -1e-6
    high = (slack[..., up] / normals[up, 2]).min(axis=-1)
    low = (slack[..., down] / normals[down, 2]).max(axis=-1)
    outside = (slack[..., ~(up | down)] < -1e-9).any(axis=-1)
    return np.where((high >= low - 1e-9) & ~outside, high, -np.inf)


def _extreme_points(parts: Iterable[ConvexPart]) -> Array:
    """(V, 3): the vertices that are furthest out in some 170 directions."""
    vertices = np.concatenate([part.vertices for part in parts])
    azimuth = np.arange(24) * np.pi / 12.0 + 1e-3
    elevation = np.radians([-80.0, -45.0, -10.0, 0.0, 10.0, 45.0, 80.0])[:, None]
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0.0 * azimuth],
        axis=-1,
    ).reshape(-1, 3)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return vertices[np.unique((vertices @ np.concatenate([directions, axes]).T).argmax(axis=0))]


def _rim(asset: Asset, top: Array, wide: Array, low: Array, cell: Array) -> float:
    """Height (m) of the lowest way out of the hollow around the centre of mass; -inf where there is no hollow."""
    start = asset.center_of_mass[:2]
    steps = np.linspace(0.0, 1.0, 2 * _GRID) * np.linalg.norm(asset.bounds[1, :2] - asset.bounds[0, :2])
    angles = np.arange(24) * np.pi / 12.0
    rays = start + steps[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)  # (S, 24, 2)
    cells = np.floor((rays - low) / cell).astype(int)
    outside = ((cells < 0) | (cells >= _GRID)).any(axis=-1)
    cells[outside] = 0
    heights = wide[cells[..., 0], cells[..., 1]]
    first = cells[0, 0]
    rim, well = float(heights.max(axis=0).min()), float(top[first[0], first[1]])
    return -np.inf if asset.static or not np.isfinite(well) or rim - well < _HOLLOW else rim


def _tiers(asset: Asset) -> Array:
    """Heights (m) of the tiers of a static asset, the highest first; empty when there is at most one."""
    if not asset.static:
        return np.empty(0)
    area: dict[int, float] = {}
    height: dict[int, float] = {}
    for part in asset.fine:
        corners = part.vertices[part.faces]
        normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat = normals[:, 2] > 0.999 * np.linalg.norm(normals, axis=1)
        for triangle, up in zip(corners[flat], normals[flat, 2], strict=True):
            level = round(triangle[0, 2] / _LEVEL)
            area[level] = area.get(level, 0.0) + up
            height[level] = triangle[0, 2]
    rectangle = float(np.prod(asset.bounds[1, :2] - asset.bounds[0, :2]))
    levels = sorted((height[level] for level, size in area.items() if size >= _TIER_AREA * rectangle), reverse=True)
    return np.array(levels) if len(levels) > 1 else np.empty(0)
