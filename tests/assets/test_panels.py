"""Painted faces, lofts and moved meshes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from scene_envs.assets.shapes import Patch, circle, lettering, loft, moved, painted_box, painted_face

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
