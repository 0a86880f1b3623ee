"""Projection: closed forms, invariants, and scenes that cannot be solved."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from scene_envs.assets import get_library
from scene_envs.grammars import get_grammar
from scene_envs.physics import penetration, project, projection
from scene_envs.physics import projection as planes
from scene_envs.physics.collision import TOUCHING
from scene_envs.physics.placement import Budget
from scene_envs.rotations import yaw_matrix
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE
from tests.helpers.simple_scenes import scene as boxes

TYPE = "dimsum_table"


TYPES = (
    "breakfast_table_low_clutter", "breakfast_table_high_clutter", "dimsum_table", "living_room_shelf", "pantry_shelf",
    "restaurant_low_clutter", "restaurant_high_clutter",
)  # fmt: skip
TIERS = torch.tensor([-0.3915, -0.1232, 0.1392, 0.4075])
"""Heights (m) of the shelf's boards."""


def scene_of(*objects: tuple[str, float, float, float], scene_type: str = TYPE) -> SceneBatch:
    """The table (or what else is welded) with upright, axis-aligned objects at (x, y, z) m."""
    batch = SceneBatch.empty(scene_type, 1, max(34, len(objects) + 1))
    translations, categories = batch.translations.clone(), batch.categories.clone()
    for slot, (name, *position) in enumerate(objects, start=1):
        translations[0, slot] = torch.tensor(position)
        categories[0, slot] = batch.scene_type.assets.index(name)
    rotations = yaw_matrix(torch.zeros(categories.shape))
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def jittered(batch: SceneBatch, scale: float) -> SceneBatch:
    """Gaussian noise of ``scale`` m along every axis."""
    noise = scale * torch.randn(batch.translations.shape, generator=torch.Generator().manual_seed(0))
    return batch.with_poses(batch.translations + noise * batch.is_free.unsqueeze(-1), batch.rotations)


def tiers(batch: SceneBatch) -> torch.Tensor:
    """(B, N): which board of the shelf each object is above."""
    return (batch.translations[..., 2, None] + 5e-3 >= TIERS).sum(dim=-1)


def heap(name: str, kind: str, asset: str | None = None) -> SceneBatch:
    """A scene of ``name`` at its largest count, all slots taken by degenerate placements.

    ``kind``: at one "point" of the workspace, "outside" (10 m away), coincident "pairs", a "nested" tower 10 mm apart,
    a "cube" of 5 cm, or "buried" in what is welded. Free assets at random, or all of them ``asset``.
    """
    rng = np.random.default_rng(0)
    batch = SceneBatch.empty(name, 1)
    scene_type = batch.scene_type
    names = [asset] if asset else [a for i, a in enumerate(scene_type.assets) if i not in scene_type.welded_categories]
    slots = torch.nonzero(batch.is_empty[0]).flatten().tolist()
    low, high = (np.array(corner) for corner in scene_type.workspace)
    center, count = (low + high) / 2, len(slots)
    places = {
        "point": lambda: np.tile(center, (count, 1)),
        "outside": lambda: np.tile(center + np.array([10.0, 0.0, 0.0]), (count, 1)),
        "pairs": lambda: np.repeat(rng.uniform(low, high, (count, 3)), 2, axis=0)[:count],
        "nested": lambda: center + np.arange(count)[:, None] * [0.0, 0.0, 0.01],
        "cube": lambda: center + rng.uniform(-0.025, 0.025, (count, 3)),
        "buried": lambda: rng.uniform([-0.1, -0.1, -0.15], [0.1, 0.1, -0.01], (count, 3)),
    }[kind]()
    translations, rotations, categories = batch.translations.clone(), batch.rotations.clone(), batch.categories.clone()
    translations[0, slots] = torch.from_numpy(places).float()
    chosen = np.repeat(rng.choice(names, count), 2)[:count] if kind == "pairs" else rng.choice(names, count)
    categories[0, slots] = torch.tensor([scene_type.assets.index(choice) for choice in chosen])
    turns = rng.uniform(0.0, 2.0 * np.pi, count) * (kind != "pairs")
    rotations[0, slots] = yaw_matrix(torch.from_numpy(turns).float())
    if kind == "buried" and "cafe_table" in scene_type.welded:
        categories[0, slots[0]], translations[0, slots[0]] = scene_type.assets.index("cafe_table"), torch.zeros(3)
        rotations[0, slots[0]] = torch.eye(3)
    return SceneBatch.from_parts(translations, rotations, categories, scene_type)


