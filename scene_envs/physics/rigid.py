"""Rotations of many bodies at once in numpy, in PyBullet's quaternion order.

The operations on a row do not depend on the other rows, so a scene settles to the same bits alone and in a batch.
scipy's ``Rotation`` chooses its formula per batch and does not guarantee this.
"""

from __future__ import annotations

import numpy as np

from scene_envs.arrays import Array


def apply(rotation: Array, vector: Array) -> Array:
    """Rotations (n, 3, 3) of vectors (n, 3); written out, so that a row never depends on the others."""
    r, v = rotation, vector[:, None, :]
    return r[..., 0] * v[..., 0] + r[..., 1] * v[..., 1] + r[..., 2] * v[..., 2]  # type: ignore[no-any-return]


def times(a: Array, b: Array) -> Array:
    """Products (n, 3, 3) of matrices, row by row as in :func:`apply`."""
    return a[..., :, 0:1] * b[..., 0:1, :] + a[..., :, 1:2] * b[..., 1:2, :] + a[..., :, 2:3] * b[..., 2:3, :]


def quaternions(matrices: Array) -> Array:
    """(n, 4) in PyBullet's order (x, y, z, w), from whichever of four equal forms is the most accurate."""
    m = matrices.reshape(-1, 9).T
    a, b, c = m[0], m[4], m[8]
    x, y, z = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    xy, xz, yz = m[1] + m[3], m[2] + m[6], m[5] + m[7]
    forms = np.array(
        [
            [1 + a - b - c, xy, xz, x],
            [xy, 1 - a + b - c, yz, y],
            [xz, yz, 1 - a - b + c, z],
            [x, y, z, 1 + a + b + c],
        ]
    )  # (form, component, n)
    best = np.array([a, b, c, a + b + c]).argmax(axis=0)
    quaternion = forms[best, :, np.arange(len(best))]
    return quaternion / np.sqrt((quaternion * quaternion).sum(axis=1, keepdims=True))  # type: ignore[no-any-return]


def matrices(xyzw: Array) -> Array:
    """(n, 3, 3) rotation matrices of quaternions (n, 4) in the order (x, y, z, w)."""
    x, y, z, w = (xyzw / np.linalg.norm(xyzw, axis=1, keepdims=True)).T
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=1).reshape(-1, 3, 3)


def angle_between(a: Array, b: Array) -> Array:
    """Angle (n,) between unit quaternions (x, y, z, w), accurate when tiny."""
    scalar = np.abs((a * b).sum(axis=1))
    vector = a[:, 3:] * b[:, :3] - b[:, 3:] * a[:, :3] - np.cross(a[:, :3], b[:, :3])
    return 2.0 * np.arctan2(np.linalg.norm(vector, axis=1), scalar)


def principal_inertia(inertia: Array) -> tuple[Array, Array]:
    """Principal moments (3,) kg m^2, ascending, and the rotation (3, 3) from their axes to the asset's."""
    moments, axes = np.linalg.eigh(np.asarray(inertia, dtype=np.float64))
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1.0
    return moments, axes
