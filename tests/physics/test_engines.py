"""Engines by name: closed forms, the same bits in any order and company, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from scene_envs.errors import InvalidInputError, MissingDependencyError
from scene_envs.grammars import get_grammar
from scene_envs.physics import (
    PhysicsPool,
    equilibrium,
    feasibility,
    make_pool,
    make_ready,
    motion,
    penetration,
    project,
    settle,
)
from scene_envs.physics import engines as engines_module
from scene_envs.physics.engines import LOOK, Course, Moved, engine_name
from scene_envs.physics.motion import Physics, physics_of
from scene_envs.physics.placement import Budget, flatten
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE, scene, turned

engines = pytest.mark.parametrize("engine", ["bullet", "mujoco"])
UNITS = 1e6
"""Work that no simulation of these tests takes."""


def simulated(batch: SceneBatch, engine: str, duration: float, tilt: tuple[float, float] = (0.0, 0.0)) -> Moved:
    """All objects of one scene as a single cluster, whatever closed forms say: moves (n, 3) of the objects, m."""
    physics = physics_of(batch.scene_type, engine)
    categories, welded = batch.categories.numpy(), batch.is_welded.numpy()
    objects = flatten(
        physics.library, batch.translations.double().numpy(), batch.rotations.double().numpy(), categories, welded
    )
    nothing = np.zeros(len(objects), dtype=bool)
    moved = physics.engine.simulate(objects, nothing, nothing.astype(np.int64), duration, Course(Budget(UNITS), tilt))
    assert np.array_equal(moved.translation[objects.fixed], objects.translation[objects.fixed])
    return Moved(moved.rotation, moved.translation - objects.translation, moved.angle)


def noisy(name: str, count: int, seed: int, scale: float = 0.002) -> SceneBatch:
    clean = get_grammar(name).sample(np.random.default_rng(seed), count)
    noise = scale * torch.randn(clean.translations.shape, generator=torch.Generator().manual_seed(seed))
    return clean.with_poses(clean.translations + noise * clean.is_free.unsqueeze(-1), clean.rotations)


# -- closed forms -----------------------------------------------------------------------------------


@engines
def test_free_fall(engine: str) -> None:
    """0.1 s: half of g t squared is 49 mm, plus half a step's worth of speed."""
    moved = simulated(scene(("cube", 0.0, 0.0, 1.0), ("post", 0.5, 0.0, 1.5)), engine, 0.1)
    assert moved.translation[1:, 2] == pytest.approx([-0.5 * 9.81 * 0.01] * 2, rel=0.022)
    assert np.abs(moved.translation[1:, :2]).max() < 1e-9
    assert moved.angle.max() < 1e-9


