"""Scene tokens, the input of learned measures: one token per object, with its nearest neighbours."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.rotations import quaternion_to_matrix
from scene_envs.scene import SceneBatch

NEIGHBOURS = 4
"""Neighbours described per object."""
NEIGHBOUR_FEATURES = 7
"""Numbers per neighbour: offset (3), gap per axis (3), gap of the horizontal outlines."""
WAVE_FEATURES = 26
"""Numbers of the Fourier features of a translation."""

_HORIZONTAL_WAVES = (16.0, 4.0, 1.0)
_VERTICAL_WAVES = (2.56, 1.28, 0.64, 0.32, 0.16, 0.08, 0.04)
"""Wavelengths (m) of the Fourier features of x and y, and of z; those of z are finer: heights are few and exact."""
_NEAR = 0.005
"""Gaps (m) are given as asinh(gap / 0.005), which resolves millimetres around contact and stays small in a room."""
_TIE_BREAK = (7.1e-5, 5.3e-5, 3.1e-5)
"""Distance added per metre of offset. Objects that touch are equally near; without this term the order of slots would
choose between them."""
_FAR = 1e6
_CHUNK = 256


@dataclass(frozen=True)
class SceneTokens:
    """B scenes of up to N objects; rows past the objects of a scene are padding.

    Attributes:
        poses: (B, N, 12) translation (m) and rotation matrix row-major.
        waves: (B, N, 26) Fourier features of the translation.
        categories: (B, N) int64 asset, C where there is none.
        extents: (B, N, 3) asset bounding box, m.
        offsets: (B, N, K, 7) offsets to each of the nearest neighbours, see :func:`scene_tokens`.
        neighbours: (B, N, K) int64 assets of these neighbours, C where there is none.
        present: (B, N) bool, False for padding.
    """

    poses: Tensor
    waves: Tensor
    categories: Tensor
    extents: Tensor
    offsets: Tensor
    neighbours: Tensor
    present: Tensor

    def __len__(self) -> int:
        return self.poses.shape[0]

    def __getitem__(self, index: Tensor | slice) -> SceneTokens:
        """Some of the scenes, with no more padding than they need."""
        picked = [getattr(self, field.name)[index] for field in fields(self)]
        longest = max(1, int(picked[-1].sum(dim=-1).max())) if picked[-1].shape[0] else 1
        return SceneTokens(*(part[:, :longest] for part in picked))


def scene_tokens(batch: SceneBatch, neighbours: int = NEIGHBOURS) -> SceneTokens:
    """Describe every object of every scene; the order of the slots affects only the order of the rows.

    The neighbours of an object are those whose world-aligned bounding boxes come nearest to its own, or overlap it
    most; among equals, those whose centres are nearest. Each neighbour has these numbers: the offset of its frame, as
    asinh(offset / 0.1 m); the gap between the two boxes along x, y and z (negative where they overlap), and the gap
    between the circles around the two outlines seen from above, as asinh(gap / 5 mm).

    Args:
        batch: B scenes.
        neighbours: number K of neighbours.
    """
    if not len(batch):
        raise InvalidInputError("a learned measure needs at least one scene, got none")
    parts = [_tokens(batch[start : start + _CHUNK], neighbours) for start in range(0, len(batch), _CHUNK)]
    width = max(part.poses.shape[1] for part in parts)
    empty = batch.scene_type.num_assets
    joined = []
    for field in fields(SceneTokens):
        fill = empty if field.name in ("categories", "neighbours") else 0
        joined.append(torch.cat([_padded(getattr(part, field.name), 1, width, fill) for part in parts]))
    return SceneTokens(*joined)


def blurred(
    batch: SceneBatch, translation: float | Tensor, rotation: float | Tensor, generator: torch.Generator
) -> SceneBatch:
    """The scenes with Gaussian noise on all poses.

    Args:
        batch: the scenes.
        translation: standard deviation per axis, m; a number, or a tensor that broadcasts to (B, N, 3).
        rotation: standard deviation of the rotation vector per axis, rad; a number, or a tensor like ``translation``.
        generator: random generator of the noise.
    """
    shape = batch.translations.shape
    shift = translation * torch.randn(shape, generator=generator)
    half = 0.5 * rotation * torch.randn(shape, generator=generator)
    turn = quaternion_to_matrix(torch.cat([torch.ones(*shape[:-1], 1), half], dim=-1))
    return batch.with_poses(batch.translations + shift, turn @ batch.rotations)


def asset_extents(batch: SceneBatch) -> Tensor:
    """(C + 1, 2, 3) m: lowest and highest corner of each asset in its own frame; zeros for empty."""
    bounds = [asset.bounds for asset in batch.scene_type.library]
    return torch.tensor(np.stack([*bounds, np.zeros((2, 3))]), dtype=torch.float32)


def _tokens(batch: SceneBatch, neighbours: int) -> SceneTokens:
    order = batch.is_empty.to(torch.uint8).argsort(dim=1, stable=True)[:, : max(1, int(batch.counts.max()))]
    categories = batch.categories.gather(1, order)
    poses = batch.tensor[..., :12].gather(1, order[..., None].expand(-1, -1, 12))
    present = categories != batch.scene_type.num_assets
    bounds = asset_extents(batch)[categories]  # (B, N, 2, 3)
    translations, rotations = poses[..., :3], poses[..., 3:].unflatten(-1, (3, 3))
    half = 0.5 * (bounds[..., 1, :] - bounds[..., 0, :])
    center = translations + (rotations @ bounds.mean(dim=-2)[..., None])[..., 0]
    reach = (rotations.abs() @ half[..., None])[..., 0]  # half extents of the box along world axes
    gap = (center[:, :, None] - center[:, None]).abs() - reach[:, :, None] - reach[:, None]  # (B, N, N, 3)
    offset = center[:, None] - center[:, :, None]  # to the column's object
    apart = gap.amax(dim=-1) + 0.01 * offset.norm(dim=-1) + (offset * torch.tensor(_TIE_BREAK)).sum(dim=-1)
    apart = apart.masked_fill(~present[:, None] | torch.eye(apart.shape[1], dtype=torch.bool), _FAR)
    count = min(neighbours, apart.shape[1])
    distance, nearest = apart.topk(count, dim=-1, largest=False)
    there = (distance < _FAR) & present[..., None]
    radius = half[..., :2].mean(dim=-1)
    shift = _at(translations, nearest) - translations[:, :, None]
    outline = (_at(center, nearest) - center[:, :, None])[..., :2].norm(dim=-1) - radius[:, :, None]
    outline = outline - _at(radius[..., None], nearest)[..., 0]
    gaps = gap.gather(2, nearest[..., None].expand(-1, -1, -1, 3))
    offsets = torch.cat(
        [torch.asinh(shift / 0.1), torch.asinh(gaps / _NEAR), torch.asinh(outline / _NEAR)[..., None]], dim=-1
    )
    names = _at(categories[..., None], nearest)[..., 0].masked_fill(~there, batch.scene_type.num_assets)
    return SceneTokens(
        poses,
        _waves(translations) * present[..., None],
        categories,
        2.0 * half,
        _padded(offsets * there[..., None], 2, neighbours, 0.0),
        _padded(names, 2, neighbours, batch.scene_type.num_assets),
        present,
    )


def _waves(translations: Tensor) -> Tensor:
    """(B, N, 26) sines and cosines of the coordinates."""
    parts = [
        2.0 * math.pi / torch.tensor(waves) * translations[..., axis, None]
        for axis, waves in enumerate((_HORIZONTAL_WAVES, _HORIZONTAL_WAVES, _VERTICAL_WAVES))
    ]
    angle = torch.cat(parts, dim=-1)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def _at(values: Tensor, index: Tensor) -> Tensor:
    """Rows ``index`` (B, N, K) of ``values`` (B, N, F), as (B, N, K, F)."""
    rows = index.flatten(1)[..., None].expand(-1, -1, values.shape[-1])
    return values.gather(1, rows).unflatten(1, index.shape[1:])


def _padded(values: Tensor, dim: int, size: int, fill: float) -> Tensor:
    """``values`` with ``fill`` up to ``size`` along ``dim``."""
    extra = values.new_full((*values.shape[:dim], size - values.shape[dim], *values.shape[dim + 1 :]), fill)
    return torch.cat([values, extra], dim=dim)
