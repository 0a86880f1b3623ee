"""MuJoCo Warp on the CPU device: overlaps and motion with closed forms, and independence of slots and batches."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from scene_envs.errors import InvalidInputError
from scene_envs.physics import penetration
from scene_envs.physics.parts import GRAVITY
from scene_envs.scene import SceneBatch
from tests.helpers.simple_scenes import SIDE, TYPE, scene, turned

pytest.importorskip("mujoco_warp")
from scene_envs.physics.warp import TIMESTEP, Overlaps, WarpEngine, warp_engine


@pytest.fixture(scope="module")
def engine() -> WarpEngine:
    return warp_engine(TYPE, "cpu")


def listed(overlaps: Overlaps) -> dict[tuple[int, int, int], float]:
    """Depth (m) by scene and slots."""
    keys = zip(overlaps.scene.tolist(), overlaps.first.tolist(), overlaps.second.tolist(), strict=True)
    return dict(zip(keys, overlaps.depth.tolist(), strict=True))


def heap(seed: int) -> SceneBatch:
    """Eight objects that overlap, at random poses above the floor."""
    rng = np.random.default_rng(seed)
    names = ("cube", "bowl", "post", "cube", "bowl", "cube", "post", "bowl")
    batch = scene(*((name, *rng.uniform((-0.15, -0.15, 0.0), (0.15, 0.15, 0.25))) for name in names))
    for slot, turn in enumerate(Rotation.random(len(names), random_state=seed).as_matrix(), start=1):
        batch = turned(batch, slot, turn)
    return batch


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_box_sunk_into_another_has_that_depth_along_that_axis(engine: WarpEngine, axis: int) -> None:
    place = [0.0, 0.0, 0.5]
    place[axis] += SIDE - 0.002
    found = engine.overlaps(scene(("cube", 0.0, 0.0, 0.5), ("cube", *place)))
    assert listed(found) == {(0, 1, 2): pytest.approx(0.002, abs=1e-6)}
    assert found.normal[0, axis] == pytest.approx(1.0, abs=1e-6)
    assert found.valid.tolist() == [True]


def test_depths_are_those_of_penetration(engine: WarpEngine) -> None:
    batch = SceneBatch.concatenate([heap(seed) for seed in range(4)])
    expected = penetration(batch)
    pairs = {(row, *pair.slots): pair.depth for row, pairs in enumerate(expected.pairs) for pair in pairs}
    assert len(pairs) > 20
    assert listed(engine.overlaps(batch)) == pytest.approx(pairs, abs=1e-5)


def test_overlaps_do_not_depend_on_slots_or_on_other_scenes(engine: WarpEngine) -> None:
    batch = SceneBatch.concatenate([heap(0), heap(1)])
    order = torch.randperm(batch.tensor.shape[1], generator=torch.Generator().manual_seed(0))
    mixed = engine.overlaps(SceneBatch(batch.tensor.flip(0)[:, order], TYPE))
    keys = [
        (1 - row, *sorted((int(order[a]), int(order[b]))))
        for row, a, b in zip(mixed.scene.tolist(), mixed.first.tolist(), mixed.second.tolist(), strict=True)
    ]
    assert dict(zip(keys, mixed.depth.tolist(), strict=True)) == listed(engine.overlaps(batch))


def test_objects_at_one_point_overlap_and_others_do_not(engine: WarpEngine) -> None:
    point = engine.overlaps(scene(*[("cube", 0.0, 0.0, 0.5)] * 4))
    assert listed(point) == {(0, a, b): pytest.approx(SIDE, abs=1e-6) for a in range(1, 5) for b in range(a + 1, 5)}
    assert listed(engine.overlaps(scene(("cube", 10.0, 0.0, 0.5), ("bowl", 0.0, 0.0, 0.5)))) == {}
    assert listed(engine.overlaps(scene(("bowl", 0.0, 0.0, 0.5), ("post", 0.0, 0.0, 0.52)))) == {}


def test_a_scene_with_a_pose_that_is_no_number_is_invalid_and_others_are_not(engine: WarpEngine) -> None:
    batch = SceneBatch.concatenate([scene(("cube", 0.0, 0.0, 0.0))] * 2)
    batch.tensor[0, 1, 0] = torch.nan
    assert engine.overlaps(batch).valid.tolist() == [False, True]
    translations, _, valid = engine.simulate(batch, 0.01)
    assert valid.tolist() == [False, True]
    assert translations[1].isfinite().all()


def test_objects_fall_as_bodies_fall_and_rest_where_they_stand(engine: WarpEngine) -> None:
    batch = scene(("cube", 0.0, 0.0, 0.5), ("cube", 0.5, 0.0, 0.0), ("bowl", -0.5, 0.0, 1.0))
    turn = Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix()
    translations, rotations, valid = engine.simulate(turned(batch, 3, turn), 0.1)
    moved = translations - batch.translations
    steps = round(0.1 / TIMESTEP)
    fallen = -GRAVITY * TIMESTEP**2 * steps * (steps + 1) / 2  # semi-implicit: 0.5 g t^2 (1 + 1 / steps)
    assert valid.tolist() == [True]
    assert moved[0, 1].tolist() == pytest.approx([0.0, 0.0, fallen], abs=2e-6)
    assert moved[0, 3].tolist() == pytest.approx([0.0, 0.0, fallen], abs=2e-6)
    assert moved[0, 2].abs().max() < 5e-6
    assert moved[0, 0].abs().max() == 0.0
    assert rotations[0, 3].numpy() == pytest.approx(turn, abs=1e-5)
    assert rotations[0, 2].numpy() == pytest.approx(np.eye(3), abs=1e-5)


def test_motion_does_not_depend_on_slots_and_stacks_stand(engine: WarpEngine) -> None:
    batch = scene(("cube", 0.0, 0.0, 0.0), ("post", 0.02, 0.0, SIDE), ("bowl", 0.5, 0.0, 0.001))
    order = torch.tensor([2, 0, 4, 3, 1, *range(5, batch.tensor.shape[1])])
    one, turn, _ = engine.simulate(batch, 0.05)
    two, other, _ = engine.simulate(SceneBatch(batch.tensor[:, order], TYPE), 0.05)
    assert torch.equal(one[:, order], two)
    assert torch.equal(turn[:, order], other)
    assert (one - batch.translations)[0, :3].abs().max() < 1e-5


def test_scenes_without_objects_are_answered(engine: WarpEngine) -> None:
    batch = SceneBatch.empty(TYPE, 2)
    assert listed(engine.overlaps(batch)) == {}
    translations, rotations, valid = engine.simulate(batch, 0.01)
    assert torch.equal(translations, batch.translations)
    assert torch.equal(rotations, batch.rotations)
    assert valid.tolist() == [True, True]
    assert engine.overlaps(batch[[]]).valid.shape == (0,)
    assert engine.simulate(batch[[]], 0.01)[0].shape == (0, *batch.translations.shape[1:])


def test_wrong_arguments_are_named(engine: WarpEngine) -> None:
    batch = SceneBatch.empty(TYPE, 1)
    with pytest.raises(InvalidInputError, match="duration=0"):
        engine.simulate(batch, 0)
    if not torch.cuda.is_available():
        with pytest.raises(InvalidInputError, match="'cuda'"):
            warp_engine(TYPE, "cuda")
