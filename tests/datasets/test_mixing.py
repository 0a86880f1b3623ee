"""Streams, disjoint parts, mixtures and unions of scene types."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_envs.datasets import MixedDataset, Part, SceneDataset, SceneStream, from_union, mix, to_union
from scene_envs.datasets import files as files_module
from scene_envs.datasets.union import union_normalizer
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


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """100 scenes in four files, read in blocks of 8."""
    monkeypatch.setattr(files_module, "BLOCK", 8)
    return _dataset(100).save(tmp_path / "scenes", shard_size=30)


# -- streams ----------------------------------------------------------------------------------------


def test_an_epoch_of_a_stream_visits_every_scene_once_in_another_order(folder: Path) -> None:
    stream = SceneStream(folder, window=20, seed=1)
    epochs = [[p for _ in range(10) for p in stream.take(10).prompts] for _ in range(2)]
    wanted = [f"0/{row}" for row in range(100)]
    assert all(sorted(epoch) == sorted(wanted) for epoch in epochs)
    assert epochs[0] != epochs[1]
    assert epochs[0] != wanted
    assert SceneStream(folder, window=20, seed=1).take(100).prompts == epochs[0]
    assert SceneStream(folder, window=20, seed=2).take(100).prompts != epochs[0]


def test_a_stream_holds_a_window_not_the_dataset(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = SceneStream(folder, window=16)
    largest = 0
    read = SceneStream._read

    def measured(self: SceneStream, blocks: list) -> SceneDataset:
        nonlocal largest
        scenes = read(self, blocks)
        largest = max(largest, len(scenes))
        return scenes

    monkeypatch.setattr(SceneStream, "_read", measured)
    stream.take(100)
    assert 16 <= largest <= 16 + 8


def test_scenes_of_a_stream_are_those_of_the_dataset(folder: Path) -> None:
    whole = SceneDataset.load(folder)
    by_prompt = dict(zip(whole.prompts, whole.tensor, strict=True))
    taken = SceneStream(folder, window=30).take(25)
    assert torch.equal(taken.tensor, torch.stack([by_prompt[prompt] for prompt in taken.prompts]))
    assert torch.equal(taken.normalizer.scale, whole.normalizer.scale)


@pytest.mark.slow
@pytest.mark.parametrize("taken", [0, 7, 20, 100, 133])
def test_a_stream_goes_on_exactly_from_its_state(folder: Path, taken: int) -> None:
    stream = SceneStream(folder, window=20, seed=4)
    stream.take(taken)
    state = json.loads(json.dumps(stream.state_dict()))
    resumed = SceneStream(folder, window=20, seed=4)
    resumed.load_state_dict(state)
    assert resumed.take(60).prompts == stream.take(60).prompts


def test_a_stream_over_nothing_says_so(folder: Path) -> None:
    with pytest.raises(InvalidInputError, match="no scene to stream"):
        SceneStream(folder, part=Part((0.0, 1.0), 0)).take(1)


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


def test_streams_of_two_parts_never_meet_and_agree_with_the_split_in_memory(folder: Path) -> None:
    fractions = (0.6, 0.4)
    expected = SceneDataset.load(folder).stable_split(fractions)
    for index in (0, 1):
        part = expected[index]
        taken = SceneStream(folder, window=20, part=Part(fractions, index)).take(len(part)).prompts
        assert sorted(taken) == sorted(part.prompts)


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


# -- mixtures ---------------------------------------------------------------------------------------


def test_batches_come_from_each_dataset_with_its_probability() -> None:
    mixed = mix([_dataset(50), _dimsum(30)], [0.75, 0.25], batch_size=4, seed=0)
    drawn = Counter(batch.scene_type.name for batch in islice(mixed, 2000))
    assert drawn.total() == 2000
    assert abs(drawn["toy_cups"] - 1500) < 4 * np.sqrt(2000 * 0.75 * 0.25)


def test_batches_hold_one_scene_type_and_its_prompts() -> None:
    for batch in islice(mix([_dataset(50), _dimsum(30)], batch_size=6), 20):
        source = "dimsum/" if batch.scene_type.name == "dimsum_table" else "0/"
        assert len(batch) == 6
        assert all(prompt.startswith(source) for prompt in batch.prompts)
        assert batch.tensor.shape[-1] == batch.scene_type.features


@pytest.mark.parametrize("together", [True, False])
def test_a_mixture_is_seeded_and_goes_on_exactly_from_its_state(folder: Path, together: bool) -> None:
    union = union_scene_type(["toy_cups", "dimsum_table"]) if together else None

    def make(seed: int = 5) -> MixedDataset:
        return mix([folder, _dimsum(30)], [0.6, 0.4], batch_size=5, seed=seed, window=20, union=union)

    mixed = make()
    first = [next(mixed).prompts for _ in range(13)]
    state = json.loads(json.dumps(mixed.state_dict()))
    then = [next(mixed).prompts for _ in range(13)]
    assert [batch.prompts for batch in islice(make(), 13)] == first
    assert [batch.prompts for batch in islice(make(seed=6), 13)] != first
    resumed = make()
    resumed.load_state_dict(state)
    assert [next(resumed).prompts for _ in range(13)] == then


@pytest.mark.slow
def test_a_part_of_a_mixture_keeps_to_it(folder: Path) -> None:
    fractions = (0.5, 0.5)
    seen = [
        {
            p
            for batch in islice(mix([folder, _dimsum(40)], part=Part(fractions, index), seed=index), 16)
            for p in batch.prompts
        }
        for index in (0, 1)
    ]
    assert not seen[0] & seen[1]
    assert len(seen[0] | seen[1]) == 140


@pytest.mark.parametrize("probabilities", [[0.5], [0.5, -0.5], [1.0, 0.0], [0.5, float("nan")], []])
def test_probabilities_that_do_not_fit_are_refused(probabilities: list[float]) -> None:
    with pytest.raises(InvalidInputError, match="probabilities"):
        mix([_dataset(5), _dimsum(5)], probabilities)


def test_a_state_of_another_mixture_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="mixture of 1 datasets"):
        mix([_dataset(5), _dimsum(5)]).load_state_dict(mix([_dataset(5)]).state_dict())


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


def test_scenes_go_to_a_union_and_back() -> None:
    union = union_scene_type(["toy_cups", "dimsum_table", "pantry_shelf"])
    batch = toy_scenes(12)
    there = to_union(batch, union)
    assert there.tensor.shape == (12, 61, union.features)
    assert there.names() == batch.names()
    assert torch.equal(there.translations[:, :5], batch.translations)
    assert torch.equal(there.is_welded[:, :5], batch.is_welded)
    back = from_union(there, "toy_cups")
    assert torch.equal(back.with_slots(5).tensor, batch.tensor)
    with pytest.raises(InvalidInputError, match="does not have"):
        from_union(there, "pantry_shelf")


def test_a_mixture_in_a_union_draws_scene_by_scene_under_one_normalizer() -> None:
    union = union_scene_type(["toy_cups", "dimsum_table"])
    mixed = mix([_dataset(50), _dimsum(30)], [0.75, 0.25], batch_size=40, union=union)
    drawn: Counter[str] = Counter()
    for batch in islice(mixed, 50):
        assert batch.scene_type is union
        assert batch.tensor.shape == (40, union.slots, union.features)
        drawn.update(prompt.split("/")[0] for prompt in batch.prompts)
        height = batch.batch().translations[:, 1, 2]
        assert [p.startswith("dimsum") for p in batch.prompts] == (height == 0.5).tolist()
        assert batch.normalizer.normalize(batch.tensor).abs().max() <= 1.0 + 1e-6
    assert abs(drawn["0"] - 1500) < 4 * np.sqrt(2000 * 0.75 * 0.25)
    one_type = mix([_dataset(5), _dataset(5, seed=1)])
    assert one_type.normalizer.scale.shape == (16,)
    with pytest.raises(InvalidInputError, match="pass union="):
        _ = mix([_dataset(5), _dimsum(5)]).normalizer


def test_the_normalizer_of_a_union_covers_all() -> None:
    union = union_scene_type(["toy_cups", "dimsum_table"])
    members = [_dataset(20).normalizer, _dimsum(10).normalizer]
    joint = union_normalizer(members, union)
    assert joint.input_max[2] == 0.5
    assert joint.input_min[2] == 0.0
    assert joint.is_constant[5]  # neither tilts
    assert joint.scale[12:].tolist() == [2.0] * (union.num_assets + 1)
