"""Rotation representations: the conversions of ``roma`` in this project's conventions.

All matrices map body-frame vectors to the frame they are expressed in. Angles are in radians, quaternions are (w, x, y,
z). All functions run in batches on the device of their argument and can be differentiated. ``roma`` is imported where
it is called: it loads torch's compiler, which takes as long as torch itself and which processes of rewards never use.
"""

from __future__ import annotations

import torch
from torch import Tensor


def project_to_so3(matrices: Tensor) -> Tensor:
    """Nearest rotations (..., 3, 3) of finite matrices in the Frobenius norm, by SVD in float64 (Levinson et al. 2020).

    >>> project_to_so3(torch.diag(torch.tensor([2.0, 1.0, 0.5])))
    tensor([[1., 0., 0.],
            [0., 1., 0.],
            [0., 0., 1.]])
    """
    import roma

    nearest: Tensor = roma.special_procrustes(matrices.double(), method="svd")
    return nearest.to(matrices.dtype)


def yaw_matrix(yaw: Tensor) -> Tensor:
    """Rotation about +z by ``yaw`` (...,) radians, as (..., 3, 3)."""
    cos, sin = torch.cos(yaw), torch.sin(yaw)
    zero, one = torch.zeros_like(yaw), torch.ones_like(yaw)
    rows = [cos, -sin, zero, sin, cos, zero, zero, zero, one]
    return torch.stack(rows, dim=-1).reshape(*yaw.shape, 3, 3)


def geodesic_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle in [0, pi] between rotations ``a`` and ``b``, both (..., 3, 3); accurate for tiny angles."""
    import roma

    angle: Tensor = roma.rotmat_geodesic_distance(a.double(), b.double())
    return angle.to(a.dtype)


def matrix_to_quaternion(matrices: Tensor) -> Tensor:
    """Unit quaternions (w, x, y, z) with w >= 0 of rotation matrices (..., 3, 3)."""
    import roma

    quaternion = roma.quat_xyzw_to_wxyz(roma.rotmat_to_unitquat(matrices.double()))
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion).to(matrices.dtype)


def quaternion_to_matrix(quaternions: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of quaternions (w, x, y, z), normalised first. The formula is written out, because
    ``roma`` rounds differently in float32: so priors with quaternion codes give the same bits as when they were
    trained.
    """
    w, x, y, z = (quaternions / quaternions.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quaternions.shape[:-1], 3, 3)
