"""Concave meshes as convex parts, and what is kept on disk."""

from __future__ import annotations

import copy
import dataclasses
import logging
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from scene_envs.assets import Asset, ConvexPart, import_report, load_library
from scene_envs.assets.importing import solids as decomposition
from scene_envs.assets.importing.solids import (
    MAX_CORNERS,
    PartAudit,
    audit_parts,
    enclosing_hull,
    few_cornered_hull,
    snap_to_surface,
    thickness,
)
from scene_envs.assets.shapes import box, convex_hull
from scene_envs.errors import MissingDependencyError
from scene_envs.files import cache_folder


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(folder))
    return folder


@pytest.fixture(autouse=True, scope="module")
def _decomposed_once() -> Iterator[None]:
    """CoACD takes a second for the angle iron, and is asked by several tests for the same."""
    made: dict[Any, Any] = {}
    real = decomposition.run_coacd

    def once(vertices: Any, faces: Any, settings: Any, *rest: Any) -> Any:
        asked = (vertices.tobytes(), faces.tobytes(), str(settings))
        if asked not in made:
            made[asked] = real(vertices, faces, settings, *rest)
        return copy.deepcopy(made[asked])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decomposition, "run_coacd", once)
        yield


def angle_iron() -> trimesh.Trimesh:
    """A closed L of two legs 0.1 long and 0.02 thick, 0.06 wide: one body of 20 triangles."""
    outline = np.array([[0, 0], [0.1, 0], [0.1, 0.02], [0.02, 0.02], [0.02, 0.1], [0, 0.1]])
    vertices = np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 0.06)])
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [[i, (i + 1) % 6, (i + 1) % 6 + 6] for i in range(6)] + [[i, (i + 1) % 6 + 6, i + 6] for i in range(6)]
    return trimesh.Trimesh(vertices, np.concatenate([cap[:, ::-1], cap + 6, sides]))


def load(folder: Path, mesh: trimesh.Trimesh, keys: str = "") -> Asset:
    mesh.export(folder / "thing.stl")
    (folder / "library.yaml").write_text(f"- {{file: thing.stl, base: origin{keys}}}")
    return load_library(folder)[0]


def depth(parts: tuple[ConvexPart, ...], point: tuple[float, float, float]) -> float:
    """How deep (m) a point lies in the parts; negative outside all of them."""
    planes = [ConvexHull(part.vertices).equations for part in parts]
    return max(float(-(p[:, :3] @ np.array(point) + p[:, 3]).max()) for p in planes)


def test_the_angle_iron_is_one_closed_body() -> None:
    assert angle_iron().is_watertight
    assert angle_iron().volume == pytest.approx(0.06 * (0.1 * 0.02 + 0.08 * 0.02))


def test_boxes_that_share_a_corner_are_two_parts() -> None:
    boxes = [trimesh.creation.box((0.1, 0.1, 0.1)).apply_translation([side] * 3) for side in (-0.05, 0.05)]
    surface = trimesh.util.concatenate(boxes)
    surface.merge_vertices()
    assert len(surface.vertices) == 15
    parts, solid, notes, warnings = decomposition.convex_parts(surface, "auto", 0.002, 0.05, "it")
    assert sorted(round(ConvexHull(part.vertices).volume, 9) for part in parts) == [0.001, 0.001]
    assert solid.mass == pytest.approx(0.002)
    assert not notes + warnings


@pytest.mark.slow
def test_a_concave_mesh_keeps_its_hollow(tmp_path: Path) -> None:
    pytest.importorskip("coacd")
    asset = load(tmp_path, angle_iron(), ", density: 1000")
    assert 2 <= len(asset.fine) <= 4
    assert depth(asset.fine, (0.06, 0.06, 0.03)) < -0.025
    for point in ((0.09, 0.01, 0.03), (0.01, 0.09, 0.03), (0.01, 0.01, 0.03)):
        assert depth(asset.fine, point) > 0.005
    assert len(asset.coarse) == 1
    assert depth(asset.coarse, (0.05, 0.05, 0.03)) > 0
    exact = angle_iron()
    exact.density = 1000
    assert asset.mass == pytest.approx(exact.mass, rel=0.02)
    assert asset.center_of_mass == pytest.approx(exact.center_mass, abs=1e-3)
    assert asset.inertia == pytest.approx(exact.moment_inertia, abs=0.05 * exact.moment_inertia.max())


