"""Shapes: volumes and inertias against closed forms and against trimesh."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from scene_envs.assets.shapes import box, convex_hull, hull_of, mass_properties, ring, rods, solid, volume
from scene_envs.errors import InvalidInputError


def as_mesh(part):
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def test_box_mass_properties_are_the_textbook_ones():
    mass, center, inertia = mass_properties([box((0.3, 0.2, 0.1), base=(1.0, 2.0, 3.0))], 6.0)
    assert mass == 6.0
    np.testing.assert_allclose(center, [1.0, 2.0, 3.05], atol=1e-12)
    expected = 0.5 * np.diag([0.2**2 + 0.1**2, 0.3**2 + 0.1**2, 0.3**2 + 0.2**2])
    np.testing.assert_allclose(inertia, expected, atol=1e-12)


@pytest.mark.parametrize("segments", [10, 16, 33])
def test_prism_volume_is_that_of_the_regular_polygon(segments):
    prism = solid([(0.12, 0.0), (0.12, 0.05)], segments)
    area = 0.5 * segments * 0.12**2 * math.sin(2 * math.pi / segments)
    assert volume([prism]) == pytest.approx(0.05 * area, rel=1e-12)


def test_ring_and_its_core_fill_the_solid_exactly():
    wall = ring([(0.10, 0.0), (0.12, 0.0), (0.12, 0.09), (0.10, 0.09)], 16)
    core, whole = solid([(0.10, 0.0), (0.10, 0.09)], 16), solid([(0.12, 0.0), (0.12, 0.09)], 16)
    assert volume(wall) + volume([core]) == pytest.approx(volume([whole]), rel=1e-12)
    split = mass_properties([*wall, core], 2.0)
    joined = mass_properties([whole], 2.0)
    np.testing.assert_allclose(split.inertia, joined.inertia, atol=1e-12)


def test_mass_properties_agree_with_trimesh_on_a_skew_hull():
    points = np.random.default_rng(0).normal(loc=[0.5, -1.0, 2.0], size=(40, 3))
    part = convex_hull(points)
    mesh = as_mesh(part)
    mass, center, inertia = mass_properties([part], mesh.volume)
    assert mass == pytest.approx(mesh.volume)
    np.testing.assert_allclose(center, mesh.center_mass, atol=1e-9)
    np.testing.assert_allclose(inertia, mesh.moment_inertia, atol=1e-9)


def test_hulls_face_outward():
    for part in (
        box((1, 2, 3)),
        solid([(0.1, 0.0), (0.0, 0.2)], 9),
        *rods([(0, 0, 0), (1, 0, 0), (1, 0, 1)], 0.1, 0.1),
    ):
        mesh = as_mesh(part)
        assert mesh.is_watertight
        assert mesh.is_convex
        assert mesh.volume > 0


def test_rods_keep_their_thickness_around_corners_and_meet():
    first, second = rods([(0, 0, 0), (1, 0, 0), (1, 0, 1)], width=0.2, thickness=0.1)
    assert first.bounds[:, 2].tolist() == pytest.approx([-0.05, 0.05])
    assert second.bounds[:, 0].tolist() == pytest.approx([0.95, 1.05])
    # Mitred: together they are an L of centre-line length 2.
    assert volume([first, second]) == pytest.approx(2 * 0.2 * 0.1, rel=1e-9)


def test_hull_of_covers_every_part():
    parts = ring([(0.10, 0.0), (0.12, 0.0), (0.12, 0.09), (0.10, 0.09)], 16)
    assert volume([hull_of(parts)]) == pytest.approx(volume([solid([(0.12, 0.0), (0.12, 0.09)], 16)]), rel=1e-12)


def test_flat_points_and_radius_zero_rings_are_refused():
    with pytest.raises(InvalidInputError, match="one plane"):
        convex_hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    with pytest.raises(InvalidInputError, match="use solid"):
        ring([(0.0, 0.0), (0.1, 0.0), (0.1, 0.1)], 8)
