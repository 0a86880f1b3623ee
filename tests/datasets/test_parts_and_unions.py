"""Disjoint parts of datasets, and unions of scene types."""

from __future__ import annotations

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_envs.datasets import SceneDataset, to_union
from scene_envs.datasets.dataset import Part, union_normalizer
from scene_envs.errors import InvalidInputError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, union_scene_type
from tests.helpers.toy_grammars import TYPE, cup_row, toy_scenes


def _dataset(count: int, seed: int = 0) -> SceneDataset:
    tensor = toy_scenes(count, seed).tensor
    return SceneDataset(tensor, [f"{seed}/{row}" for row in range(count)], Normalizer.fit(tensor), TYPE)


def _dimsum(count: int) -> SceneDataset:
    batch = SceneBatch.empty("dimsum_table", count)
    tensor = batch.tensor.clone()
    tensor[:, 1, :13] = torch.cat([torch.tensor([0, 0, 0.5, 1, 0, 0, 0, 1, 0, 0, 0, 1]), torch.zeros(1)])
    tensor[:, 1, 0] = torch.arange(count) / 1000
    tensor[:, 1, -1], tensor[:, 1, 12 + batch.scene_type.assets.index("teacup")] = 0.0, 1.0
    return SceneDataset(tensor, [f"dimsum/{row}" for row in range(count)], Normalizer.fit(tensor), batch.scene_type)


# -- parts ------------------------------------------------------------------------------------------


def test_parts_are_disjoint_cover_all_and_have_the_sizes_asked_for_on_average() -> None:
    dataset = _dataset(2000)
    parts = dataset.stable_split((0.8, 0.1, 0.1), seed=3)
    names = [set(part.prompts) for part in parts]
    assert sum(map(len, names)) == len(set.union(*names)) == 2000
    expected = np.array([1600, 200, 200])
    deviation = np.abs([len(name) for name in names] - expected)
    assert (deviation <= 4 * np.sqrt(2000 * np.array([0.16, 0.09, 0.09]))).all()


def test_a_scene_keeps_its_part_when_the_dataset_grows_or_is_shuffled() -> None:
    dataset = _dataset(300)
    small = set(dataset[:100].stable_split((0.7, 0.3))[1].prompts)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    large = set(dataset[order].stable_split((0.7, 0.3))[1].prompts)
    assert small <= large
    assert {p for p in large if int(p[2:]) < 100} == small
    assert set(dataset.stable_split((0.7, 0.3), seed=1)[1].prompts) != large


@pytest.mark.parametrize("stable", [True, False])
def test_rows_that_repeat_a_scene_share_its_part(stable: bool) -> None:
    """Each scene stands in three rows with other prompts, once with its slots in another order."""
    one = _dataset(60)
    tensor = torch.cat([one.tensor, one.tensor[:, [0, 4, 3, 2, 1]], one.tensor])
    prompts = [f"{row}" for row in range(60)] * 3
    dataset = SceneDataset(tensor, prompts, one.normalizer, TYPE)
    parts = dataset.stable_split((0.5, 0.5)) if stable else dataset.split((0.5, 0.5))
    assert sum(map(len, parts)) == 180
    for part in parts:
        assert set(Counter(part.prompts).values()) == {3}
    assert len(set(dataset.keys.tolist())) == 60
    if not stable:
        assert [len(part) for part in parts] == [90, 90]


def test_keys_tell_poses_apart_and_ignore_empty_slots() -> None:
    batch = SceneBatch.empty("toy_cups", 2)
    tensor = batch.tensor.clone()
    tensor[:, 1] = torch.from_numpy(cup_row(0.1, 0.2))
    tensor[1, 1, 0] += 1e-6
    dataset = SceneDataset(tensor, ["a", "b"], Normalizer.fit(tensor), TYPE)
    wider = SceneDataset(SceneBatch(tensor, TYPE).with_slots(9).tensor, ["a", "b"], dataset.normalizer, TYPE)
    assert dataset.keys[0] != dataset.keys[1]
    assert (dataset.keys == wider.keys).all()


@pytest.mark.parametrize(("fractions", "index"), [((0.7, 0.6), 0), ((-0.1, 0.5), 0), ((0.5,), 1), ((), 0)])
def test_impossible_parts_are_refused(fractions: tuple[float, ...], index: int) -> None:
    with pytest.raises(InvalidInputError):
        Part(fractions, index)


# -- unions -----------------------------------------------------------------------------------------


def test_names_joined_by_plus_are_the_union_everywhere() -> None:
    assert get_scene_type("dimsum_table+pantry_shelf") == union_scene_type(["dimsum_table", "pantry_shelf"])
    with pytest.raises(UnknownNameError, match="did you mean 'pantry_shelf'"):
        get_scene_type("dimsum_table+pantry_shlf")


def test_a_union_holds_the_assets_slots_and_room_of_all() -> None:
    names = ["breakfast_table_high_clutter", "dimsum_table", "restaurant_high_clutter"]
    union = union_scene_type(names)
    types = [get_scene_type(name) for name in names]
    assert set(union.assets) == set().union(*(kind.assets for kind in types))
    assert list(union.assets) == sorted(union.assets)
    assert union.slots == 125
    assert union.workspace == ((-5.0, -5.0, -0.8), (5.0, 5.0, 0.99))
    assert set(union.welded) == {"breakfast_table", "cafe_table", "floor", "shelf"}
    assert union.fixed == ()
    same = union_scene_type(["restaurant_high_clutter", "restaurant_low_clutter"], name="restaurants")
    assert [fixed.asset for fixed in same.fixed] == ["floor"]
    assert same.name == "restaurants"


def test_a_union_finds_the_users_assets_of_its_types(tmp_path: Path) -> None:
    own = dataclasses.replace(TYPE, name="own_cups", asset_folders=(str(tmp_path),))
    assert union_scene_type([own, "dimsum_table", own]).asset_folders == (str(tmp_path),)


def test_scenes_go_to_a_union() -> None:
    union = union_scene_type(["toy_cups", "dimsum_table", "pantry_shelf"])
    batch = toy_scenes(12)
    there = to_union(batch, union)
    assert there.tensor.shape == (12, 61, union.features)
    assert there.names() == batch.names()
    assert torch.equal(there.translations[:, :5], batch.translations)
    assert torch.equal(there.is_welded[:, :5], batch.is_welded)
    with pytest.raises(InvalidInputError, match="does not have"):
        to_union(batch, get_scene_type("pantry_shelf"))


def test_the_normalizer_of_a_union_covers_all() -> None:
    union = union_scene_type(["toy_cups", "dimsum_table"])
    members = [_dataset(20).normalizer, _dimsum(10).normalizer]
    joint = union_normalizer(members, union)
    assert joint.input_max[2] == 0.5
    assert joint.input_min[2] == 0.0
    assert joint.is_constant[5]  # neither tilts
    assert joint.scale[12:].tolist() == [2.0] * (union.num_assets + 1)