@pytest.mark.slow
def test_a_decomposition_is_computed_once_and_kept(
    tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("coacd")
    calls = []
    compute = decomposition.run_coacd

    def counted(*args):
        """Computes the first time, and gives the same parts again."""
        calls.append(1 if calls else compute(*args))
        return calls[0]

    monkeypatch.setattr(decomposition, "run_coacd", counted)
    first = load(tmp_path, angle_iron())
    again = load(tmp_path, angle_iron(), ", name: again")
    assert len(calls) == 1
    assert again is not first
    for one, other in zip(first.fine, again.fine, strict=True):
        assert np.array_equal(one.vertices, other.vertices)
    (file,) = (cache / "decompositions").iterdir()
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with caplog.at_level(logging.WARNING):
        load(tmp_path, angle_iron(), ", name: third")
    assert len(calls) == 2
    assert "damaged" in caplog.text
    load(tmp_path, angle_iron(), ", name: fourth")
    assert len(calls) == 2  # the damaged entry was made good
    load(tmp_path, angle_iron(), ", name: fifth, concavity: 0.2")
    assert len(calls) == 3


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_costs_nothing_but_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("coacd")
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("SCENE_ENVS_CACHE", str(tmp_path / "file"))
    assert len(load(tmp_path, angle_iron()).fine) > 1
    assert "could not be kept" in caplog.text


def test_without_coacd_there_is_one_hull_and_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "coacd", None)
    asset = load(tmp_path, angle_iron())
    assert len(asset.fine) == 1
    assert depth(asset.fine, (0.05, 0.05, 0.03)) > 0
    (warning,) = import_report(tmp_path)["thing"].warnings
    assert "thing.stl" in warning
    assert "scene-envs[decomposition]" in warning
    assert asset.mass == pytest.approx(500 * angle_iron().volume)  # of the mesh, not of its hull
    with pytest.raises(MissingDependencyError, match=r"scene-envs\[decomposition\]"):
        load(tmp_path, angle_iron(), ", decomposition: coacd")


def test_convex_is_one_hull_when_asked_for(tmp_path: Path) -> None:
    assert len(load(tmp_path, angle_iron(), ", decomposition: convex").fine) == 1


def test_convex_bodies_in_one_file_are_kept_as_they_are(tmp_path: Path) -> None:
    def piece(size: tuple[float, ...], place: tuple[float, ...]) -> trimesh.Trimesh:
        return trimesh.creation.box(size, trimesh.transformations.translation_matrix(place))

    table = trimesh.util.concatenate(
        [
            piece((1.0, 0.6, 0.04), (0, 0, 0.72)),
            *(piece((0.05, 0.05, 0.7), (x, y, 0.35)) for x in (-0.4, 0.4) for y in (-0.2, 0.2)),
        ]
    )
    asset = load(tmp_path, table, ", density: 700")
    assert [len(part.vertices) for part in asset.fine] == [8] * 5
    assert depth(asset.fine, (0, 0, 0.35)) < -0.2
    assert asset.mass == pytest.approx(700 * (1.0 * 0.6 * 0.04 + 4 * 0.05 * 0.05 * 0.7))


def test_an_almost_convex_mesh_is_its_hull(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(3, 0.05)
    dented = ball.copy()
    dented.vertices[0] *= 0.985  # 0.75 mm
    asset = load(tmp_path, dented)
    assert len(asset.fine) == 1
    assert len(asset.fine[0].vertices) <= MAX_CORNERS


def test_a_hull_of_few_corners_is_close_and_inside() -> None:
    cloud = trimesh.creation.cylinder(0.05, 0.1, sections=400).vertices
    part, outside = few_cornered_hull(np.asarray(cloud), 5e-4)
    assert len(part.vertices) <= MAX_CORNERS
    assert outside <= 5e-4
    planes = ConvexHull(part.vertices).equations
    assert (cloud @ planes[:, :3].T + planes[:, 3]).max() == pytest.approx(outside, abs=1e-12)
    assert ConvexHull(part.vertices).volume == pytest.approx(np.pi * 0.05**2 * 0.1, rel=0.02)
    assert (part.vertices[:, 2] == -0.05).sum() >= 16  # the base stays flat


def test_the_coarse_hull_encloses_all_parts_with_few_corners() -> None:
    rng = np.random.default_rng(0)
    parts = [convex_hull(rng.normal(size=(60, 3)) + shift) for shift in rng.normal(size=(8, 3))]
    coarse = enclosing_hull(parts)
    planes = ConvexHull(coarse.vertices).equations
    points = np.concatenate([part.vertices for part in parts])
    assert (points @ planes[:, :3].T + planes[:, 3]).max() < 1e-7
    assert len(coarse.vertices) <= 2 * MAX_CORNERS
    assert coarse.bounds == pytest.approx(np.stack([points.min(axis=0), points.max(axis=0)]))
    assert ConvexHull(coarse.vertices).volume < 1.6 * ConvexHull(points).volume


def test_thickness_of_a_plate() -> None:
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.7, 0.3]))[:3, :3]
    plate = box((0.2, 0.1, 0.002))
    assert thickness(ConvexPart(plate.vertices @ turn.T, plate.faces)) == pytest.approx(0.002)


