"""The assets: what physics, grammars and pictures rely on."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from scene_envs.assets import asset_recipe, get_library, list_assets
from scene_envs.errors import InvalidInputError, UnknownNameError

DIMSUM = ("cafe_table", "dinner_plate", "serving_dish", "steamer_bottom", "steamer_lid", "teacup", "teapot")
FREE = DIMSUM[1:]

SIZES = {  # (x, y, z) m of the body, handles and spouts aside
    "cafe_table": (1.25, 1.25, 0.785),
    "dinner_plate": (0.27, 0.27, 0.022),
    "serving_dish": (0.27, 0.27, 0.02),
    "steamer_bottom": (0.24, 0.24, 0.091),
    "steamer_lid": (0.24, 0.24, 0.06),
    "teacup": (0.085, 0.085, 0.07),
    "teapot": (0.15, 0.15, 0.14),
}
MASSES = {"dinner_plate": 0.6, "serving_dish": 0.7, "steamer_bottom": 0.35, "steamer_lid": 0.22, "teacup": 0.2,
          "teapot": 0.7, "cafe_table": 0.0}  # fmt: skip
PARTS = {"cafe_table": (3, 3), "dinner_plate": (17, 1), "serving_dish": (5, 1), "steamer_bottom": (17, 1),
         "steamer_lid": (14, 2), "teacup": (14, 1), "teapot": (10, 4)}  # fmt: skip
KEEP_OUT = {"dinner_plate": 0.14, "serving_dish": 0.20, "steamer_bottom": 0.12, "steamer_lid": 0.12, "teacup": 0.07,
            "teapot": 0.10}  # fmt: skip


@pytest.fixture(scope="module")
def library():
    return get_library(DIMSUM)


def as_mesh(part):
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def contains(part, point, margin=0.0):
    """Whether ``point`` is inside the convex part, or within ``margin`` m of it."""
    mesh = as_mesh(part)
    return bool((np.einsum("fi,fi->f", mesh.face_normals, point - mesh.triangles[:, 0]) <= margin).all())


@pytest.mark.parametrize("name", DIMSUM)
def test_size_and_mass_are_the_specified_ones(library, name):
    asset = library[name]
    extent = asset.bounds[1] - asset.bounds[0]
    sideways = name in ("teacup", "teapot")  # a handle or a spout adds to x
    np.testing.assert_allclose(extent[1:], SIZES[name][1:], rtol=0.06 if sideways else 1e-9)
    assert extent[2] == pytest.approx(SIZES[name][2], abs=1e-12)
    assert extent[0] >= SIZES[name][0] - 1e-9
    assert asset.mass == MASSES[name]
    assert (len(asset.fine), len(asset.coarse)) == PARTS[name]
    assert asset.static == (name == "cafe_table")


@pytest.mark.parametrize("name", FREE)
def test_nothing_reaches_beyond_the_keep_out_radius(library, name):
    for level in (library[name].fine, library[name].coarse, (library[name].visual,)):
        reach = max(np.hypot(part.vertices[:, 0], part.vertices[:, 1]).max() for part in level)
        assert reach <= KEEP_OUT[name] + 1e-9


@pytest.mark.parametrize("name", DIMSUM)
def test_parts_are_convex_closed_and_thick_enough(library, name):
    for part in (*library[name].fine, *library[name].coarse):
        mesh = as_mesh(part)
        assert mesh.is_watertight
        assert mesh.is_convex
        depths = mesh.face_normals @ part.vertices.T
        widths = depths.max(axis=1) - depths.min(axis=1)
        assert widths.min() >= 0.003
        assert len(part.vertices) <= 72


@pytest.mark.parametrize("name", FREE)
def test_each_asset_stands_flat_under_its_center_of_mass(library, name):
    asset = library[name]
    for level in (asset.fine, asset.coarse):
        corners = np.concatenate([part.vertices for part in level])
        assert corners[:, 2].min() == 0.0
        base = corners[corners[:, 2] == 0.0][:, :2]
        edges = ConvexHull(base).equations  # outward normals and offsets of the support polygon
        margin = -(edges[:, :2] @ asset.center_of_mass[:2] + edges[:, 2]).max()
        assert margin > 0.02  # m of tipping margin


def test_the_table_top_is_the_plane_z_zero(library):
    assert library["cafe_table"].bounds[1, 2] == 0.0
    assert library["cafe_table"].bounds[0, 2] == pytest.approx(-0.785)


@pytest.mark.parametrize("name", FREE)
def test_inertia_is_physical_and_agrees_with_trimesh(library, name):
    asset = library[name]
    moments = np.linalg.eigvalsh(asset.inertia)
    assert moments[0] > 0
    assert moments[0] + moments[1] >= moments[2]
    meshes = [as_mesh(part) for part in asset.fine]
    density = asset.mass / sum(mesh.volume for mesh in meshes)
    expected, center = np.zeros((3, 3)), asset.center_of_mass
    np.testing.assert_allclose(
        sum(mesh.volume * mesh.center_mass for mesh in meshes) * density / asset.mass, center, atol=1e-9
    )
    for mesh in meshes:
        offset = mesh.center_mass - center
        expected += density * (
            mesh.moment_inertia + mesh.volume * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        )
    np.testing.assert_allclose(asset.inertia, expected, atol=1e-10)


@pytest.mark.parametrize(
    ("name", "point"),
    [
        ("teacup", (0.0, 0.0, 0.04)),
        ("steamer_bottom", (0.05, 0.02, 0.06)),
        ("steamer_lid", (0.0, 0.05, 0.01)),
        ("dinner_plate", (0.0, 0.0, 0.012)),
    ],
)
def test_hollows_are_hollow_in_fine_parts_and_filled_in_coarse_ones(library, name, point):
    asset = library[name]
    assert not any(contains(part, np.array(point)) for part in asset.fine)
    assert any(contains(part, np.array(point)) for part in asset.coarse)


@pytest.mark.parametrize("name", DIMSUM)
def test_coarse_parts_cover_fine_parts(library, name):
    asset = library[name]
    for part in asset.fine:
        assert any(all(contains(cover, v, 1e-9) for v in part.vertices) for cover in asset.coarse)


@pytest.mark.parametrize("name", DIMSUM)
def test_visual_mesh_shows_what_collides(library, name):
    asset = library[name]
    np.testing.assert_allclose(asset.visual.bounds, asset.bounds, atol=0.0045)
    assert asset.visual.visual.kind == "vertex"
    normals = np.linalg.norm(asset.visual.vertex_normals, axis=1)
    np.testing.assert_allclose(normals, 1.0, atol=1e-6)
    corners = asset.visual.vertex_normals[asset.visual.faces].mean(axis=1)
    outward = np.einsum("fi,fi->f", asset.visual.face_normals, corners)
    assert (outward[asset.visual.area_faces > 1e-9] > 0).all()


@pytest.mark.parametrize("level", ["fine", "coarse"])
@pytest.mark.parametrize(("upper", "yaw"), [("steamer_bottom", 0.0), ("steamer_bottom", 0.3), ("steamer_lid", 1.1)])
def test_steamers_stack_without_penetration(library, level, upper, yaw):
    fcl = pytest.importorskip("fcl")

    def objects(asset, yaw, z):
        rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        for part in getattr(asset, level):
            faces = np.column_stack([np.full(len(part.faces), 3), part.faces]).ravel()
            shape = fcl.Convex(part.vertices, len(part.faces), faces)
            yield fcl.CollisionObject(shape, fcl.Transform(rotation, np.array([0.0, 0.0, z])))

    def deepest(z):
        depth, above = 0.0, list(objects(library[upper], yaw, z))
        for below in objects(library["steamer_bottom"], 0.0, 0.0):
            for other in above:
                request = fcl.CollisionRequest(num_max_contacts=4, enable_contact=True)
                result = fcl.CollisionResult()
                fcl.collide(below, other, request, result)
                depth = max([depth, *(contact.penetration_depth for contact in result.contacts)])
        return depth

    assert deepest(0.091) <= 5e-5
    assert deepest(0.089) == pytest.approx(0.002, abs=3e-4)  # they do rest on each other


def test_assets_are_built_once_and_keep_their_order():
    first, second = get_library(("teacup", "teapot")), get_library(("teapot", "teacup"))
    assert first.names == ("teacup", "teapot")
    assert second.index("teacup") == 1
    assert first["teacup"] is second["teacup"]
    assert set(DIMSUM) <= set(list_assets())


def test_class_colors_differ(library):
    colors = np.array([asset.color for asset in library], dtype=float)
    gaps = np.linalg.norm(colors[:, None] - colors[None], axis=-1) + 1e3 * np.eye(len(colors))
    assert gaps.min() > 40


def test_unknown_asset_offers_the_nearest_name():
    with pytest.raises(UnknownNameError, match="did you mean 'teacup'"):
        get_library(("teacups",))


def test_recipes_are_checked_when_registered():
    with pytest.raises(InvalidInputError, match="registered already"):
        asset_recipe("teapot", display_name="teapot", mass=1.0, color=(0, 0, 0))(lambda: None)
    with pytest.raises(InvalidInputError, match="mass"):
        asset_recipe("balloon", display_name="balloon", mass=-1.0, color=(0, 0, 0))(lambda: None)
