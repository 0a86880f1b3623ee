"""Rotation features: differences of noisy matrices from SO(3) and from upright, in units of the noise on them.

A denoiser of the nine entries of a matrix has to learn that they form a rotation, and that most objects stand upright.
Both show in differences as small as the noise. A network that reads the entries alone learns such differences last. If
objects of a category lie flat in one place and lean in another, its samples lie flat only to ten degrees.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from agents.networks.flux_modules import FluxModule, FluxSizes, ModuleConfig, Scene
from scene_envs.rotations import project_to_so3

ROTATION_FEATURES = 9 + 4
"""Numbers per rotation."""
_TILTS = (6, 7, 2, 5)
"""Entries R_20, R_21, R_02 and R_12 of a row-major matrix."""
_LEAST_NOISE = 1e-4
_REACH = 4.0
"""Standard deviations at which the distance from upright saturates."""


@dataclass(frozen=True)
class RotationFeaturesConfig(ModuleConfig):
    """Features of rotations, read beside each pose and added, through gates, to the output of rotations."""

    name = "rotation_features"
    place = "output"
    reads_geometry = True
    reads_rotations = True

    @property
    def pose_width(self) -> int:
        return ROTATION_FEATURES

    def build(self, core: FluxSizes) -> RotationFeatures:
        return RotationFeatures(core.embedding)


class RotationFeatures(FluxModule):
    """Features (B, N, :data:`ROTATION_FEATURES`) of rotations, and gates on them that start at zero."""

    def __init__(self, embedding: int) -> None:
        super().__init__()
        self.gates = nn.Linear(embedding, ROTATION_FEATURES)
        nn.init.zeros_(self.gates.weight)
        nn.init.zeros_(self.gates.bias)

    def pose_features(self, scene: Scene) -> Tensor | None:
        if scene.noisy_rotation is None or scene.rotation is None or scene.rotation_noise is None:
            return None
        scene.kept[RotationFeaturesConfig.name] = rotation_features(
            scene.noisy_rotation, scene.rotation, scene.rotation_noise
        )
        return scene.kept[RotationFeaturesConfig.name]

    def pose_output(self, scene: Scene, features: Tensor) -> Tensor | None:
        turns = scene.kept.get(RotationFeaturesConfig.name)
        return None if turns is None else F.pad(gated_rotation(turns, self.gates(features)), (3, 0))


@torch.no_grad()
def nearest_rotations(rotation: Tensor) -> Tensor:
    """The rotations that are nearest to noisy matrices (B, N, 3, 3); the identity where all entries are NaN."""
    with torch.autocast(rotation.device.type, enabled=False):
        wide = rotation if rotation.dtype == torch.float64 else rotation.float()
        return project_to_so3(wide.nan_to_num())


@torch.no_grad()
def rotation_features(rotation: Tensor, nearest: Tensor, noise: Tensor) -> Tensor:
    """Differences of matrices from SO(3), and of the nearest rotations from upright, (B, N, :data:`ROTATION_FEATURES`).

    Args:
        rotation: (B, N, 3, 3) noisy rotation matrices.
        nearest: (B, N, 3, 3) their nearest rotations, from :func:`nearest_rotations`.
        noise: (B, N) standard deviation of the noise on the entries of ``rotation``.

    Returns:
        The residual of the projection onto SO(3), row-major, divided by the noise; three of the nine dimensions of the
        noise are not in it. Then R_20, R_21, R_02 and R_12 of the projection, divided by the noise and saturating. They
        are 0 where the z-axes of object and world are parallel. No gradient passes.

    >>> upright = torch.eye(3).expand(1, 2, 3, 3)
    >>> rotation_features(upright, nearest_rotations(upright), torch.full((1, 2), 0.1)).abs().max() < 1e-5
    tensor(True)
    """
    level = noise.to(nearest).clamp(min=_LEAST_NOISE)[..., None]
    off = (rotation.to(nearest) - nearest).flatten(-2) / level
    tilt = nearest.flatten(-2)[..., list(_TILTS)]
    return torch.cat([off, tilt / (level.square() + (tilt / _REACH).square()).sqrt()], dim=-1)


def gated_rotation(features: Tensor, gates: Tensor) -> Tensor:
    """Contribution of features (B, N, F) to the nine outputs of a rotation, each with a gate (B, N, F) of its own.

    If the features had to pass through the blocks, the blocks would have to carry thirteen noisy numbers for every
    object. With gates, the network only has to predict which features count. This depends on the category and on where
    the object lies.
    """
    off, tilt = (features * gates).split([9, 4], dim=-1)
    return off.index_add(-1, torch.tensor(_TILTS, device=off.device), tilt)