def test_the_cache_lies_where_the_user_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SCENE_ENVS_CACHE", "/a/b")
    assert cache_folder() == Path("/a/b")
    monkeypatch.delenv("SCENE_ENVS_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/c")
    assert cache_folder() == Path("/c/scene_envs")


def test_corners_near_the_surface_are_drawn_onto_it() -> None:
    """A cube of 0.2: corners of pieces a millimetre off its faces come back, one deep inside stays."""
    cube = trimesh.creation.box((0.2, 0.2, 0.2))
    points = np.array([[0.03, 0.02, -0.101], [0.099, 0.05, 0.0], [0.101, 0.101, 0.101], [0.0, 0.0, 0.0]])
    snapped = snap_to_surface(points, cube, 0.003)
    assert snapped == pytest.approx(np.array([[0.03, 0.02, -0.1], [0.1, 0.05, 0.0], [0.1, 0.1, 0.1], [0.0, 0.0, 0.0]]))


def audited(folder: Path, visual: trimesh.Trimesh, *parts: trimesh.Trimesh) -> PartAudit:
    """The audit of an asset with this mesh and the hulls of these parts."""
    asset = load(folder, trimesh.creation.box((0.1, 0.1, 0.1)))
    fine = tuple(ConvexPart(np.array(p.convex_hull.vertices), np.array(p.convex_hull.faces)) for p in parts)
    audit = audit_parts(dataclasses.replace(asset, visual=visual, fine=fine))
    assert audit is not None
    return audit


def u_shape() -> list[trimesh.Trimesh]:
    """A U of three boxes, 0.3 wide, 0.1 deep and 0.12 high, 0.02 thick."""
    sizes = [
        ((0.3, 0.1, 0.02), (0, 0, 0.01)),
        ((0.02, 0.1, 0.1), (-0.14, 0, 0.07)),
        ((0.02, 0.1, 0.1), (0.14, 0, 0.07)),
    ]
    return [trimesh.creation.box(size).apply_translation(place) for size, place in sizes]


def test_the_audit_of_a_hull_that_fills_a_hollow(tmp_path: Path) -> None:
    """Three openings of 0.26 x 0.1 m of a box of 0.156 m^2, at most 0.1 m above the floor of the U. A strip of 1 mm
    along the edges of the mesh counts as contact.
    """
    whole = trimesh.util.concatenate(u_shape())
    audit = audited(tmp_path, whole, whole)
    share = (0.258 * 0.1 + 2 * 0.258 * 0.099) / 0.156
    assert audit.parts_alone == pytest.approx(share, abs=3 * (share * (1 - share) / 256) ** 0.5)
    assert audit.parts_gap == pytest.approx(0.1, abs=1e-5)
    assert (audit.mesh_alone, audit.mesh_gap) == pytest.approx((0.0, 0.0), abs=1e-5)
    assert audited(tmp_path, whole, whole) == audit


def test_the_audit_of_exact_parts_is_zero(tmp_path: Path) -> None:
    mesh = trimesh.util.concatenate(u_shape())
    assert audited(tmp_path, mesh, *u_shape()) == pytest.approx((0.0,) * 4, abs=1e-5)
    report = import_report(tmp_path)
    assert report["thing"].audit == pytest.approx((0.0,) * 4, abs=1e-5)
    assert "0% of the contacts with its parts miss the mesh" in str(report)


def test_the_audit_of_parts_that_are_too_small_or_too_large(tmp_path: Path) -> None:
    """Cubes of 8 and 10 cm about the same middle: gaps of 1 cm, and 1 cm times the root of 3 at corners."""
    small, large = (trimesh.creation.box((side,) * 3) for side in (0.08, 0.1))
    inside, outside = audited(tmp_path, large, small), audited(tmp_path, small, large)
    assert (inside.parts_alone, inside.parts_gap, inside.mesh_alone) == (0.0, 0.0, 1.0)
    assert (outside.parts_alone, outside.mesh_alone, outside.mesh_gap) == pytest.approx((1.0, 0.0, 0.0), abs=1e-5)
    for gap in (inside.mesh_gap, outside.parts_gap):
        assert 0.01 < gap < 0.01 * 3**0.5
