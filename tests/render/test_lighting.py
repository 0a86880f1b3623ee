"""Shadows and normals against geometry that is known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from scene_envs.render.stage import Frame, camera_points, contact_shade, soft_shadow, surface_normals


def looking_down(height, depth):
    """A frame of a camera ``height`` m above the origin, x right and y up, 90 degree field of view."""
    view = np.eye(4)
    view[2, 3] = -height
    depth = np.asarray(depth, dtype=np.float32)
    slots = np.where(np.isfinite(depth), 0, -1)
    return Frame(np.zeros((*depth.shape, 3), np.float32), depth, slots, view, np.array([1.0, 1.0]))


def test_points_of_a_plane_lie_in_it_and_span_the_field_of_view():
    points = camera_points(looking_down(2.0, np.full((40, 40), 2.0)))
    np.testing.assert_allclose(points[..., 2], -2.0)
    np.testing.assert_allclose(points[0, 0, :2], [-1.95, 1.95], atol=1e-6)
    np.testing.assert_allclose(points[-1, -1, :2], [1.95, -1.95], atol=1e-6)


def test_normals_of_a_plane_and_of_a_slope():
    frame = looking_down(2.0, np.full((40, 40), 2.0))
    np.testing.assert_allclose(surface_normals(frame), np.broadcast_to([0.0, 0.0, 1.0], (40, 40, 3)), atol=1e-6)
    x = (np.arange(40) + 0.5) / 20 - 1.0
    slope = 2.0 / (1.0 + 0.5 * x)  # depth of the plane z_camera = -(2 - 0.5 x_camera), seen through pixel x
    normals = surface_normals(looking_down(2.0, np.tile(slope, (40, 1))))
    expected = np.array([-0.5, 0.0, 1.0]) / np.sqrt(1.25)
    np.testing.assert_allclose(normals, np.broadcast_to(expected, (40, 40, 3)), atol=2e-3)


def test_a_block_between_lamp_and_floor_shades_what_is_under_it_only():
    floor = np.full((80, 80), 2.0)
    frame = looking_down(2.0, floor)
    lamp_depth = floor.copy()
    lamp_depth[30:50, 30:50] = 1.0  # the lamp stands at the camera and sees a block that the frame does not
    shadow = soft_shadow(frame, looking_down(2.0, lamp_depth), surface_normals(frame))
    assert (shadow[34:46, 34:46] == 1.0).all()
    assert (shadow[:26] == 0.0).all()
    assert (shadow[:, 54:] == 0.0).all()
    assert shadow.sum() == pytest.approx(20 * 20, rel=0.1)


def test_a_surface_does_not_shadow_itself_and_the_backdrop_stays_bright():
    depth = np.full((40, 40), 2.0)
    depth[:, :10] = np.inf
    frame = looking_down(2.0, depth)
    normals = surface_normals(frame)
    assert (soft_shadow(frame, frame, normals) == 0.0).all()
    assert (contact_shade(frame, normals)[:, :8] == 0.0).all()


def test_corners_are_shaded_and_open_floor_is_not():
    depth = np.full((200, 200), 0.4)
    depth[:, 100:] = 0.36  # a step 4 cm high
    frame = looking_down(0.4, depth)
    shade = contact_shade(frame, surface_normals(frame))
    assert shade[100, 94:98].mean() > 0.05
    assert shade[100, :60].max() < 1e-3
    assert shade[100, 104:].max() < 1e-3
