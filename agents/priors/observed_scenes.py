"""Masks of the regenerated entries of scenes, and scenes in which those entries are new."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from scene_envs.errors import InvalidInputError
from scene_envs.scene import CATEGORY, POSE, SceneBatch


def check_mask(
    batch: SceneBatch, mask: Tensor, generators: Sequence[Generator] | None = None, resample: int = 1
) -> Tensor:
    """The mask as (B, N, 2), a copy; raises InvalidInputError when an argument does not fit ``batch``."""
    expected = tuple(batch.tensor.shape[:2])
    if tuple(mask.shape) not in (expected, (*expected, 2)) or mask.dtype != torch.bool:
        raise InvalidInputError(
            f"mask must be bool of shape {expected}, or {(*expected, 2)} for pose and category, "
            f"got {mask.dtype} {tuple(mask.shape)}"
        )
    if generators is not None and len(generators) != len(batch):
        raise InvalidInputError(f"{len(generators)} generators for {len(batch)} scenes; give one per scene")
    if resample < 1:
        raise InvalidInputError(f"resample={resample}: every step is taken at least once")
    return (mask if mask.ndim == 3 else torch.stack([mask, mask], dim=-1)).clone()


def merge(batch: SceneBatch, new: SceneBatch, mask: Tensor) -> SceneBatch:
    """``batch`` with the poses and categories of ``new`` where ``mask`` (B, N, 2) says so."""
    empty = batch.scene_type.num_assets
    taken = mask[..., 1] & (mask[..., 0] | (new.is_empty == batch.is_empty))  # if the pose is kept, emptiness is too
    category = torch.where(taken[..., None], new.tensor[..., CATEGORY], batch.tensor[..., CATEGORY])
    pose = torch.where(mask[..., :1], new.tensor[..., POSE], batch.tensor[..., POSE])
    gone = category.argmax(dim=-1, keepdim=True) == empty
    return SceneBatch(torch.cat([torch.where(gone, torch.zeros_like(pose), pose), category], dim=-1), batch.scene_type)
