"""Recipes of food, ware, furniture, cutlery, games and toys: sizes, hollows, faces to stand on, and standing still."""

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
from scene_envs.assets.base import indefinite_article
from scene_envs.physics import equilibrium, feasibility, penetration, project, settle
from scene_envs.physics.parts import PartGeometry
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import Camera, FixedObject, SceneType

TIERS = (-0.3915, -0.1232, 0.1392, 0.4075)
"""Heights of the upper surfaces of the boards in the frame of the shelf, m."""
FOOD = {  # (x, y, z) m, handles aside
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
FURNITURE = {  # (x, y, z) m
    "breakfast_table": (0.75, 1.50, 0.74),
    "fork": (0.19, 0.025, 0.012),
    "knife": (0.22, 0.02, 0.008),
    "dinner_spoon": (0.19, 0.042, 0.015),
    "teaspoon": (0.155, 0.032, 0.013),
    "shelf": (0.30, 0.60, 0.783 + 2 * 0.016),  # sides of 0.783 m between two boards
    "lamp": (0.056, 0.056, 0.10),
    "board_game_s": (0.20, 0.264, 0.060),
    "board_game_xl": (0.50, 0.25, 0.055),
    "book": (0.14, 0.05, 0.21),
    "speaker": (0.175, 0.070, 0.075),
    "board_game_l": (0.40, 0.265, 0.055),
    "game_case": (0.14, 0.125, 0.0125),
    "stacking_ring": (0.08, 0.08, 0.13),
    "board_game_l2": (0.40, 0.265, 0.069),
    "toy_train": (0.09, 0.04, 0.055),
    "chair": (0.45, 0.45, 0.90),
    "floor": (10.0, 10.0, 0.1),
}
SIZES = FOOD | FURNITURE
NAMES = tuple(SIZES)
HANDLED = ("mug", "water_jug")
MASSES = {
    "cereal_box": 0.45, "bread_slice": 0.03, "apple_gala": 0.15, "apple_golden": 0.17, "apple_green": 0.19,
    "apple_red": 0.21, "avocado_a": 0.22, "avocado_b": 0.20, "avocado_c": 0.33, "pear_bosc": 0.19, "pear_anjou": 0.19,
    "pear_red": 0.20, "utensil_crock": 0.40, "fruit_bowl": 0.55, "bowl": 0.33, "soda_can": 0.37, "tea_bottle": 0.53,
    "shared_plate": 0.45, "plate": 0.40, "mug": 0.25, "water_jug": 0.55,
    "breakfast_table": 0.0, "fork": 0.03, "knife": 0.05, "dinner_spoon": 0.035, "teaspoon": 0.02, "shelf": 0.0,
    "lamp": 0.08, "board_game_s": 0.90, "board_game_xl": 1.10, "book": 0.45, "speaker": 0.60, "board_game_l": 1.10,
    "game_case": 0.07, "stacking_ring": 0.25, "board_game_l2": 1.20, "toy_train": 0.10, "chair": 6.0, "floor": 0.0,
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
    "breakfast_table": "a table, tables", "fork": "a fork, forks", "knife": "a knife, knives",
    "dinner_spoon": "a spoon, spoons", "teaspoon": "a spoon, spoons", "shelf": "a shelf, shelves",
    "lamp": "a lamp, lamps", "board_game_s": "a board game, board games", "board_game_xl": "a board game, board games",
    "book": "a book, books", "speaker": "a speaker, speakers", "board_game_l": "a board game, board games",
    "game_case": "a nintendo game, nintendo games", "stacking_ring": "a stacking ring, stacking rings",
    "board_game_l2": "a board game, board games", "toy_train": "a toy train, toy trains", "chair": "a chair, chairs",
    "floor": "a floor, floors",
}  # fmt: skip
PARTS = {
    "breakfast_table": (5, 5), "fork": (6, 2), "knife": (2, 1), "dinner_spoon": (3, 2), "teaspoon": (3, 2),
    "shelf": (7, 7), "lamp": (3, 1), "stacking_ring": (7, 2), "toy_train": (4, 2), "chair": (6, 6),
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
STATIC = ("breakfast_table", "shelf", "floor")
FREE = tuple(name for name in NAMES if name not in STATIC)
THINGS = tuple(name for name in FURNITURE if name not in STATIC)
BOXES = ("board_game_s", "board_game_xl", "board_game_l", "board_game_l2", "book", "game_case")
CUTLERY = ("fork", "knife", "dinner_spoon", "teaspoon")
LONG = ("board_game_xl", "board_game_l", "board_game_l2")
"""Boxes that fit a shelf turned by 90 degrees only."""


@pytest.fixture(scope="module")
def library():
    return get_library(NAMES)


def scenes(support, *layouts, extra=(), z=0.0):
    """One scene per layout on ``support`` at height ``z``: a list of (asset, x, y, z) or (asset, x, y, z, rotation)."""
    scene_type = SceneType(
        name=f"on_{support}",
        assets=(support, *THINGS, *extra),
        slots=8,
        workspace=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.5)),
        welded=(support,),
        fixed=(FixedObject(support, (0.0, 0.0, z)),),
        camera=Camera((0.0, 0.0, 1.7), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    )
    batch = SceneBatch.empty(scene_type, len(layouts))
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    for row, layout in enumerate(layouts):
        for slot, (name, *position) in enumerate(layout, start=1):
            translations[row, slot] = torch.tensor(position[:3])
            rotations[row, slot] = torch.as_tensor(position[3]) if len(position) > 3 else torch.eye(3)
            categories[row, slot] = scene_type.assets.index(name)
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def kitchen(*layouts):
    """One scene per layout of food and ware on a table."""
    return scenes("cafe_table", *layouts, extra=tuple(FOOD))


def turned(axis, angle):
    """(3, 3) rotation about a coordinate axis by ``angle`` rad."""
    cos, sin = math.cos(angle), math.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = cos, -sin, sin, cos
    return matrix


def as_mesh(part):
    return trimesh.Trimesh(part.vertices, part.faces, process=False)


def inside(asset, points):
    """(P,) whether each of ``points`` (P, 3) is in a fine part."""
    found = np.zeros(len(points), dtype=bool)
    for part in asset.fine:
        planes = PartGeometry.of(part)
        found |= (points @ planes.normals.T <= planes.offsets).all(axis=1)
    return found


def grid(low, high, count=9):
    """(count^3, 3) points all over the box between two corners, m."""
    axes = [np.linspace(a, b, count) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def disc(radius, z):
    """(P, 3) points all over a horizontal disc, m."""
    angle, r = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 73), np.linspace(0.0, radius, 9))
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.full_like(r, z)], axis=-1).reshape(-1, 3)


