"""Scenes built by hand, and others changed by hand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from scene_envs.scene import SceneBatch

TOP, UPPER, LOWER, BOTTOM = 0.4075, 0.1392, -0.1232, -0.3915
"""Tiers of the shelf, m."""

Placing = tuple[str, tuple[float, float, float]] | tuple[str, tuple[float, float, float], Tensor]
"""Asset, position (m), rotation (identity when left out)."""


def build(scene_type: str, objects: Sequence[Placing]) -> SceneBatch:
    """One scene: the fixed objects of its type, then ``objects``."""
    scene = SceneBatch.empty(scene_type, 1)
    translations, rotations = scene.translations.clone(), torch.eye(3).expand(1, scene.tensor.shape[1], 3, 3).clone()
    categories = scene.categories.clone()
    for slot, (asset, position, *rotation) in enumerate(objects, start=len(scene.scene_type.fixed)):
        categories[0, slot] = scene.scene_type.assets.index(asset)
        translations[0, slot] = torch.tensor(position)
        if rotation:
            rotations[0, slot] = rotation[0]
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def yaw(angle: float) -> Tensor:
    """(3, 3) about z, rad."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def pitch(angle: float) -> Tensor:
    """(3, 3) about y, rad."""
    cos, sin = math.cos(angle), math.sin(angle)
    return torch.tensor([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])


def without(scene: SceneBatch, slot: int) -> SceneBatch:
    """The first scene with one object less."""
    categories = scene.categories.clone()
    categories[0, slot] = scene.scene_type.num_assets
    return SceneBatch.from_parts(scene.translations, scene.rotations, categories, scene.scene_type)


def moved(scene: SceneBatch, slot: int, to: Sequence[float] | Tensor) -> SceneBatch:
    """The first scene with one object elsewhere."""
    translations = scene.translations.clone()
    translations[0, slot] = torch.as_tensor(to)
    return scene.with_poses(translations, scene.rotations)


def jittered(scene: SceneBatch, meters: float, degrees: float, seed: int) -> SceneBatch:
    """All scenes with Gaussian noise on the poses of free objects, as samples of a prior have."""
    generator = torch.Generator().manual_seed(seed)
    free = scene.is_free
    shift = meters * torch.randn(scene.translations.shape, generator=generator) * free[..., None]
    angles = math.radians(degrees) * torch.randn(*free.shape, 3, generator=generator) * free[..., None]
    x, y, z = angles.unbind(dim=-1)
    zero = torch.zeros_like(x)
    tilt = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return scene.with_poses(scene.translations + shift, torch.linalg.matrix_exp(tilt) @ scene.rotations)
