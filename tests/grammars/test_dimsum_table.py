"""Dimsum Table: what every scene obeys, and how many objects there are."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from scene_envs.grammars import get_grammar
from scene_envs.grammars.dimsum_table import FOOTPRINT, KEEP_OUT, STEP
from scene_envs.scene_types import get_scene_type
from tests.helpers.drawn_scenes import check_reproducible

SCENE_TYPE = get_scene_type("dimsum_table")
NAMES = np.array([*SCENE_TYPE.assets, ""])


@pytest.fixture(scope="module")
def scenes() -> NDArray[np.float32]:
    return get_grammar("dimsum_table").sample_array(np.random.default_rng(1), 200)


def _present(scene: NDArray[np.float32]) -> tuple[NDArray[np.str_], NDArray[np.float32], NDArray[np.float32]]:
    """Names (n,), translations (n, 3) and rotations (n, 3, 3) of one scene's objects."""
    rows = scene[scene[:, -1] == 0]
    return NAMES[rows[:, 12:].argmax(axis=1)], rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3)


def test_table_is_slot_0_at_the_origin_and_empty_slots_come_last(scenes: NDArray[np.float32]) -> None:
    assert (scenes[:, 0, 12 + SCENE_TYPE.assets.index("cafe_table")] == 1).all()
    assert (scenes[:, 0, :12] == np.r_[0, 0, 0, np.eye(3).ravel()]).all()
    empty = scenes[..., -1] == 1
    assert (np.diff(empty.astype(int), axis=1) >= 0).all()
    assert (scenes[empty][:, :-1] == 0).all()


def test_every_slot_is_one_hot_and_every_rotation_is_an_exact_yaw(scenes: NDArray[np.float32]) -> None:
    assert (scenes[..., 12:].sum(axis=-1) == 1).all()
    assert np.isin(scenes[..., 12:], (0, 1)).all()
    rotations = scenes[scenes[..., -1] == 0][:, 3:12].reshape(-1, 3, 3)
    assert (rotations[:, [0, 1, 2, 2], [2, 2, 0, 1]] == 0).all()
    assert (rotations[:, 2, 2] == 1).all()
    identity = rotations @ rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-6)


def test_structure_conditions_hold_in_every_scene(scenes: NDArray[np.float32]) -> None:
    for scene in scenes:
        names, positions, _ = _present(scene)
        on_table = positions[:, 2] == 0
        steamers = np.isin(names, ("steamer_bottom", "steamer_lid"))
        bases = positions[on_table & (names == "steamer_bottom")]
        assert 3 <= len(bases) <= 4
        heights = [(np.abs(positions[steamers, :2] - base[:2]).max(axis=1) == 0).sum() for base in bases]
        assert max(heights) >= 4
        assert sum(heights) == steamers.sum()  # every steamer and lid belongs to a stack
        assert (names == "dinner_plate").sum() <= 4
        assert (names == "teacup").sum() <= 4
        assert (names == "teapot").sum() <= 2
        assert (names == "serving_dish").sum() <= 2


def test_heights_are_exactly_zero_or_levels_of_a_stack(scenes: NDArray[np.float32]) -> None:
    heights = scenes[..., 2][scenes[..., -1] == 0]
    levels = (np.arange(11) * STEP).astype(np.float32)
    assert np.isin(heights, levels).all()


def test_a_lid_ends_its_stack(scenes: NDArray[np.float32]) -> None:
    for scene in scenes:
        names, positions, _ = _present(scene)
        for lid in positions[names == "steamer_lid"]:
            column = positions[(positions[:, :2] == lid[:2]).all(axis=1)]
            assert column[:, 2].max() == lid[2]
            assert lid[2] > 0


def test_objects_stay_on_the_table_and_out_of_each_others_circles(scenes: NDArray[np.float32]) -> None:
    for scene in scenes:
        names, positions, _ = _present(scene)
        standing = (positions[:, 2] == 0) & (names != "cafe_table")
        points, radii = positions[standing, :2].astype(float), np.array([KEEP_OUT[n] for n in names[standing]])
        assert np.abs(points).max() <= 0.475 + 1e-6
        rims = np.hypot(*points.T) + np.array([FOOTPRINT[n] for n in names[standing]])
        assert rims.max() <= 0.625 + 1e-6
        distance = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) + 10 * np.eye(len(points))
        assert (distance - radii[:, None] - radii[None]).min() >= -1e-6


def test_assets_fit_in_their_circles() -> None:
    for asset in SCENE_TYPE.library:
        if asset.name in KEEP_OUT:
            vertices = np.concatenate([part.vertices for part in asset.fine])
            reach = np.hypot(vertices[:, 0], vertices[:, 1]).max()
            assert reach <= KEEP_OUT[asset.name] + 1e-9, asset.name
            assert reach <= FOOTPRINT[asset.name] + 1e-3, asset.name


def test_counts_follow_the_published_statistics(scenes: NDArray[np.float32]) -> None:
    counts = (scenes[..., -1] == 0).sum(axis=1)
    # 200 scenes: the standard error of the mean is 0.24, so 5 % of 18.14 (0.9) is nearly four of them.
    assert counts.mean() == pytest.approx(18.14, rel=0.05)
    assert counts.min() >= 7
    assert counts.max() <= 34


def test_the_same_seed_gives_the_same_scenes_and_another_gives_others() -> None:
    check_reproducible("dimsum_table")


def test_sample_is_a_batch_of_the_scene_type() -> None:
    batch = get_grammar("dimsum_table").sample(np.random.default_rng(0), 3)
    assert batch.tensor.shape == (3, 34, 20)
    assert batch.scene_type is SCENE_TYPE
    assert bool((batch.in_workspace | batch.is_empty).all())