# -- what each asset is -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_sizes_masses_and_names_are_the_specified_ones(library, name):
    asset = library[name]
    axes = slice(1, 3) if name in HANDLED else slice(0, 3)
    exact = {"rtol": 0.02} if name in FOOD else {"rtol": 0.0, "atol": 1e-12}
    np.testing.assert_allclose((asset.bounds[1] - asset.bounds[0])[axes], SIZES[name][axes], **exact)
    assert asset.mass == MASSES[name]
    assert asset.static == (name in STATIC)
    assert f"{indefinite_article(asset.display_name)} {asset.display_name}, {asset.plural}" == CALLED[name]
    assert name in FOOD or (len(asset.fine), len(asset.coarse)) == PARTS.get(name, (1, 1))


@pytest.mark.parametrize("name", FURNITURE)
def test_frames_are_in_the_middle_of_the_base(library, name):
    low, high = library[name].bounds
    np.testing.assert_allclose(low[:2], -high[:2], atol=1e-12)
    height = {"breakfast_table": -0.74, "shelf": -0.4075, "floor": -0.1}.get(name, 0.0)
    assert low[2] == pytest.approx(height, abs=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_parts_are_convex_closed_thick_and_few_cornered(library, name):
    for part in (*library[name].fine, *library[name].coarse):
        mesh = as_mesh(part)
        assert mesh.is_watertight
        assert mesh.is_convex
        depths = mesh.face_normals @ part.vertices.T
        assert (depths.max(axis=1) - depths.min(axis=1)).min() >= 0.003
        assert len(part.vertices) <= 72


@pytest.mark.parametrize("name", [*FOOD, *PARTS])
def test_fine_parts_touch_and_do_not_overlap(library, name):
    parts = library[name].fine
    planes = [PartGeometry.of(part) for part in parts]
    touching = set()
    for a, b in combinations(range(len(planes)), 2):
        low = np.maximum(parts[a].bounds[0], parts[b].bounds[0])
        high = np.minimum(parts[a].bounds[1], parts[b].bounds[1])
        if (low > high + 1e-4).any():
            continue
        normals = np.concatenate([planes[a].normals, planes[b].normals])
        common = linprog(  # the largest ball inside both; a negative radius is how far they are apart, or more
            [0.0, 0.0, 0.0, -1.0],
            A_ub=np.column_stack([normals, np.ones(len(normals))]),
            b_ub=np.concatenate([planes[a].offsets, planes[b].offsets]),
            bounds=[(None, None)] * 4,
        )
        assert common.x[3] < 1e-6, f"parts {a} and {b} overlap"
        if common.x[3] > (-5e-5 if name in FOOD else -1e-6):
            touching.add((a, b))
    joined = {0}
    for _ in planes:
        joined |= {part for pair in touching if joined & set(pair) for part in pair}
    assert joined == set(range(len(planes)))  # one body, no loose pieces


@pytest.mark.parametrize("name", NAMES)
def test_coarse_parts_cover_fine_parts(library, name):
    covers = [PartGeometry.of(part) for part in library[name].coarse]
    for part in library[name].fine:
        assert any((part.vertices @ cover.normals.T <= cover.offsets + 1e-9).all() for cover in covers)


@pytest.mark.parametrize("name", FREE)
def test_mass_properties_agree_with_trimesh(library, name):
    asset = library[name]
    mesh = trimesh.util.concatenate([as_mesh(part) for part in asset.fine])
    mesh.density = asset.mass / mesh.volume
    np.testing.assert_allclose(asset.center_of_mass, mesh.center_mass, atol=1e-9)
    np.testing.assert_allclose(asset.inertia, mesh.moment_inertia, atol=1e-9)


@pytest.mark.parametrize("name", ["cereal_box", *BOXES])
def test_boxes_have_the_textbook_inertia(library, name):
    x, y, z = SIZES[name]
    expected = MASSES[name] / 12.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    np.testing.assert_allclose(library[name].center_of_mass, [0.0, 0.0, 0.5 * z], atol=1e-12)
    np.testing.assert_allclose(library[name].inertia, np.diag(expected), atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_visual_mesh_shows_what_collides(library, name):
    asset = library[name]
    np.testing.assert_allclose(asset.visual.bounds, asset.bounds, atol=0.0045 if name in FOOD else 0.001)
    if name in FOOD:
        beyond = [asset.visual.vertices @ part.normals.T - part.offsets for part in map(PartGeometry.of, asset.fine)]
        assert np.min([b.max(axis=1) for b in beyond], axis=0).max() < 0.005  # m outside of all parts
    assert len(asset.visual.faces) <= 3000
    colors = np.unique(asset.visual.visual.vertex_colors, axis=0)
    assert len(colors) <= (12 if name in FOOD else 16)  # they share a palette of 256
    np.testing.assert_allclose(np.linalg.norm(asset.visual.vertex_normals, axis=1), 1.0, atol=1e-6)
    corners = asset.visual.vertex_normals[asset.visual.faces].mean(axis=1)
    outward = np.einsum("fi,fi->f", asset.visual.face_normals, corners)
    assert (outward[asset.visual.area_faces > 1e-9] > 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_visual_mesh_stays_in_reach_of_the_coarse_parts(library, name):
    points = library[name].visual.vertices
    distance = np.full(len(points), np.inf)
    for part in library[name].coarse:
        planes = PartGeometry.of(part)
        distance = np.minimum(distance, (points @ planes.normals.T - planes.offsets).max(axis=1))
    assert distance.max() <= 0.005


def test_all_names_and_class_colors_of_the_library_differ():
    library = get_library(list_assets())
    assert len(set(library.names)) == len(library)
    colors = np.array([asset.color for asset in library], dtype=float)
    gaps = np.linalg.norm(colors[:, None] - colors[None], axis=-1) + 1e3 * np.eye(len(colors))
    first, second = np.unravel_index(gaps.argmin(), gaps.shape)
    assert gaps.min() >= 25, (library[int(first)].name, library[int(second)].name)


def test_the_inertia_of_a_can_is_the_textbook_one(library):
    r, h = 0.0334, 0.122
    expected = 0.37 * np.array([r * r / 4 + h * h / 12, r * r / 4 + h * h / 12, r * r / 2])
    np.testing.assert_allclose(np.diag(library["soda_can"].inertia), expected, rtol=0.06)  # a prism of 16 sides


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


# -- furniture --------------------------------------------------------------------------------------


def test_supports_have_their_surfaces_where_grammars_put_things(library):
    np.testing.assert_allclose(TIERS, (-0.3915, -0.1232, 0.1392, 0.4075))
    boards = [part for part in library["shelf"].fine if np.ptp(part.bounds[:, 2]) < 0.02]
    np.testing.assert_allclose(sorted(part.bounds[1, 2] for part in boards), TIERS, atol=1e-12)
    np.testing.assert_allclose([np.ptp(part.bounds[:, 2]) for part in boards], 0.016, atol=1e-12)
    for name, size in (("breakfast_table", (0.75, 1.50, 0.04)), ("floor", (10.0, 10.0, 0.1))):
        assert library[name].bounds[1, 2] == 0.0
        assert any(np.allclose(np.ptp(part.bounds, axis=0), size) for part in library[name].fine)


@pytest.mark.parametrize(("tier", "height"), [(0, 0.2523), (1, 0.2464), (2, 0.2523)])
def test_tiers_are_clear_and_closed_at_the_back_and_the_sides(library, tier, height):
    shelf, floor, e = library["shelf"], TIERS[tier], 1e-6
    low, high = np.array([-0.145, -0.284, floor]), np.array([0.15, 0.284, floor + height])
    assert not inside(shelf, grid(low + e, high - e)).any()
    for axis, side in ((0, -1), (1, -1), (1, 1), (2, -1), (2, 1)):  # not +x, the open side
        a, b = low + e, high - e
        a[axis] = b[axis] = (low[axis] if side < 0 else high[axis]) + side * e
        assert inside(shelf, grid(a, b, 5)).all()
    a, b = low + e, high - e
    a[0] = b[0] = 0.1501
    assert not inside(shelf, grid(a, b, 5)).any()


def test_a_chair_faces_plus_x_and_goes_under_a_table(library):
    chair = library["chair"]
    assert inside(chair, np.array([[-0.21, 0.0, 0.85], [0.20, 0.0, 0.449]])).all()  # back and seat
    assert not inside(chair, np.array([[0.20, 0.0, 0.451], [0.0, 0.0, 0.2]])).any()
    assert np.hypot(*chair.bounds[1, :2]) < 0.35
    place = SceneType(
        name="dining_place",
        assets=("floor", "cafe_table", "chair"),
        slots=3,
        workspace=((-5.0, -5.0, -1.0), (5.0, 5.0, 1.0)),
        welded=("floor", "cafe_table"),
        fixed=(FixedObject("floor"), FixedObject("cafe_table", (0.0, 0.0, 0.785))),
        camera=Camera((0.0, 0.0, 5.0), (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0)),
    )
    batch = SceneBatch.empty(place, 2)
    translations, categories = batch.translations.clone(), batch.categories.clone()
    categories[:, 2] = 2
    translations[:, 2, 0] = torch.tensor([-0.44, -0.40])  # the second reaches into the table top with its back
    rotations = batch.rotations.clone()
    rotations[:, 2] = torch.eye(3)
    depth = penetration(SceneBatch.from_parts(translations, rotations, categories, place)).depth[:, 2]
    assert float(depth[0]) <= 1e-6
    assert float(depth[1]) == pytest.approx(0.625 - 0.595, abs=2e-3)


# -- standing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FREE)
def test_each_asset_stands_under_its_center_of_mass_in_both_levels(library, name):
    asset = library[name]
    for level in (asset.fine, asset.coarse):
        corners = np.concatenate([part.vertices for part in level])
        assert corners[:, 2].min() == 0.0
        edges = ConvexHull(corners[corners[:, 2] == 0.0][:, :2]).equations
        margin = -(edges[:, :2] @ asset.center_of_mass[:2] + edges[:, 2]).max()
        tilt = math.degrees(math.atan2(margin, asset.center_of_mass[2]))  # before it tips
        assert tilt > (11.0 if name in FOOD else 13.0)


@pytest.mark.slow
@pytest.mark.parametrize(("support", "z"), [("breakfast_table", 0.0), ("floor", 0.0), ("shelf", 0.1232)])
def test_each_asset_stands_still(support, z):
    names = [name for name in THINGS if support != "shelf" or name != "chair"]
    yaw = {name: 0.5 * math.pi if support == "shelf" and name in LONG else 0.4 * (support != "shelf") for name in names}
    upright = [[(name, 0.0025, 0.0, 0.0, turned("z", yaw[name]))] for name in names]
    result = feasibility(scenes(support, *upright, z=z), duration=0.5)
    assert result.feasible[:, 1].all()
    assert float(result.displacement.max()) <= 1e-4
    # Off level by 0.4 mrad, so that they are simulated rather than taken for resting.
    tilt = turned("y", 4e-4)
    tilted = [[(name, 0.0025, 0.0, 0.0, turned("z", yaw[name]) @ tilt)] for name in names]
    result = feasibility(scenes(support, *tilted, z=z), duration=0.5)
    assert result.feasible[:, 1].all()
    worst = int(result.displacement[:, 1].argmax())
    assert float(result.displacement[worst, 1]) <= 1e-4, names[worst]
    assert float(result.rotation.max()) <= 1e-3


def test_each_asset_falls_back_upright():
    layouts = [[(name, 0.0, 0.0, 0.015, turned("x", 0.08))] for name in THINGS if name != "chair"]
    settled = settle(scenes("breakfast_table", *layouts), duration=2.0)
    assert settled.valid.all()
    upright = settled.batch.rotations[:, 1, 2, 2]
    assert float(upright.min()) > math.cos(3e-3), layouts[int(upright.argmin())]
    assert float(settled.batch.translations[:, 1, 2].abs().max()) < 1e-4


def test_a_speaker_does_not_roll(library):
    speaker = library["speaker"]
    foot = speaker.fine[0].vertices[speaker.fine[0].vertices[:, 2] == 0.0]
    np.testing.assert_allclose(np.ptp(foot[:, :2], axis=0), (0.175, 0.036), atol=1e-12)
    lifted = 0.018 * math.sin(0.3)  # on one edge of its flat, 17 degrees over; it tips beyond atan(18 / 37.5) = 25.6
    settled = settle(scenes("breakfast_table", [("speaker", 0.0, 0.0, lifted, turned("x", 0.3))]), duration=2.0)
    assert float(settled.batch.rotations[0, 1, 2, 2]) > math.cos(3e-3)


def test_boxes_stack_exactly(library):
    for name in BOXES:
        top = library[name].fine[0].vertices
        assert (np.isclose(top[:, 2], SIZES[name][2], rtol=0.0, atol=1e-12)).sum() == 4
    layouts = [
        [("board_game_s", 0.0, 0.0, 0.060 * level) for level in range(5)],
        [("game_case", 0.0, 0.0, 0.0125 * level) for level in range(4)],
        [("board_game_l2", 0.0, 0.0, 0.0), ("board_game_l", 0.0, 0.0, 0.069), ("board_game_xl", 0.0, 0.0, 0.124)],
        [("board_game_xl", 0.0, 0.0, 0.0), ("board_game_xl", 0.0, 0.0, 0.055), ("board_game_s", 0.1, 0.0, 0.110)],
    ]
    batch = scenes("breakfast_table", *layouts)
    assert float(penetration(batch).depth.max()) <= 1e-6
    result = feasibility(batch, duration=0.5)
    assert [int(count) for count in result.counts] == [len(layout) for layout in layouts]
    assert float(result.displacement.max()) <= 3e-4


def test_a_book_stands_at_the_end_wall_of_every_tier():
    layouts = [[("book", 0.0, 0.025 - 0.284, tier), ("book", 0.0, 0.075 - 0.284, tier)] for tier in TIERS[:3]]
    batch = scenes("shelf", *layouts)
    assert float(penetration(batch).depth.max()) <= 1e-6
    result = feasibility(batch, duration=0.5)
    assert result.feasible[:, 1:3].all()
    assert float(result.displacement.max()) <= 1e-4


@pytest.mark.parametrize("name", CUTLERY)
def test_cutlery_lies_on_handle_and_head(library, name):
    asset, length = library[name], SIZES[name][0]
    corners = np.concatenate([part.vertices for part in asset.fine])
    feet = corners[corners[:, 2] == 0.0]
    handle, head = feet[feet[:, 0] < 0.0], feet[feet[:, 0] > 0.0]
    assert handle[:, 0].min() == pytest.approx(-0.5 * length)
    for foot in (handle, head):
        assert np.ptp(foot[:, 1]) > 0.009  # wide enough not to rock
        assert np.ptp(foot[:, 0]) > 0.010
    assert head[:, 0].max() > 0.25 * length
    wide = corners[np.abs(corners[:, 1]) > 0.499 * SIZES[name][1]]
    assert (wide[:, 0] > 0.0).all()  # the head is toward +x


@pytest.mark.slow
def test_cutlery_stands_leaning_in_a_crock(library):
    layout = [("utensil_crock", 0.0, 0.0, 0.0)]
    for index, name in enumerate(CUTLERY):  # handles down, heads outward, one on each side
        lean = np.array(
            [[math.sin(0.12), 0.0, -math.cos(0.12)], [0.0, 1.0, 0.0], [math.cos(0.12), 0.0, math.sin(0.12)]]
        )
        foot = np.array([0.02, 0.0, 0.0085]) + 0.5 * SIZES[name][0] * lean[:, 0]
        turn = turned("z", 0.5 * math.pi * index)
        layout.append((name, *(turn @ foot), turn @ lean))
    batch = settle(scenes("breakfast_table", layout, extra=("utensil_crock",)), duration=3.0).batch
    assert feasibility(batch).feasible[0, 1:6].all()
    for slot, name in enumerate(CUTLERY, start=2):
        rotation, translation = batch.rotations[0, slot].double().numpy(), batch.translations[0, slot].double().numpy()
        corners = np.concatenate([part.vertices for part in library[name].fine]) @ rotation.T + translation
        lean = math.degrees(math.acos(rotation[2, 0]))
        assert 2.0 < lean < 45.0
        assert np.hypot(*corners[corners[:, 2] < 0.165][:, :2].T).max() < 0.0575
        assert corners[:, 2].min() == pytest.approx(0.008, abs=5e-4)


# -- food and ware -------------------------------------------------------------------------------


def test_food_and_ware_stand_still_beside_another():
    # A neighbour 4 mm away, so that they are simulated rather than taken for resting.
    batch = kitchen(*([(name, 0.0, 0.0, 0.0), (name, 0.0, SIZES[name][1] + 0.004, 0.0)] for name in FOOD))
    result = feasibility(batch, duration=0.5)
    assert result.valid.all()
    assert result.feasible[:, 1:3].all()
    assert float(result.displacement[:, 1:3].max()) <= 1e-4
    assert float(equilibrium(batch, duration=0.5).displacement[:, 1:3].max()) <= 1e-4


@pytest.mark.slow
def test_food_and_ware_fall_back_upright():
    batch = kitchen(*([(name, 0.0, 0.0, 0.010, turned("x", 0.05))] for name in FOOD))
    settled = settle(batch, duration=2.0)
    assert settled.valid.all()
    upright = settled.batch.rotations[:, 1, 2, 2]
    assert float(upright.min()) > math.cos(2e-3), tuple(FOOD)[int(upright.argmin())]
    assert float(settled.batch.translations[:, 1, 2].abs().max()) < 1e-4


def test_things_stand_on_plates_and_in_bowls():
    loads = ("apple_gala", "pear_bosc", "bread_slice", "bowl", "apple_red", "pear_red")
    layouts = [
        [(plate, 0.0, 0.0, 0.0), (load, 0.0, 0.0, 0.006)] for plate in ("plate", "shared_plate") for load in loads
    ]
    layouts += [
        [("bowl", 0.0, 0.0, 0.0), (fruit, 0.004, 0.0, 0.006)] for fruit in loads if fruit not in ("bowl", "bread_slice")
    ]
    layouts += [
        [("fruit_bowl", 0.0, 0.0, 0.0), (name, 0.010, 0.0, 0.006)] for name in FOOD if name[:5] in ("apple", "pear_")
    ]
    batch = kitchen(*layouts)
    assert float(penetration(batch).depth.max()) <= 1e-6
    result = feasibility(batch, duration=0.5)
    assert result.feasible[:, 1:3].all()
    assert float(result.displacement.max()) <= 3e-4


@pytest.mark.slow
def test_projection_leaves_things_on_plates_and_in_bowls():
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
    projected = project(kitchen(*layouts))
    assert projected.converged.all()
    offset = projected.batch.translations[:, 2] - projected.batch.translations[:, 1]
    assert float(offset[:, :2].norm(dim=1).max()) < 0.06
    assert float(offset[:, 2].max()) < 0.06


def test_bread_stacks():
    pile = [("bread_slice", 0.0, 0.0, 0.016 * level) for level in range(4)]
    result = feasibility(kitchen(pile), duration=0.5)
    assert float(penetration(kitchen(pile)).depth.max()) <= 1e-6
    assert result.feasible[0, 1:5].all()
    assert float(result.displacement.max()) <= 3e-4
