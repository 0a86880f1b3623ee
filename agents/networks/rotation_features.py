"""Rotation features: how far noisy matrices are off SO(3), and off upright, in units of the noise on them.

A denoiser of nine numbers has to find out that they are those of a rotation, and that most things stand upright. Both
are differences as small as the noise, which a network that sees the numbers alone learns last: what lies flat in one
place and leans in another then lies flat to ten degrees only.
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
    """The rotations that are nearest to noisy matrices (B, N, 3, 3); the identity where there are no numbers."""
    with torch.autocast(rotation.device.type, enabled=False):
        wide = rotation if rotation.dtype == torch.float64 else rotation.float()
        return project_to_so3(wide.nan_to_num())


@torch.no_grad()
def rotation_features(rotation: Tensor, nearest: Tensor, noise: Tensor) -> Tensor:
    """Differences of matrices to SO(3), and of the nearest rotations to upright, (B, N, :data:`ROTATION_FEATURES`).

    Args:
        rotation: (B, N, 3, 3) noisy rotation matrices.
        nearest: (B, N, 3, 3) those of :func:`nearest_rotations`.
        noise: (B, N) standard deviation of the noise on their entries.

    Returns:
        The residual of the projection onto SO(3), row-major, over the noise: three of the nine numbers of the noise
        are not in it. Then R_20, R_21, R_02 and R_12 of the projection, which are 0 where the z-axes of object and
        world are parallel, over the noise and saturating. No gradient passes.

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

    Carried through the blocks they would be thirteen numbers of noise to keep for every object. So the network only has
    to say which of them count, which is a matter of the category and of where the object lies.
    """
    off, tilt = (features * gates).split([9, 4], dim=-1)
    return off.index_add(-1, torch.tensor(_TILTS, device=off.device), tilt)
