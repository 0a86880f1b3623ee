"""Rotation representations: small pure functions on torch tensors.

All matrices map body-frame vectors to the frame they are expressed in. Angles are in radians, quaternions are (w, x, y,
z). All functions run in batches on the device of their argument and can be differentiated, which priors that diffuse
quaternions need; ``scipy.spatial.transform`` does neither.
"""

from __future__ import annotations

import torch
from torch import Tensor


def project_to_so3(matrices: Tensor) -> Tensor:
    """Nearest rotation matrix in the Frobenius norm, by SVD (Levinson et al. 2020).

    Args:
        matrices: (..., 3, 3) real matrices, finite.

    Returns:
        (..., 3, 3) rotation matrices with determinant +1, same dtype.

    >>> project_to_so3(torch.diag(torch.tensor([2.0, 1.0, 0.5])))
    tensor([[1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.]])
    """
    u, _, vt = torch.linalg.svd(matrices.double())
    det = torch.linalg.det(u @ vt)
    sign = torch.ones(*matrices.shape[:-2], 3, dtype=torch.float64, device=matrices.device)
    sign[..., 2] = torch.where(det < 0, -1.0, 1.0)
    return ((u * sign.unsqueeze(-2)) @ vt).to(matrices.dtype)


def yaw_matrix(yaw: Tensor) -> Tensor:
    """Rotation about +z by ``yaw`` (...,) radians, as (..., 3, 3)."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, one]
    return torch.stack(rows, dim=-1).reshape(*yaw.shape, 3, 3)


def geodesic_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle in [0, pi] between rotations ``a`` and ``b``, both (..., 3, 3).

    Computed from the chordal distance, which stays accurate for tiny angles where acos does not.
    """
    chord = (a.double() - b.double()).flatten(-2).norm(dim=-1) / (2.0 * 2.0**0.5)
    return (2.0 * torch.asin(chord.clamp(max=1.0))).to(a.dtype)


def matrix_to_quaternion(matrices: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) with w >= 0 of rotation matrices (..., 3, 3)."""
    m = matrices.double()
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # Four algebraically equal forms; each row is accurate where its own component is large.
    x_diff, y_diff, z_diff = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    candidates = torch.stack(
        [
            torch.stack([1 + m00 + m11 + m22, x_diff, y_diff, z_diff], dim=-1),
            torch.stack([x_diff, 1 + m00 - m11 - m22, xy, xz], dim=-1),
            torch.stack([y_diff, xy, 1 - m00 + m11 - m22, yz], dim=-1),
            torch.stack([z_diff, xz, yz, 1 - m00 - m11 + m22], dim=-1),
        ],
        dim=-2,
    )  # (..., 4, 4)
    best = torch.stack([m00 + m11 + m22, m00, m11, m22], dim=-1).argmax(dim=-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    quaternion = torch.gather(candidates, -2, index).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    return quaternion.to(matrices.dtype)


def quaternion_to_matrix(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (w, x, y, z), normalised first."""
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quaternions.shape[:-1], 3, 3)