def check_result(batch: SceneBatch, *, again: bool) -> bool:
    """Finite, an honest residual, what is fixed in place, what was inside inside, and the same ``again`` if asked.

    Returns:
        Whether no overlap is left.
    """
    result = project(batch)
    assert result.valid.tolist() == [True]
    assert bool(result.batch.translations.isfinite().all())
    left = penetration(result.batch)
    if bool(left.valid):  # else a heap of too many parts to be measured one by one
        assert float(result.residual_depth[0]) == pytest.approx(float(left.depth.max()), abs=TOUCHING)
    else:
        assert not bool(result.converged)
    assert bool(result.converged[0]) == (float(result.residual_depth[0]) <= projection.TOLERANCE)
    fixed = ~batch.is_free
    assert torch.equal(result.batch.translations[fixed], batch.translations[fixed])
    torch.testing.assert_close(result.batch.rotations, batch.rotations, atol=1e-5, rtol=0)
    assert bool((result.batch.in_workspace | ~batch.in_workspace)[batch.is_free].all())
    if again:
        assert torch.equal(project(batch).batch.translations, result.batch.translations)
    return bool(result.converged[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"),
    [
        *((name, kind) for name in TYPES for kind in ("point", "outside")),
        *(("restaurant_high_clutter", kind) for kind in ("pairs", "nested", "cube")),
        *(("dimsum_table", kind) for kind in ("pairs", "buried")),
    ],
)
def test_heaps_come_back_finite_and_honest(name: str, kind: str) -> None:
    """At one point, inside or outside of the workspace, every type has room.

    The same again is asked of each kind of heap of one type; of ordinary scenes of every type it is elsewhere.
    """
    assert check_result(heap(name, kind), again=name == TYPE) or kind not in ("point", "outside")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "asset"),
    [
        ("breakfast_table_high_clutter", "bowl"),
        ("dimsum_table", "steamer_lid"),
        ("pantry_shelf", "fruit_bowl"),
        ("restaurant_high_clutter", "chair"),
    ],
)
def test_heaps_of_one_asset_come_back_finite_and_honest(name: str, asset: str) -> None:
    """Sixty fruit bowls have no room in the shelf; all others have."""
    assert check_result(heap(name, "point", asset), again=name == TYPE) == (name != "pantry_shelf")


@pytest.mark.slow
@pytest.mark.parametrize(("asset", "kinds"), [("fruit_bowl", ["pairs"]), ("pear_bosc", ["point", "pairs", "buried"])])
def test_the_work_on_a_scene_is_bounded(monkeypatch: pytest.MonkeyPatch, asset: str, kinds: list[str]) -> None:
    """The squared rows of all exact least-distance problems stay within the budget of all searches."""
    rows: list[int] = []
    exact = planes.nnls

    def counted(system: np.ndarray, target: np.ndarray, maxiter: int) -> tuple[np.ndarray, float]:
        rows.append(system.shape[1])
        return exact(system, target, maxiter=maxiter)  # type: ignore[no-any-return]

    monkeypatch.setattr(planes, "nnls", counted)
    for kind in kinds:
        rows.clear()
        project(heap("pantry_shelf", kind, asset))
        one_more = max(rows, default=0) ** 2
        assert sum(row**2 for row in rows) <= projection.SEARCHES * (25.0 * projection.WORK + one_more)


