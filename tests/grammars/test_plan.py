"""Plans of objects: overlap and heights against linear programming."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from scene_envs.assets import get_library
from scene_envs.assets.shapes import box, ring, solid
from scene_envs.grammars.surface import Disc, Placed, Rectangle, _top_on_axis, carrying_height, meet, plan_of

ASSETS = ("dinner_plate", "serving_dish", "teacup", "teapot", "steamer_bottom")


def _placed(plan: Disc | Rectangle, rng: np.random.Generator) -> Placed:
    yaw = rng.random() * 7.0
    return Placed(plan, *rng.uniform(-0.3, 0.3, 2), math.cos(yaw), math.sin(yaw))


def _share_a_point(first: Placed, second: Placed) -> float:
    """How far (m) the edges of two rectangles can move inward with a common point left; negative when apart."""
    rows, bounds = [], []
    for placed in (first, second):
        corners = np.array(placed.corners())
        sides = np.roll(corners, -1, axis=0) - corners
        normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / np.linalg.norm(sides, axis=1, keepdims=True)
        rows.append(np.column_stack([normals, np.ones(4)]))
        bounds.append(np.einsum("ij,ij->i", normals, corners))
    solution = linprog([0, 0, -1], np.vstack(rows), np.hstack(bounds), bounds=[(None, None)] * 3)
    return float(solution.x[2])


@pytest.mark.slow
def test_rectangles_meet_exactly_when_a_common_point_exists() -> None:
    rng = np.random.default_rng(0)
    verdicts = set()
    for _ in range(300):
        first = _placed(Rectangle(*rng.uniform(0.02, 0.2, 2), *rng.uniform(-0.05, 0.05, 2)), rng)
        second = _placed(Rectangle(*rng.uniform(0.02, 0.2, 2)), rng)
        margin = _share_a_point(first, second)
        assert meet(first, second) == meet(second, first) == (margin > 0)
        verdicts.add(margin > 0)
    assert verdicts == {True, False}


def test_a_disc_meets_a_rectangle_when_its_nearest_point_is_within_the_radius() -> None:
    rng = np.random.default_rng(1)
    grid = np.linspace(-1, 1, 201)
    for _ in range(60):
        plan = Rectangle(*rng.uniform(0.05, 0.2, 2), *rng.uniform(-0.05, 0.05, 2))
        square, disc = _placed(plan, rng), _placed(Disc(rng.uniform(0.05, 0.2)), rng)
        center, along = np.array(square.center()), np.array([square.cos, square.sin])
        across = np.array([-square.sin, square.cos])
        u, v = np.meshgrid(grid * plan.half_x, grid * plan.half_y)
        points = center + u[..., None] * along + v[..., None] * across
        nearest = np.hypot(points[..., 0] - disc.x, points[..., 1] - disc.y).min()
        if abs(nearest - disc.plan.reach) > 3e-3:  # beyond the spacing of the grid
            assert meet(square, disc) == meet(disc, square) == (nearest < disc.plan.reach)


@pytest.mark.parametrize("name", ASSETS)
def test_the_plan_holds_the_whole_asset(name: str) -> None:
    asset = get_library((name,))[0]
    corners = np.concatenate([part.vertices for part in asset.fine])[:, :2]
    plan = plan_of(asset)
    if isinstance(plan, Disc):
        assert np.hypot(*corners.T).max() < plan.radius
    else:
        assert (np.abs(corners - [plan.center_x, plan.center_y]) < [plan.half_x, plan.half_y]).all()


@pytest.mark.parametrize("name", ASSETS)
def test_things_rest_where_a_ray_from_above_hits(name: str) -> None:
    asset = get_library((name,))[0]
    highest = []
    for part in asset.fine:
        planes = ConvexHull(part.vertices).equations
        solution = linprog([0, 0, -1], planes[:, :3], -planes[:, 3], bounds=[(0, 0), (0, 0), (None, None)])
        if solution.success:
            highest.append(solution.x[2])
    assert carrying_height(asset) == pytest.approx(max(highest), abs=1e-8)


def test_the_axis_misses_parts_beside_it() -> None:
    beside = box((0.1, 0.1, 0.1), (0.2, 0.0, 0.0))
    assert _top_on_axis(beside.vertices[beside.faces]) is None
    cone = solid([(0.1, 0.0), (0.0, 0.3)], 12)
    assert _top_on_axis(cone.vertices[cone.faces]) == pytest.approx(0.3)
    assert all(_top_on_axis(wedge.vertices[wedge.faces]) is None for wedge in ring([(0.1, 0), (0.2, 0), (0.2, 0.1)], 8))