@engines
def test_the_closed_form_of_falls_is_that_of_the_simulation(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Alone, as a stack that keeps its gap, and onto an object at rest, which is simulated with the falling one."""
    batch = SceneBatch.concatenate([
        scene(("cube", 0.0, 0.0, 1.0)),
        scene(("cube", 0.0, 0.0, 1.0), ("post", 0.01, 0.0, 1.0 + SIDE + 5e-4), yaw=0.2),
        scene(("cube", 0.0, 0.0, 0.0), ("post", 0.03, 0.0, SIDE + 0.02)),
    ])  # fmt: skip
    quick = equilibrium(batch, physics=engine)
    way, work = physics_of(batch.scene_type, engine).engine.fall(0.1)
    assert way == pytest.approx(0.5 * 9.81 * 0.01 * (1 + 1 / work), rel=1e-9)
    assert quick.displacement[:2][batch[:2].is_free].tolist() == pytest.approx([way] * 3, rel=1e-6)
    assert 0.019 < float(quick.displacement[2, 2]) < 0.03
    monkeypatch.setattr(motion, "_falls", lambda _, objects, *rest: np.zeros((2, len(objects)), dtype=bool))
    slow = equilibrium(batch, physics=engine)
    torch.testing.assert_close(quick.displacement, slow.displacement, atol=1e-6, rtol=0)
    torch.testing.assert_close(quick.rotation, slow.rotation, atol=1e-6, rtol=0)


@engines
def test_what_stands_stays(engine: str) -> None:
    moved = simulated(scene(("cube", 0.2, 0.1, 0.0), ("bowl", -0.3, 0.0, 0.0), yaw=0.3), engine, 0.5)
    assert np.linalg.norm(moved.translation, axis=1).max() < 5e-5
    assert moved.angle.max() < 1e-3


@engines
def test_a_box_half_a_millimetre_in_the_floor_comes_up(engine: str) -> None:
    moved = simulated(scene(("cube", 0.0, 0.0, -0.0005)), engine, 0.5)
    assert moved.translation[1, 2] == pytest.approx(0.0005, abs=1e-4)


@engines
def test_a_leaning_post_falls(engine: str) -> None:
    """Its centre is 10 cm up and its foot 2 cm wide: beyond 0.1 rad it falls over."""
    lean = Rotation.from_euler("y", 0.2).as_matrix()
    post = turned(scene(("post", 0.0, 0.0, 0.002)), 1, lean)
    assert simulated(post, engine, 1.0).angle[1] > 1.0
    result = feasibility(post, physics=engine)
    assert result.valid.tolist() == [True]
    assert not bool(result.feasible.any())


@engines
@pytest.mark.parametrize(("angle", "slides"), [(0.45, False), (0.62, True)])
def test_the_cone_of_friction(engine: str, angle: float, slides: bool) -> None:
    """The coefficient is 0.6: a box slides where the tangent of the slope is larger, with the rest of the pull."""
    way = simulated(scene(("bowl", 0.0, 0.0, 0.0)), engine, 0.3, tilt=(angle, 0.0)).translation[1, 0]
    expected = 0.5 * 9.81 * (np.sin(angle) - 0.6 * np.cos(angle)) * 0.3**2
    if slides:
        assert way == pytest.approx(expected, rel=0.25)
    else:
        assert expected < 0
        assert abs(way) < 2e-3


# -- same bits --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def batch() -> SceneBatch:
    """Scenes of which some objects are simulated."""
    return noisy("dimsum_table", 3, 3, scale=0.004)


@engines
def test_same_bits_in_any_order_company_and_process(engine: str, batch: SceneBatch) -> None:
    first, settled = feasibility(batch, physics=engine), settle(batch[:2], duration=0.25, physics=engine)
    assert bool((first.displacement > 1e-4).any())
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    feasibility(noisy("breakfast_table_low_clutter", 1, 0), physics=engine)  # another history
    backward = feasibility(SceneBatch(batch.tensor.flip(0)[:, order], batch.scene_type), physics=engine)
    with PhysicsPool(workers=1, physics=engine) as pool:
        there = feasibility(batch, pool=pool)
        assert torch.equal(settle(batch[:2], duration=0.25, pool=pool).batch.tensor, settled.batch.tensor)
    alone = feasibility(batch[2], physics=engine)
    for name in ("feasible", "displacement", "rotation", "depth"):
        values = getattr(first, name)
        assert torch.equal(getattr(backward, name).flip(0), values[:, order]), name
        assert torch.equal(getattr(there, name), values), name
        assert torch.equal(getattr(alone, name)[0], values[2]), name


@pytest.mark.parametrize("name", ["dimsum_table", "pantry_shelf"])
def test_engines_agree_on_scenes_of_grammars(name: str) -> None:
    """With half a millimetre of noise, which leaves some objects in each other and others in the air."""
    scenes = noisy(name, 5, 5, scale=0.0005)
    one, other = (feasibility(scenes, physics=engine) for engine in ("bullet", "mujoco"))
    assert torch.equal(one.depth, other.depth)
    assert torch.equal(one.feasible, other.feasible)
    assert 0 < int(one.counts.sum()) < int(scenes.is_free.sum())


# -- names ------------------------------------------------------------------------------------------


def test_an_unknown_name_is_refused_with_the_names_there_are() -> None:
    batch = scene(("cube", 0.0, 0.0, 0.0))
    told = "physics='havok' is no engine; give one of auto, bullet, mujoco, warp"
    for call in (feasibility, equilibrium, penetration, settle, project, make_ready):
        with pytest.raises(InvalidInputError, match=told):
            call(batch, physics="havok")
    with pytest.raises(InvalidInputError, match=told):
        make_pool(0, physics="havok")


def test_a_pool_of_another_engine_is_refused() -> None:
    batch = scene(("cube", 0.0, 0.0, 0.0))
    with PhysicsPool(workers=0, physics="mujoco") as pool:
        assert feasibility(batch, pool=pool, physics="mujoco").counts.tolist() == [1]
        assert feasibility(batch, pool=pool).counts.tolist() == [1]
        with pytest.raises(InvalidInputError, match="physics='bullet', but the pool computes with 'mujoco'"):
            feasibility(batch, pool=pool, physics="bullet")


@pytest.fixture
def without_bullet(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As where PyBullet is not installed."""
    installed = engines_module.is_installed
    monkeypatch.setattr(engines_module, "is_installed", lambda name: name != "bullet" and installed(name))
    engines_module._automatic.cache_clear()
    yield
    engines_module._automatic.cache_clear()


@pytest.mark.usefixtures("without_bullet")
def test_an_engine_that_is_not_installed_is_named_with_the_cure() -> None:
    batch = scene(("cube", 0.0, 0.0, 0.0))
    with pytest.raises(MissingDependencyError, match=r"physics=bullet needs pybullet.*pip install.*physics=.mujoco"):
        settle(batch, physics="bullet")
    with pytest.raises(MissingDependencyError, match="physics=bullet"):
        PhysicsPool(workers=0, physics="bullet")


@pytest.mark.usefixtures("without_bullet")
def test_auto_takes_mujoco_where_pybullet_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "scene_envs.physics.bullet.BodyPool.__init__", lambda *_: pytest.fail("PyBullet is asked all the same")
    )
    assert engine_name("auto") == "mujoco"
    batch = scene(("cube", 0.0, 0.0, 0.01), ("cube", 0.06, 0.0, SIDE + 0.012), ("post", 0.4, 0.0, -0.003))
    assert feasibility(batch).counts.tolist() == [0]
    assert bool(equilibrium(batch).valid)
    after = settle(batch)
    assert bool(after.finished)
    assert float(after.batch.translations[0, 1, 2]) == pytest.approx(0.0, abs=1e-4)
    assert bool(project(batch).converged)
    ready = make_ready(batch)
    assert bool(ready.finished)
    assert int(ready.counts) == 3
    assert feasibility(ready.batch).counts.tolist() == [3]