def test_the_rest_of_the_scene_stays_when_a_heap_is_spread() -> None:
    """Thirty cups at one point of the table are spread; four plates far from them do not move."""
    plates = [("dinner_plate", x, y, 0.0) for x in (-0.34, 0.34) for y in (-0.34, 0.34)]
    batch = scene_of(*[("teacup", 1e-5 * i, 0.0, 0.0) for i in range(29)], *plates)
    result = project(batch)
    assert bool(result.converged[0])
    assert float(result.moved[0, 30:].max()) < 1e-3


def test_a_tall_nest_of_bowls_is_no_heap() -> None:
    """Bowls that stand in each other without overlap stay, however many they are."""
    name = "breakfast_table_high_clutter"
    batch = scene_of(*[("bowl", 0.0, 0.0, 0.02 * i) for i in range(24)], scene_type=name)
    assert float(penetration(batch).depth.max()) < 1e-4
    assert float(project(batch).moved.max()) < 1e-3


def test_large_least_distance_problems_are_solved_closely() -> None:
    """A row of 300 unit moves, each at least 1 more than the one before it: the mean stays, as in closed form."""
    count = 300
    matrix = np.eye(count, count + 1, 1) - np.eye(count, count + 1)
    x = planes.least_distance(matrix, np.full(count, 1e-3), Budget(projection.WORK))
    assert len(x) == count + 1
    assert float(np.abs(x.mean())) < 1e-6
    near = np.random.default_rng(0).uniform(0.0, 1.0, count)
    pairs = np.kron(np.eye(count), [[-1.0, 1.0]])
    moved = planes.least_distance(pairs, near, Budget(projection.WORK)).reshape(count, 2)
    np.testing.assert_allclose(moved, near[:, None] * [-0.5, 0.5], atol=1e-4)


