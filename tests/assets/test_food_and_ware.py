"""Fruit, drinks, bread, bowls, plates, mugs and the crock: sizes, hollows, and standing still."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
import torch
import trimesh
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from scene_envs.assets import get_library, list_assets
from scene_envs.physics import equilibrium, feasibility, penetration, project, settle
from scene_envs.physics.parts import PartGeometry
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import BUILT_IN, Camera, FixedObject, SceneType

SIZES = {  # (x, y, z) m, handles aside
    "cereal_box": (0.19, 0.06, 0.28),
    "bread_slice": (0.104, 0.10, 0.016),
    "apple_gala": (0.066, 0.066, 0.062),
    "apple_golden": (0.070, 0.070, 0.068),
    "apple_green": (0.075, 0.075, 0.070),
    "apple_red": (0.080, 0.080, 0.080),
    "avocado_a": (0.065, 0.065, 0.100),
    "avocado_b": (0.060, 0.060, 0.095),
    "avocado_c": (0.082, 0.082, 0.120),
    "pear_bosc": (0.070, 0.070, 0.100),
    "pear_anjou": (0.068, 0.068, 0.090),
    "pear_red": (0.075, 0.075, 0.085),
    "utensil_crock": (0.13, 0.13, 0.17),
    "fruit_bowl": (0.22, 0.22, 0.075),
    "bowl": (0.145, 0.145, 0.065),
    "soda_can": (0.0668, 0.0668, 0.122),
    "tea_bottle": (0.065, 0.065, 0.208),
    "shared_plate": (0.22, 0.22, 0.02),
    "plate": (0.20, 0.20, 0.018),
    "mug": (0.08, 0.08, 0.085),
    "water_jug": (0.105, 0.105, 0.182),
}
NAMES = tuple(SIZES)
HANDLED = ("mug", "water_jug")
MASSES = {
    "cereal_box": 0.45, "bread_slice": 0.03, "apple_gala": 0.15, "apple_golden": 0.17, "apple_green": 0.19,
    "apple_red": 0.21, "avocado_a": 0.22, "avocado_b": 0.20, "avocado_c": 0.33, "pear_bosc": 0.19, "pear_anjou": 0.19,
    "pear_red": 0.20, "utensil_crock": 0.40, "fruit_bowl": 0.55, "bowl": 0.33, "soda_can": 0.37, "tea_bottle": 0.53,
    "shared_plate": 0.45, "plate": 0.40, "mug": 0.25, "water_jug": 0.55,
}  # fmt: skip
CALLED = {
    "cereal_box": "a cereal box, cereal boxes", "bread_slice": "a bread slice, bread slices",
    "apple_gala": "an apple, apples", "apple_golden": "an apple, apples", "apple_green": "an apple, apples",
    "apple_red": "an apple, apples", "avocado_a": "an avocado, avocados", "avocado_b": "an avocado, avocados",
    "avocado_c": "an avocado, avocados", "pear_bosc": "a pear, pears", "pear_anjou": "a pear, pears",
    "pear_red": "a pear, pears", "utensil_crock": "a utensil crock, utensil crocks", "fruit_bowl": "a bowl, bowls",
    "bowl": "a bowl, bowls", "soda_can": "a coke can, coke cans", "tea_bottle": "a tea bottle, tea bottles",
    "shared_plate": "a plate, plates", "plate": "a plate, plates", "mug": "a mug, mugs",
    "water_jug": "a water jug, water jugs",
}  # fmt: skip
FLOORS = {  # radius within which it is flat and free, and its height, m
    "utensil_crock": (0.055, 0.008),
    "fruit_bowl": (0.050, 0.006),
    "bowl": (0.034, 0.006),
    "shared_plate": (0.079, 0.006),
    "plate": (0.071, 0.006),
    "mug": (0.033, 0.006),
    "water_jug": (0.039, 0.007),
}


@pytest.fixture(scope="module")
def library():
    return get_library(NAMES)


@pytest.fixture(scope="module")
def kitchen():
    """A scene type of all assets of this file and a table, for poses made by hand."""
    return SceneType(
        name="kitchen",
        assets=("cafe_table", *NAMES),
        slots=16,
        workspace=((-0.6, -0.6, -0.02), (0.6, 0.6, 1.0)),
        welded=("cafe_table",),
        fixed=(FixedObject("cafe_table"),),
        camera=Camera((0.0, 0.0, 1.7), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    )


def scenes(kitchen, *layouts):
    """One scene per layout, a list of (asset, x, y, z) or (asset, x, y, z, rotation matrix)."""
    batch = SceneBatch.empty(kitchen, len(layouts))
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    for row, layout in enumerate(layouts):
        for slot, (name, x, y, z, *rotation) in enumerate(layout, start=1):
            translations[row, slot] = torch.tensor((x, y, z))
            rotations[row, slot] = torch.tensor(rotation[0]) if rotation else torch.eye(3)
            categories[row, slot] = kitchen.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, kitchen)


def as_mesh(part):
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def inside(asset, points, margin=0.0):
    """(P,) whether each of ``points`` (P, 3) is deeper than ``margin`` m inside a fine part."""
    found = np.zeros(len(points), dtype=bool)
    for part in asset.fine:
        planes = PartGeometry.of(part)
        found |= (points @ planes.normals.T <= planes.offsets - margin).all(axis=1)
    return found


def disc(radius, z):
    """(P, 3) points all over a horizontal disc, m."""
    angle, r = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 73), np.linspace(0.0, radius, 9))
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.full_like(r, z)], axis=-1).reshape(-1, 3)


# -- what each asset is -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_sizes_masses_and_names_are_the_specified_ones(library, name):
    asset = library[name]
    extent = asset.bounds[1] - asset.bounds[0]
    axes = slice(1, 3) if name in HANDLED else slice(0, 3)
    np.testing.assert_allclose(extent[axes], SIZES[name][axes], rtol=0.02)
    assert asset.mass == MASSES[name]
    assert not asset.static
    _, called = CALLED[name].split(" ", 1)
    assert f"{asset.display_name}, {asset.plural}" == called


@pytest.mark.parametrize("name", NAMES)
def test_articles_go_by_sound(library, name):
    assert library[name].article == CALLED[name].split(" ")[0]


@pytest.mark.parametrize("name", NAMES)
def test_parts_are_convex_closed_thick_and_few_cornered(library, name):
    for part in (*library[name].fine, *library[name].coarse):
        mesh = as_mesh(part)
        assert mesh.is_watertight
        assert mesh.is_convex
        depths = mesh.face_normals @ part.vertices.T
        assert (depths.max(axis=1) - depths.min(axis=1)).min() >= 0.003
        assert len(part.vertices) <= 72


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_fine_parts_touch_and_do_not_overlap(library, name):
    fcl = pytest.importorskip("fcl")
    parts = library[name].fine
    planes = [PartGeometry.of(part) for part in parts]
    joined = {0}
    touching = set()
    for a, b in combinations(range(len(parts)), 2):
        low = np.maximum(parts[a].bounds[0], parts[b].bounds[0])
        high = np.minimum(parts[a].bounds[1], parts[b].bounds[1])
        if (low > high + 1e-4).any():
            continue
        normals = np.concatenate([planes[a].normals, planes[b].normals])
        common = linprog(  # the largest ball inside both
            [0.0, 0.0, 0.0, -1.0],
            A_ub=np.column_stack([normals, np.ones(len(normals))]),
            b_ub=np.concatenate([planes[a].offsets, planes[b].offsets]),
            bounds=[(None, None)] * 3 + [(None, None)],
        )
        assert common.x[3] < 1e-6, f"parts {a} and {b} overlap"
        shapes = [
            fcl.CollisionObject(
                fcl.Convex(p.vertices, len(p.faces), np.column_stack([np.full(len(p.faces), 3), p.faces]).ravel())
            )
            for p in (parts[a], parts[b])
        ]
        if fcl.distance(*shapes, fcl.DistanceRequest(), fcl.DistanceResult()) < 1e-4:
            touching.add((a, b))
    for _ in parts:
        joined |= {part for pair in touching if joined & set(pair) for part in pair}
    assert joined == set(range(len(parts)))  # one body, no loose pieces


@pytest.mark.parametrize("name", NAMES)
def test_coarse_parts_cover_fine_parts(library, name):
    covers = [PartGeometry.of(part) for part in library[name].coarse]
    for part in library[name].fine:
        assert any((part.vertices @ cover.normals.T <= cover.offsets + 1e-9).all() for cover in covers)


@pytest.mark.parametrize("name", NAMES)
def test_mass_properties_agree_with_trimesh(library, name):
    asset = library[name]
    mesh = trimesh.util.concatenate([as_mesh(part) for part in asset.fine])
    mesh.density = asset.mass / mesh.volume
    np.testing.assert_allclose(asset.center_of_mass, mesh.center_mass, atol=1e-9)
    np.testing.assert_allclose(asset.inertia, mesh.moment_inertia, atol=1e-9)


def test_inertias_of_box_and_can_are_the_textbook_ones(library):
    x, y, z = SIZES["cereal_box"]
    expected = 0.45 / 12.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    np.testing.assert_allclose(library["cereal_box"].inertia, np.diag(expected), atol=1e-12)
    r, h = 0.0334, 0.122
    expected = 0.37 * np.array([r * r / 4 + h * h / 12, r * r / 4 + h * h / 12, r * r / 2])
    np.testing.assert_allclose(np.diag(library["soda_can"].inertia), expected, rtol=0.06)  # a prism of 16 sides


@pytest.mark.parametrize("name", NAMES)
def test_visual_mesh_shows_what_collides(library, name):
    asset = library[name]
    np.testing.assert_allclose(asset.visual.bounds, asset.bounds, atol=0.0045)
    beyond = [asset.visual.vertices @ p.normals.T - p.offsets for p in map(PartGeometry.of, asset.fine)]
    assert np.min([b.max(axis=1) for b in beyond], axis=0).max() < 0.005  # m outside of all parts
    assert len(asset.visual.faces) <= 3000
    assert len(np.unique(asset.visual.visual.vertex_colors, axis=0)) <= 12  # colours share a palette of 256
    np.testing.assert_allclose(np.linalg.norm(asset.visual.vertex_normals, axis=1), 1.0, atol=1e-6)
    corners = asset.visual.vertex_normals[asset.visual.faces].mean(axis=1)
    outward = np.einsum("fi,fi->f", asset.visual.face_normals, corners)
    assert (outward[asset.visual.area_faces > 1e-9] > 0).all()


def test_class_colors_of_all_scene_types_differ():
    wanted = {name for scene_type in BUILT_IN for name in scene_type.assets}
    library = get_library(sorted(wanted & set(list_assets())))
    colors = np.array([asset.color for asset in library], dtype=float)
    gaps = np.linalg.norm(colors[:, None] - colors[None], axis=-1) + 1e3 * np.eye(len(colors))
    first, second = np.unravel_index(gaps.argmin(), gaps.shape)
    assert gaps.min() >= 25, (library[int(first)].name, library[int(second)].name)


# -- hollows ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FLOORS)
def test_hollow_things_are_hollow_above_a_flat_floor(library, name):
    asset, (radius, floor) = library[name], FLOORS[name]
    height = asset.bounds[1, 2]
    for z in np.linspace(floor + 1e-5, height, 9):
        assert not inside(asset, disc(radius, z)).any()
    assert inside(asset, disc(radius - 0.002, floor - 1e-5)).all()


def test_a_dozen_knives_stand_in_the_crock(library):
    crock = library["utensil_crock"]
    shafts = [
        (x + dx, y + dy)
        for x in (-0.022, 0.0, 0.022) for y in (-0.015, -0.005, 0.005, 0.015)
        for dx in (-0.010, 0.010) for dy in (-0.004, 0.004)
    ]  # fmt: skip
    points = np.array([(x, y, z) for x, y in shafts for z in (0.0081, 0.1, 0.169)])
    assert not inside(crock, points).any()


# -- standing ---------------------------------------------------------------------------------------


def test_each_asset_stands_alone_under_its_center_of_mass(library):
    for asset in library:
        corners = np.concatenate([part.vertices for part in asset.fine])
        assert corners[:, 2].min() == 0.0
        edges = ConvexHull(corners[corners[:, 2] == 0.0][:, :2]).equations
        margin = -(edges[:, :2] @ asset.center_of_mass[:2] + edges[:, 2]).max()
        assert math.atan2(margin, asset.center_of_mass[2]) > math.radians(11.0), asset.name  # tilt before it tips


def test_each_asset_stands_still(kitchen):
    # A neighbour 4 mm away, so that they are simulated rather than taken for resting.
    batch = scenes(kitchen, *([(name, 0.0, 0.0, 0.0), (name, 0.0, SIZES[name][1] + 0.004, 0.0)] for name in NAMES))
    result = feasibility(batch, duration=0.5)
    assert result.valid.all()
    assert result.feasible[:, 1:3].all()
    assert float(result.displacement[:, 1:3].max()) <= 1e-4
    assert float(equilibrium(batch, duration=0.5).displacement[:, 1:3].max()) <= 1e-4


@pytest.mark.slow
def test_each_asset_falls_back_upright(kitchen):
    cos, sin = math.cos(0.05), math.sin(0.05)
    tilted = [[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]]
    batch = scenes(kitchen, *([(name, 0.0, 0.0, 0.010, tilted)] for name in NAMES))
    settled = settle(batch, duration=2.0)
    assert settled.valid.all()
    upright = settled.batch.rotations[:, 1, 2, 2]
    assert float(upright.min()) > math.cos(2e-3), NAMES[int(upright.argmin())]
    assert float(settled.batch.translations[:, 1, 2].abs().max()) < 1e-4


def test_things_stand_on_plates_and_in_bowls(kitchen):
    loads = ("apple_gala", "pear_bosc", "bread_slice", "bowl", "apple_red", "pear_red")
    layouts = [
        [(plate, 0.0, 0.0, 0.0), (load, 0.0, 0.0, 0.006)] for plate in ("plate", "shared_plate") for load in loads
    ]
    layouts += [
        [("bowl", 0.0, 0.0, 0.0), (fruit, 0.004, 0.0, 0.006)] for fruit in loads if fruit not in ("bowl", "bread_slice")
    ]
    layouts += [
        [("fruit_bowl", 0.0, 0.0, 0.0), (name, 0.010, 0.0, 0.006)] for name in NAMES if name[:5] in ("apple", "pear_")
    ]
    batch = scenes(kitchen, *layouts)
    assert float(penetration(batch).depth.max()) <= 1e-6
    result = feasibility(batch, duration=0.5)
    assert result.feasible[:, 1:3].all()
    assert float(result.displacement.max()) <= 3e-4


@pytest.mark.slow
def test_projection_leaves_things_on_plates_and_in_bowls(kitchen):
    rng = np.random.default_rng(0)
    layouts = []
    for below, above in (
        ("bowl", "apple_gala"),
        ("fruit_bowl", "apple_gala"),
        ("plate", "pear_bosc"),
        ("plate", "bowl"),
    ):
        for _ in range(10):
            shift = rng.normal(0.0, 0.01, (2, 3)) * [1.0, 1.0, 0.5]
            layouts.append([(below, *shift[0]), (above, *(shift[1] + [0.0, 0.0, 0.006]))])
    projected = project(scenes(kitchen, *layouts))
    assert projected.converged.all()
    offset = projected.batch.translations[:, 2] - projected.batch.translations[:, 1]
    assert float(offset[:, :2].norm(dim=1).max()) < 0.06
    assert float(offset[:, 2].max()) < 0.06


def test_bread_stacks(kitchen):
    pile = [("bread_slice", 0.0, 0.0, 0.016 * level) for level in range(4)]
    result = feasibility(scenes(kitchen, pile), duration=0.5)
    assert float(penetration(scenes(kitchen, pile)).depth.max()) <= 1e-6
    assert result.feasible[0, 1:5].all()
    assert float(result.displacement.max()) <= 3e-4