# -- degenerate scenes ------------------------------------------------------------------------------


def heap(kind: str) -> SceneBatch:
    """Eight boxes, bowls and posts at degenerate places."""
    rows = np.arange(8)
    places = {
        "at one point": np.repeat([[0.0, 0.0, 0.5]], 8, axis=0),
        "coincident": np.repeat(np.stack([0.3 * rows[:4] - 0.8, 0 * rows[:4], 0 * rows[:4]], axis=1), 2, axis=0),
        "nested": rows[:, None] * [0.0, 0.0, 0.005],
        "far outside": rows[:, None] * [0.2, 0.0, 0.0] + [10.0, -10.0, 10.0],
    }[kind]
    names = np.array(["cube", "bowl", "post"])[rows // 2 % 3]
    return scene(*[(str(name), *map(float, place)) for name, place in zip(names, places, strict=True)])


@engines
@pytest.mark.parametrize("kind", ["at one point", "coincident", "nested", "far outside"])
def test_degenerate_scenes_have_an_answer_or_are_invalid(engine: str, kind: str) -> None:
    batch = heap(kind)
    judged = feasibility(batch, physics=engine)
    assert bool(torch.isfinite(judged.displacement).all())
    assert int(judged.counts) == 0
    for result in (settle(batch, duration=0.25, physics=engine), make_ready(batch, duration=0.25, physics=engine)):
        assert bool(torch.isfinite(result.batch.tensor).all())
        assert not bool((result.finished & ~result.valid).any())
    assert bool(torch.isfinite(equilibrium(batch, physics=engine).displacement).all())


def test_many_contacts_in_mujoco_are_more_work() -> None:
    """Nine cubes in a row are nine units a step; nine of bowls in each other have hundreds of contacts."""

    def work(*objects: tuple[str, float, float, float]) -> float:
        batch = scene(*objects)
        physics = physics_of(batch.scene_type, "mujoco")
        poses = batch.translations.double().numpy(), batch.rotations.double().numpy()
        among = flatten(physics.library, *poses, batch.categories.numpy(), batch.is_welded.numpy())
        fine, course = np.ones(len(among), dtype=bool), Course(Budget(1.0))
        physics.engine.simulate(among, fine, np.zeros(len(among), dtype=np.int64), 1.0, course)
        return course.budget.spent

    assert work(*[("cube", 0.2 * index, 0.0, 1.0) for index in range(9)]) == 9 * LOOK
    assert work(*[("bowl", 0.001 * index, 0.0, 1.0) for index in range(9)]) > 2 * 9 * LOOK


@engines
def test_a_pose_that_is_not_finite_is_refused_by_name(engine: str) -> None:
    batch = heap("nested")
    batch.tensor[0, 5, 0] = float("nan")
    for call in (feasibility, equilibrium, settle, project, make_ready):
        with pytest.raises(InvalidInputError, match="scene 0, slot 5 holds a pose that is not finite"):
            call(batch, physics=engine)


# -- memory -----------------------------------------------------------------------------------------


@engines
def test_what_was_simulated_before_changes_neither_poses_nor_work(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A remembered simulation spends the units it took; where they do not suffice, it is cut as the first one was."""
    batch = turned(scene(("post", 0.0, 0.0, 0.01)), 1, Rotation.from_euler("x", 0.5).as_matrix())
    categories, welded = batch.categories.numpy(), batch.is_welded.numpy()
    poses = batch.translations.double().numpy(), batch.rotations.double().numpy()
    physics = Physics(physics_of(batch.scene_type, engine).library, engine)
    objects = flatten(physics.library, *poses, categories, welded)
    nothing = np.zeros(len(objects), dtype=bool)

    def fall(units: float) -> tuple[Moved, float, bool]:
        course = Course(Budget(units))
        moved = physics.simulate(objects, nothing, nothing.astype(np.int64), 0.4, course)
        return moved, course.budget.spent, course.budget.is_spent

    monkeypatch.setattr(motion, "_KNOWN", 8)
    cut = fall(30.0)
    first, again, cut_again = fall(UNITS), fall(UNITS), fall(30.0)
    assert again[0] is first[0]
    assert again[1:] == first[1:] == (first[1], False)
    assert cut[1:] == cut_again[1:] == (cut[1], True)
    assert np.array_equal(cut[0].translation, cut_again[0].translation)
    assert not np.array_equal(cut[0].translation, first[0].translation)
