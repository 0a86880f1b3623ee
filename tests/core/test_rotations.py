"""Rotations against scipy."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from scene_envs.rotations import (
    geodesic_angle,
    matrix_to_quaternion,
    project_to_so3,
    quaternion_to_matrix,
    yaw_matrix,
)


def test_projection_is_the_polar_factor() -> None:
    """For a matrix with positive determinant the nearest rotation is the orthogonal polar factor."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        matrix = Rotation.random(random_state=rng).as_matrix() + 0.2 * rng.standard_normal((3, 3))
        if np.linalg.det(matrix) <= 0:
            continue
        expected, _ = polar(matrix)
        np.testing.assert_allclose(project_to_so3(torch.from_numpy(matrix)).numpy(), expected, atol=1e-9)


def test_projection_never_reflects() -> None:
    matrices = torch.randn(200, 3, 3, generator=torch.Generator().manual_seed(0))
    determinant = torch.linalg.det(project_to_so3(matrices))
    torch.testing.assert_close(determinant, torch.ones(200))


def test_quaternions_agree_with_scipy() -> None:
    rotations = Rotation.random(200, random_state=1)
    matrices = torch.from_numpy(rotations.as_matrix())
    xyzw = rotations.as_quat(canonical=True)
    np.testing.assert_allclose(matrix_to_quaternion(matrices).numpy(), np.roll(xyzw, 1, axis=1), atol=1e-12)
    torch.testing.assert_close(quaternion_to_matrix(matrix_to_quaternion(matrices)), matrices)


def test_geodesic_angle_is_accurate_for_tiny_angles() -> None:
    angle = torch.tensor([0.0, 1e-6, 1e-3, 1.0, 3.1], dtype=torch.float64)
    identity = torch.eye(3, dtype=torch.float64).expand(5, 3, 3)
    torch.testing.assert_close(geodesic_angle(yaw_matrix(angle), identity), angle, atol=1e-12, rtol=1e-9)
