"""Shapes: volumes and inertias against closed forms and against trimesh."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import trimesh

from scene_envs.assets.shapes import (
    Patch,
    box,
    circle,
    convex_hull,
    hull_of,
    lettering,
    loft,
    mass_properties,
    moved,
    painted_box,
    painted_face,
    ring,
    rods,
    solid,
    volume,
)
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


RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def area_of(mesh, color):
    colors = mesh.visual.vertex_colors[mesh.faces[:, 0], :3]
    return mesh.area_faces[(colors == color).all(axis=1)].sum()


def test_patches_share_the_face_without_overlap():
    patches = [Patch(0.1, 0.2, 0.6, 0.7, GREEN), Patch(0.5, 0.5, 1.5, 0.9, BLUE)]  # they overlap, one juts out
    face = painted_face((1, 1, 1), (0.4, 0, 0), (0, 0.2, 0), RED, patches)
    assert face.area == pytest.approx(0.08)
    assert area_of(face, BLUE) == pytest.approx(0.08 * 0.5 * 0.4)
    assert area_of(face, GREEN) == pytest.approx(0.08 * (0.5 * 0.5 - 0.1 * 0.2))
    np.testing.assert_allclose(face.bounds, [[1, 1, 1], [1.4, 1.2, 1]])
    np.testing.assert_allclose(face.face_normals, np.tile([0, 0, 1], (len(face.faces), 1)), atol=1e-12)


def test_a_box_is_closed_and_its_faces_read_upright():
    mark = [Patch(0.0, 0.0, 0.5, 0.25, GREEN)]  # lower left
    for front, corner in (("-y", [-0.1, -0.2, 0.4]), ("+x", [0.1, -0.2, 0.4])):
        solid = painted_box((0.2, 0.4, 0.3), RED, {"top": mark, "-y": mark, "+x": mark}, base=(0, 0, 0.1), front=front)
        assert solid.area == pytest.approx(2 * (0.2 * 0.4 + 0.4 * 0.3 + 0.2 * 0.3))
        assert solid.volume == pytest.approx(0.2 * 0.4 * 0.3)
        green = solid.vertices[(solid.visual.vertex_colors[:, :3] == GREEN).all(axis=1)]
        for point in (corner, [-0.1, -0.2, 0.1], [0.1, -0.2, 0.1]):  # of the top, the left and the right face
            assert np.linalg.norm(green - point, axis=1).min() < 1e-12


def test_lettering_fills_its_line():
    bars = lettering(0.2, 0.4, 0.8, 0.5, BLUE, (1, 2, 1))
    assert bars[0].left == pytest.approx(0.2)
    assert bars[-1].right == pytest.approx(0.8)
    assert bars[1].right - bars[1].left == pytest.approx(2 * (bars[0].right - bars[0].left))
    assert all(b.left > a.right for a, b in pairwise(bars))


def test_lofts_are_closed_and_face_outward():
    ring = np.column_stack([np.zeros(8), 0.1 * circle(8)])
    tube = loft([ring, ring + np.array([0.5, 0.0, 0.0])], RED)
    assert tube.volume == pytest.approx(0.5 * 8 * 0.5 * 0.01 * np.sin(np.pi / 4))
    open_tube = loft([ring, ring + np.array([0.5, 0.0, 0.0])], RED, caps=(False, False))
    assert len(tube.faces) - len(open_tube.faces) == 2 * 6


def test_moved_meshes_keep_colors_and_normals():
    mesh = painted_box((0.2, 0.4, 0.3), RED)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    other = moved(mesh, turn, (1.0, 0.0, 0.0))
    np.testing.assert_allclose(other.bounds, [[0.8, -0.1, 0.0], [1.2, 0.1, 0.3]], atol=1e-12)
    np.testing.assert_allclose(other.vertex_normals, mesh.vertex_normals @ turn.T)
    assert (other.visual.vertex_colors == mesh.visual.vertex_colors).all()