def test_the_least_distance_is_found_when_the_first_method_gives_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """x + y >= 1, x >= 0.8, y >= -1: the nearest point to the origin is (0.8, 0.2)."""
    matrix, needed = np.array([[1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]), np.array([1.0, 0.8, -1.0])
    expected = pytest.approx([0.8, 0.2], abs=1e-4)
    assert planes.least_distance(matrix, needed, Budget(projection.WORK)).tolist() == expected

    def gives_up(*_: object, **__: object) -> None:
        raise RuntimeError("Maximum number of iterations reached.")

    monkeypatch.setattr(planes, "nnls", gives_up)
    assert planes.least_distance(matrix, needed, Budget(projection.WORK)).tolist() == expected


def test_two_steamers_share_the_way_apart() -> None:
    """Equal and opposite moves, together the minimum translation of the hulls' Minkowski difference (scipy)."""
    batch = scene_of(("steamer_bottom", -0.11, 0.0, 0.0), ("steamer_bottom", 0.11, 0.0, 0.0))
    hull = batch.scene_type.library["steamer_bottom"].coarse[0].vertices
    difference = (hull[:, None] - (hull + np.array([0.22, 0.0, 0.0]))[None]).reshape(-1, 3)
    shortest = -ConvexHull(difference).equations[:, 3].max()  # from the origin to the nearest face
    result = project(batch)
    moves = (result.batch.translations - batch.translations)[0, 1:3]
    torch.testing.assert_close(moves[0], -moves[1], atol=1e-4, rtol=0)
    assert float(result.moved[0, 1:3].sum()) == pytest.approx(shortest, abs=2e-4)
    assert bool(result.converged[0])


def test_an_object_sunk_into_the_table_rises_onto_it() -> None:
    """The welded table does not move, the plate rises by what it was sunk."""
    result = project(scene_of(("dinner_plate", 0.1, 0.0, -0.005)))
    assert result.batch.translations[0, 0].tolist() == [0.0, 0.0, 0.0]
    assert result.batch.translations[0, 1].tolist() == pytest.approx([0.1, 0.0, 0.0], abs=1e-4)
    assert float(result.moved[0, 1]) == pytest.approx(0.005, abs=1e-4)


def test_scenes_without_overlap_stay_where_they_are() -> None:
    batch = get_grammar(TYPE).sample(np.random.default_rng(0), 5)
    result = project(batch)
    assert bool(result.converged.all())
    assert float(result.moved.max()) < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", TYPES)
def test_jittered_scenes_come_apart_and_keep_their_rotations(name: str) -> None:
    """Everything moved by 1 and 2 cm at random: no pair deeper than 0.1 mm is left, nothing leaves the workspace."""
    clean = get_grammar(name).sample(np.random.default_rng(1), 2)
    batch = SceneBatch.concatenate([jittered(clean, 0.01), jittered(clean, 0.02)])
    assert float(penetration(batch).depth.max()) > 5e-3
    result = project(batch)
    assert bool(result.converged.all())
    assert float(penetration(result.batch).depth.max()) <= 1e-4
    assert bool((result.batch.in_workspace | ~batch.is_free).all())
    torch.testing.assert_close(result.batch.rotations, batch.rotations, atol=1e-5, rtol=0)
    assert torch.equal(result.batch.categories, batch.categories)
    assert torch.equal(result.batch.translations[batch.is_welded], batch.translations[batch.is_welded])


@pytest.mark.slow
def test_objects_stay_between_the_boards_where_they_were() -> None:
    """A packed pantry moved by 1 cm: out of boards and walls, and each on the board it stood on."""
    batch = get_grammar("pantry_shelf").sample(np.random.default_rng(2), 8)
    batch = batch[batch.counts.argsort(descending=True)[:3].tolist()]
    assert int(batch.counts.min()) >= 30
    noisy = jittered(batch, 0.01)
    result = project(noisy)
    assert bool(result.converged.all())
    assert torch.equal(tiers(result.batch)[batch.is_free], tiers(batch)[batch.is_free])


def test_nested_objects_come_apart() -> None:
    """Three plates at one place end above or beside each other."""
    result = project(scene_of(*[("dinner_plate", 0.0, 0.0, 0.001 * i) for i in range(3)]))
    assert bool(result.converged[0])
    assert float(penetration(result.batch).depth.max()) <= 1e-4


@pytest.mark.parametrize("offset", [0.113, 0.115, 0.117])
def test_a_rim_that_is_straddled_is_left_on_one_side(offset: float) -> None:
    """A cup whose body lies across a steamer's thin wall ends wholly on one side of it, by the shorter way."""
    result = project(scene_of(("steamer_bottom", 0.0, 0.0, 0.0), ("teacup", offset, 0.0, 0.03)))
    assert bool(result.converged[0])
    assert float(penetration(result.batch).depth.max()) <= 1e-4
    assert float(result.moved[0].norm()) < 0.05  # apart half and half: the cup is 85 mm wide


def test_nested_bowls_stay_nested() -> None:
    """A bowl 4 mm too deep in another rises, rather than leaving it sideways; the outer one is on the table."""
    batch = scene_of(("bowl", 0.0, 0.0, 0.0), ("bowl", 0.0, 0.0, 0.012), scene_type="breakfast_table_high_clutter")
    assert float(penetration(batch).depth.max()) > 1e-3
    result = project(batch)
    assert bool(result.converged[0])
    assert float(penetration(result.batch).depth.max()) <= 1e-4
    offset = result.batch.translations[0, 2] - result.batch.translations[0, 1]
    assert float(offset[:2].norm()) < 0.01
    assert 0.012 < float(offset[2]) < 0.06  # lower than one on top of the other (65 mm)
    assert float(result.batch.translations[0, 1, 2]) == pytest.approx(0.0, abs=1e-4)


def test_fruit_pushed_through_the_wall_of_its_bowl_stays_in_the_bowl() -> None:
    batch = scene_of(("fruit_bowl", 0.0, 0.0, 0.4075), ("apple_gala", 0.062, 0.0, 0.4175), scene_type="pantry_shelf")
    assert float(penetration(batch).depth.max()) > 1e-3
    result = project(batch)
    assert bool(result.converged[0])
    moved = result.batch.translations[0, 2] - result.batch.translations[0, 1]
    assert float(moved[:2].norm()) < 0.07
    assert float(result.moved[0].norm()) < 0.03


@pytest.mark.slow
def test_more_volume_than_room_gives_the_best_effort_and_says_so() -> None:
    """Forty board games of 0.5 m x 0.25 m x 55 mm; the shelf holds four on each of three boards and some on top."""
    generator = np.random.default_rng(0)
    games = [("board_game_xl", *generator.normal(0.0, [0.01, 0.01, 0.2])) for _ in range(40)]
    rotated = scene_of(*games, scene_type="living_room_shelf")
    quarter = yaw_matrix(torch.full(rotated.categories.shape, np.pi / 2))
    shelf_first = torch.where(rotated.is_free[..., None, None], quarter, rotated.rotations)
    batch = rotated.with_poses(rotated.translations, shelf_first)
    result = project(batch)
    assert result.valid.tolist() == [True]
    assert result.converged.tolist() == [False]
    before, after = penetration(batch), penetration(result.batch)
    assert float(result.residual_depth[0]) == pytest.approx(float(after.depth.max()), abs=1e-5)
    assert float(after.total_per_pair) < 0.5 * float(before.total_per_pair)


def test_what_is_sunk_into_a_corner_comes_out_of_both() -> None:
    """Through a side wall and into the board: the shortest way is the diagonal, 10 mm up and 20 mm inward."""
    wall = 0.284  # inner face of the side, m
    case = get_library(("game_case",))["game_case"].bounds
    batch = scene_of(("game_case", 0.0, wall - case[1, 1] + 0.02, -0.1232 - 0.01), scene_type="living_room_shelf")
    result = project(batch)
    expected = [0.0, wall - case[1, 1], -0.1232]
    assert result.batch.translations[0, 1].tolist() == pytest.approx(expected, abs=1e-4)


def test_nothing_in_the_scene_is_nothing_to_do() -> None:
    batch = SceneBatch.empty(TYPE, 2)
    bare = SceneBatch.from_parts(
        batch.translations, batch.rotations, torch.full(batch.categories.shape, 7), batch.scene_type
    )
    for empty in (batch, bare):
        assert project(empty).converged.tolist() == [True, True]


def test_objects_just_outside_the_workspace_come_back_and_those_far_away_stay() -> None:
    result = project(scene_of(("teacup", 0.51, 0.0, 0.1), ("teacup", 0.0, 0.8, 0.1)))
    assert result.batch.translations[0, 1, 0] == pytest.approx(0.49, abs=1e-4)
    assert result.batch.translations[0, 2, 1] == pytest.approx(0.8)


def test_the_way_is_as_short_as_a_general_solver_finds() -> None:
    """Three boxes in a row, overlapping by 20 and 10 mm: the least squares have a closed form.

    Moves a, b, c along the row with b - a = 20 and c - b = 10 mm, least a^2 + b^2 + c^2: -50/3, 10/3, 40/3 mm.
    """
    offsets = np.cumsum([-0.2, SIDE - 0.02, SIDE - 0.01])
    result = project(boxes(*[("cube", 0.0, float(y), 0.5) for y in offsets]))
    expected = offsets + np.array([-50.0, 10.0, 40.0]) / 3000.0
    assert result.batch.translations[0, 1:4, 1].tolist() == pytest.approx(expected.tolist(), abs=1e-4)
    assert float(result.batch.translations[0, 1:4, [0, 2]].sub(torch.tensor([0.0, 0.5])).abs().max()) < 1e-6


def test_one_object_in_the_air_is_not_touched() -> None:
    result = project(scene_of(("teapot", 0.0, 0.0, 0.3), ("teacup", 0.2, 0.2, 0.0)))
    assert float(result.moved.max()) == 0.0
