"""The words of the grammar language, a user's own grammar, and plans of support surfaces."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from scene_envs.assets import get_library
from scene_envs.assets.shapes import box, ring, solid
from scene_envs.assets.support_shapes import upper_side
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.grammars import (
    NOTHING,
    Gaussian,
    Geometric,
    Grammar,
    Group,
    Object,
    OneOf,
    Region,
    Repeat,
    Stack,
    Surface,
    Yaw,
    get_grammar,
    list_grammars,
    register_grammar,
)
from scene_envs.grammars.surface import (
    Disc,
    FreeSurface,
    Outline,
    Placed,
    Rectangle,
    carrying_height,
    meet,
    plan_of,
)
from scene_envs.scene_types import get_scene_type

HERE = Gaussian()


def test_geometric_has_the_stated_probabilities() -> None:
    rng = np.random.default_rng(0)
    draws = np.bincount([Geometric(0.6, 1, 4, present=0.9).draw(rng) for _ in range(20_000)], minlength=5)
    weights = np.array([1.0, 0.4, 0.16, 0.064])
    expected = np.r_[0.1, 0.9 * weights / weights.sum()]
    assert stats.chisquare(draws, expected * draws.sum()).pvalue > 1e-4


def test_one_of_draws_by_weight_and_group_draws_all() -> None:
    node = OneOf((3.0, Group(Object("a", HERE), Object("b", HERE))), (1.0, NOTHING))
    rng, reasons = np.random.default_rng(0), Counter[str]()
    sizes = Counter(len(node.draw(rng, reasons)) for _ in range(8000))
    assert set(sizes) == {0, 2}
    assert sizes[2] / 8000 == pytest.approx(0.75, abs=0.02)


def test_stack_heights_are_geometric_and_bounded() -> None:
    rng, reasons = np.random.default_rng(0), Counter[str]()
    stack = Stack("box", {"box": 0.5, "lid": 0.25, None: 0.25}, step=0.1, where=HERE, at_most=3)
    towers = [stack.draw(rng, reasons)[0].assets for _ in range(16_000)]
    assert max(map(len, towers)) == 3
    assert all("lid" not in assets[:-1] for assets in towers)
    # Unbounded: P(1) = 1/4 (box, stop), P(2) = 1/4 + 1/8, P(3) = 1/8 + 1/16; conditioned on at most 3.
    observed = np.bincount([len(assets) for assets in towers])[1:]
    expected = np.array([4, 6, 3]) / 13
    assert stats.chisquare(observed, expected * 16_000).pvalue > 1e-4
    assert reasons["stack of box above 3"] > 0


def test_repeat_draws_again_until_its_conditions_hold_and_says_why() -> None:
    reasons: Counter[str] = Counter()
    node = Repeat(Object("a", HERE), Geometric(0.5, 0, 5), {"fewer than 3": lambda towers: len(towers) >= 3})
    sizes = [len(node.draw(np.random.default_rng(i), reasons)) for i in range(200)]
    assert min(sizes) >= 3
    assert reasons["fewer than 3"] > 0


def test_one_of_without_positive_weight_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="positive sum"):
        OneOf((0.0, NOTHING))


def test_placement_keeps_distance_on_a_crowded_surface_and_says_when_it_is_full() -> None:
    surface, rng = FreeSurface(Region(0.5, 0.5)), np.random.default_rng(0)
    disc = Outline((Disc(0.1),), (Disc(0.0),))
    spots = []
    while (spot := surface.place(Gaussian(along=0.05), Yaw(), disc, rng)) is not None:
        spots.append(spot)
    # Random placement of discs of diameter 0.2 with centres in a unit square: jamming leaves no free cell.
    assert 18 <= len(spots) <= 35
    assert min(math.dist(a[:2], b[:2]) for i, a in enumerate(spots) for b in spots[:i]) >= 0.2
    assert max(max(map(abs, spot[:2])) for spot in spots) <= 0.5


def test_placement_follows_its_distribution_cut_to_the_free_region() -> None:
    rng = np.random.default_rng(0)
    where = Gaussian(x=0.6, y=0.0, along=0.05)
    disc = Outline((Disc(0.1),), (Disc(0.0),))
    xs = [FreeSurface(Region(0.475, 0.475)).place(where, Yaw(), disc, rng) for _ in range(600)]
    mean = np.mean([spot[0] for spot in xs if spot is not None])
    expected = stats.truncnorm(-np.inf, (0.475 - 0.6) / 0.05, loc=0.6, scale=0.05).mean()
    assert mean == pytest.approx(expected, abs=4e-3)


def test_gaussian_is_rotated_by_its_direction() -> None:
    rng = np.random.default_rng(0)
    points = np.array([Gaussian(1, 2, along=0.3, across=0.1, direction=math.pi / 2).draw(rng) for _ in range(4000)])
    np.testing.assert_allclose(points.mean(axis=0), [1, 2], atol=0.02)
    np.testing.assert_allclose(points.std(axis=0), [0.1, 0.3], rtol=0.05)


def _tea_party() -> Grammar:
    cups = Repeat(Object("teacup", HERE), Geometric(0.5, 1, 3))
    surface = Surface([cups], Region(0.3, 0.3), keep_out={"teacup": 0.07}, footprint={"teacup": 0.07})
    conditions = {"no pair": lambda towers: len(towers) >= 2}
    return Grammar("tea_party", get_scene_type("dimsum_table"), [surface], conditions)


def test_a_users_grammar_is_found_by_name_and_its_conditions_hold() -> None:
    register_grammar("tea_party")(_tea_party)
    assert "tea_party" in list_grammars()
    grammar = get_grammar("tea_party")
    batch = grammar.sample(np.random.default_rng(0), 50)
    assert set(batch.counts.tolist()) == {3, 4}
    assert grammar.reasons["no pair"] > 0


def test_an_unknown_grammar_offers_the_nearest_name() -> None:
    with pytest.raises(UnknownNameError, match="did you mean 'dimsum_table'"):
        get_grammar("dimsum_tabel")


def test_a_grammar_that_cannot_be_met_says_so() -> None:
    crowd = Surface([Group(*[Object("teacup", HERE)] * 5)], Region(0.05, 0.05), {"teacup": 0.07}, {"teacup": 0.07})
    grammar = Grammar("crowd", get_scene_type("dimsum_table"), [crowd])
    with pytest.raises(InvalidInputError, match=r"no room for 'teacup' beside 'teacup' \(\d+\)"):
        grammar.sample(np.random.default_rng(0))


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
    for _ in range(120):
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
    axis = np.zeros((1, 1, 2))
    assert upper_side(box((0.1, 0.1, 0.1), (0.2, 0.0, 0.0)), axis).item() == -math.inf
    assert upper_side(solid([(0.1, 0.0), (0.0, 0.3)], 12), axis).item() == pytest.approx(0.3)
    assert all(upper_side(wedge, axis).item() == -math.inf for wedge in ring([(0.1, 0), (0.2, 0), (0.2, 0.1)], 8))
