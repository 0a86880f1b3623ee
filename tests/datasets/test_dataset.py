"""Datasets in memory and on disk: rooms, unions, readers, and Hugging Face ``datasets``."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from scene_envs.datasets import DatasetInfo, SceneDataset, describe_all, read_metadata, to_union
from scene_envs.datasets.dataset import union_normalizer
from scene_envs.errors import CorruptFileError, InvalidInputError, StorageError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from scene_envs.scene_types import get_scene_type, union_scene_type
from tests.helpers.toy_grammars import TYPE, cup_row, toy_scenes


@pytest.fixture(scope="module")
def dataset() -> SceneDataset:
    batch = toy_scenes(40)
    low, high = torch.tensor([-0.4, -0.4, 0.0] + [-1.0] * 9 + [0.0] * 4), torch.tensor([0.4, 0.4, 0.5] + [1.0] * 13)
    for constant in (5, 8, 9, 10):
        low[constant] = high[constant] = 0.0
    low[11] = 0.0
    sets = describe_all(batch, np.random.default_rng(0))
    return SceneDataset(batch.tensor, sets, Normalizer.from_range(low, high), TYPE)


@pytest.fixture
def folder(dataset: SceneDataset, tmp_path: Path) -> Path:
    return dataset.save(tmp_path / "scenes", shard_size=25)


def test_save_and_load_give_the_same_scenes(dataset: SceneDataset, folder: Path) -> None:
    loaded = SceneDataset.load(folder)
    assert loaded.prompts == dataset.prompts
    assert loaded.prompt_sets == dataset.prompt_sets
    assert loaded.scene_type is dataset.scene_type
    torch.testing.assert_close(loaded.tensor, dataset.tensor, atol=1e-7, rtol=0)
    constant = [5, 8, 9, 10, 11, *range(12, 16)]
    assert torch.equal(loaded.tensor[..., constant], dataset.tensor[..., constant])
    on_table = dataset.tensor[..., 2] == 0
    assert (loaded.tensor[..., 2][on_table] == 0).all()


@pytest.mark.parametrize("shard_size", [25, 2000])
def test_hugging_face_datasets_reads_the_folder(dataset: SceneDataset, tmp_path: Path, shard_size: int) -> None:
    import datasets

    folder = dataset.save(tmp_path / "scenes", shard_size=shard_size)
    loaded = datasets.load_dataset(str(folder), cache_dir=str(tmp_path / "cache"))["train"]
    assert len(loaded) == len(dataset)
    assert loaded.column_names == ["scenes", "language_annotation", "language_annotations"]
    assert loaded["language_annotation"][:] == dataset.prompts
    assert [tuple(prompts) for prompts in loaded["language_annotations"][:]] == dataset.prompt_sets
    scenes = torch.tensor(loaded[:]["scenes"])
    assert scenes.shape == (40, 5, 16)
    torch.testing.assert_close(scenes, dataset.normalizer.normalize(dataset.tensor))


def test_limit_reads_a_prefix(dataset: SceneDataset, folder: Path) -> None:
    loaded = SceneDataset.load(folder, limit=10)
    assert len(loaded) == 10
    assert loaded.prompts == dataset.prompts[:10]
    assert not loaded.complete


def test_a_dataset_with_one_prompt_per_scene_has_the_published_columns(dataset: SceneDataset, tmp_path: Path) -> None:
    one = SceneDataset(dataset.tensor, dataset.prompts, dataset.normalizer, TYPE)
    assert one.prompt_sets == [(prompt,) for prompt in dataset.prompts]
    file = one.save(tmp_path) / "scenes-00000.parquet"
    assert pq.read_schema(file).names == ["scenes", "language_annotation"]
    assert SceneDataset.load(tmp_path).prompt_sets == one.prompt_sets


@pytest.mark.parametrize("sets", [["A scene."] * 39, [()] * 40, [None] * 40, [("A scene.", 1)] * 40])
def test_each_scene_needs_a_prompt(dataset: SceneDataset, sets: list[object]) -> None:
    with pytest.raises(InvalidInputError, match="40 scenes need as many prompts"):
        SceneDataset(dataset.tensor, sets, dataset.normalizer, TYPE)


def test_a_folder_that_cannot_be_written_is_named(dataset: SceneDataset, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot write .*file/scenes"):
        dataset.save(tmp_path / "file" / "scenes")


def test_metadata_alone_tells_what_a_dataset_holds(folder: Path, dataset: SceneDataset) -> None:
    for file in folder.glob("*.parquet"):
        file.unlink()
    info = read_metadata(folder)
    assert info.stems == ("cafe_table", "dinner_plate", "teacup")
    assert info.welded_model_paths == ("scene_envs/assets/cafe_table",)
    assert (info.slots, info.features, info.scene_type) == (5, 16, "toy_cups")
    assert torch.equal(info.normalizer.scale, dataset.normalizer.scale)
    assert info.categories_in(TYPE).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("fractions", [(0.8, 0.3), (-0.1, 0.5), ()])
def test_impossible_fractions_are_refused(dataset: SceneDataset, fractions: tuple[float, ...]) -> None:
    with pytest.raises(InvalidInputError, match="fractions"):
        dataset.split(fractions)


def test_missing_folder_and_missing_metadata_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="nowhere"):
        SceneDataset.load(tmp_path / "nowhere")
    (folder / "metadata.json").unlink()
    with pytest.raises(InvalidInputError, match=r"metadata\.json"):
        SceneDataset.load(folder)


def test_a_truncated_parquet_file_is_named(folder: Path) -> None:
    path = folder / "scenes-00001.parquet"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CorruptFileError, match="scenes-00001"):
        SceneDataset.load(folder)


def test_a_dataset_that_lost_scenes_says_so(
    dataset: SceneDataset, folder: Path, caplog: pytest.LogCaptureFixture
) -> None:
    SceneDataset.load(folder)
    assert not caplog.text
    shard = sorted(folder.glob("*.parquet"))[-1]
    pq.write_table(pq.read_table(shard).slice(1), shard)
    with pytest.raises(CorruptFileError, match=r"15 rows were written, the file has 14\); delete it"):
        SceneDataset.load(folder)
    pq.write_table(pq.read_table(shard).replace_schema_metadata(), shard)  # changed on purpose
    assert len(SceneDataset.load(folder, limit=1)) == 1
    assert not caplog.text
    assert not SceneDataset.load(folder).complete
    assert f"holds {len(dataset) - 1} of the {len(dataset)} requested scenes" in caplog.text


def test_a_missing_column_is_named(folder: Path) -> None:
    path = folder / "scenes-00000.parquet"
    pq.write_table(pq.read_table(path).drop_columns(["language_annotation"]), path)
    with pytest.raises(CorruptFileError, match="language_annotation"):
        SceneDataset.load(folder)


def test_scenes_of_the_wrong_width_are_refused(folder: Path) -> None:
    path = folder / "scenes-00000.parquet"
    pq.write_table(pa.table({"scenes": [[[0.0] * 15] * 5], "language_annotation": ["A scene."]}), path)
    with pytest.raises(CorruptFileError, match="expected 16 features"):
        SceneDataset.load(folder)


@pytest.mark.parametrize("content", ["{not json", '{"model_paths": []}', "[]"])
def test_broken_metadata_is_named(folder: Path, content: str) -> None:
    (folder / "metadata.json").write_text(content)
    with pytest.raises(CorruptFileError, match=r"metadata\.json"):
        SceneDataset.load(folder)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("translation_vec_len", 7, "translation_vec_len is 7, expected 3"),
        ("model_path_vec_len", 3, "model_path_vec_len is 3, expected 4"),
        ("model_paths", ["a/cafe_table"], "model_path_vec_len is 4, expected 2"),
        ("normalizer_state", {"params": {}}, "normalizer_state lacks"),
    ],
)
def test_contradicting_metadata_is_named(folder: Path, key: str, value: object, words: str) -> None:
    path = folder / "metadata.json"
    content = json.loads(path.read_text()) | {key: value}
    path.write_text(json.dumps(content))
    with pytest.raises(CorruptFileError, match=r"metadata\.json.* was changed after it was written .*remove its key"):
        read_metadata(folder)
    path.write_text(json.dumps({name: entry for name, entry in content.items() if name != "sha256"}))
    with pytest.raises(CorruptFileError, match=words):
        read_metadata(folder)


def test_saving_into_a_used_folder_is_refused(dataset: SceneDataset, folder: Path) -> None:
    with pytest.raises(InvalidInputError, match="already holds"):
        dataset.save(folder)


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
    parts = dataset.split((0.8, 0.1, 0.1), seed=3)
    names = [set(part.prompts) for part in parts]
    assert sum(map(len, names)) == len(set.union(*names)) == 2000
    expected = np.array([1600, 200, 200])
    deviation = np.abs([len(name) for name in names] - expected)
    assert (deviation <= 4 * np.sqrt(2000 * np.array([0.16, 0.09, 0.09]))).all()


def test_a_scene_keeps_its_part_when_the_dataset_grows_or_is_shuffled() -> None:
    dataset = _dataset(300)
    small = set(dataset[:100].split((0.7, 0.3))[1].prompts)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    large = set(dataset[order].split((0.7, 0.3))[1].prompts)
    assert small <= large
    assert {p for p in large if int(p[2:]) < 100} == small
    assert set(dataset.split((0.7, 0.3), seed=1)[1].prompts) != large


def test_rows_that_repeat_a_scene_share_its_part() -> None:
    """Each scene stands in three rows with other prompts, once with its slots in another order."""
    one = _dataset(60)
    tensor = torch.cat([one.tensor, one.tensor[:, [0, 4, 3, 2, 1]], one.tensor])
    prompts = [f"{row}" for row in range(60)] * 3
    dataset = SceneDataset(tensor, prompts, one.normalizer, TYPE)
    parts = dataset.split((0.5, 0.5))
    assert sum(map(len, parts)) == 180
    for part in parts:
        assert set(Counter(part.prompts).values()) == {3}
    assert len(set(dataset.keys.tolist())) == 60


def test_keys_tell_poses_apart_and_ignore_empty_slots() -> None:
    batch = SceneBatch.empty("toy_cups", 2)
    tensor = batch.tensor.clone()
    tensor[:, 1] = torch.from_numpy(cup_row(0.1, 0.2))
    tensor[1, 1, 0] += 1e-6
    dataset = SceneDataset(tensor, ["a", "b"], Normalizer.fit(tensor), TYPE)
    wider = SceneDataset(SceneBatch(tensor, TYPE).with_slots(9).tensor, ["a", "b"], dataset.normalizer, TYPE)
    assert dataset.keys[0] != dataset.keys[1]
    assert (dataset.keys == wider.keys).all()


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


ROWS = 7
LOW = torch.tensor([-0.5, -0.4, -0.02] + [-1.0] * 9 + [0.0] * 4)
HIGH = torch.tensor([0.4, 0.6, 0.5] + [1.0] * 13)
NORMALIZER = Normalizer.from_range(LOW, HIGH)
PROMPTS = [f"Prompt {row}." for row in range(ROWS)]


@pytest.fixture(scope="module")
def scenes() -> torch.Tensor:
    return toy_scenes(ROWS, seed=5).tensor


def _metadata(folder: Path, **changes: object) -> None:
    metadata = {
        "model_paths": [f"package://tea/{name}/{name}.sdf" for name in TYPE.assets],
        "welded_object_model_paths": ["package://tea/cafe_table/cafe_table.sdf"],
        "translation_vec_len": 3,
        "model_path_vec_len": 4,
        "max_num_objects_per_scene": 5,
        "normalizer_state": NORMALIZER.state(),
    } | changes
    (folder / "metadata.json").write_text(json.dumps(metadata))


def _nested(values: np.ndarray, *, fixed: bool, kind: pa.DataType) -> pa.Array:
    flat = pa.array(values.reshape(-1), kind)
    if fixed:
        inner = pa.FixedSizeListArray.from_arrays(flat, values.shape[2])
        return pa.FixedSizeListArray.from_arrays(inner, values.shape[1])
    return pa.array(values.tolist(), pa.list_(pa.list_(kind)))


def _table(values: np.ndarray, layout: str, kind: pa.DataType) -> pa.Table:
    if layout == "flat":
        column = pa.array(values.reshape(len(values), -1).tolist(), pa.list_(kind))
    elif layout == "flat fixed":
        column = pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1), kind), values[0].size)
    elif layout == "large list":
        column = pa.array(values.tolist(), pa.large_list(pa.large_list(kind)))
    else:
        column = _nested(values, fixed=layout == "fixed", kind=kind)
    return pa.table({"scenes": column, "language_annotation": PROMPTS[: len(values)]})


def _write(table: pa.Table, path: Path) -> None:
    if path.suffix == ".parquet":
        pq.write_table(table, path, row_group_size=3)
    else:
        make = pa.ipc.new_stream if path.name.startswith("stream") else pa.ipc.new_file
        with make(str(path), table.schema) as writer:
            writer.write_table(table, max_chunksize=3)


def _load(folder: Path, **options: object) -> SceneDataset:
    return SceneDataset.load(folder, scene_type="toy_cups", **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["a.parquet", "stream.arrow", "file.arrow"])
@pytest.mark.parametrize("layout", ["list", "fixed", "large list", "flat", "flat fixed"])
def test_every_layout_gives_the_same_scenes(scenes: torch.Tensor, tmp_path: Path, name: str, layout: str) -> None:
    _metadata(tmp_path)
    _write(_table(NORMALIZER.normalize(scenes).numpy(), layout, pa.float32()), tmp_path / name)
    loaded = _load(tmp_path)
    torch.testing.assert_close(loaded.tensor, scenes, atol=1e-6, rtol=0)
    assert torch.equal(loaded.tensor[..., 12:], scenes[..., 12:])
    assert loaded.prompts == PROMPTS
    assert loaded.prompt_sets == [(prompt,) for prompt in PROMPTS]


@pytest.mark.parametrize(("kind", "error"), [(pa.float64(), 1e-6), (pa.float16(), 1e-3)])
def test_doubles_and_halves(scenes: torch.Tensor, tmp_path: Path, kind: pa.DataType, error: float) -> None:
    _metadata(tmp_path)
    normalised = NORMALIZER.normalize(scenes.double()).numpy().astype(kind.to_pandas_dtype())
    _write(_table(normalised, "list", kind), tmp_path / "a.parquet")
    loaded = _load(tmp_path)
    torch.testing.assert_close(loaded.tensor, scenes, atol=error, rtol=0)
    rotations = loaded.batch().rotations[~loaded.batch().is_empty]
    unit = torch.eye(3).expand_as(rotations)
    torch.testing.assert_close(rotations @ rotations.transpose(1, 2), unit, atol=2e-5, rtol=0)
    table_pose = torch.tensor([0.0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1])
    assert torch.equal(loaded.tensor[:, 0, :12], table_pose.expand(ROWS, 12))


@pytest.mark.slow
def test_hugging_face_files_and_folders(scenes: torch.Tensor, tmp_path: Path) -> None:
    """``Array2D`` columns; ``save_to_disk`` with two files and rows chosen by an index; ``to_parquet``."""
    import datasets

    columns = {"scenes": datasets.Array2D((5, 16), "float64"), "language_annotation": datasets.Value("string")}
    rows = {"scenes": list(NORMALIZER.normalize(scenes).double().numpy()), "language_annotation": PROMPTS}
    theirs = datasets.Dataset.from_dict(rows, features=datasets.Features(columns)).select([6, 5, 4, 3, 2, 1, 0])
    theirs.save_to_disk(tmp_path / "train", num_shards=2)
    _metadata(tmp_path)  # in the folder above the split
    assert len(list((tmp_path / "train").glob("*.arrow"))) == 2
    theirs.to_parquet(tmp_path / "theirs.parquet")
    expected = scenes.flip(0)
    for loaded in (_load(tmp_path / "train"), _load(tmp_path / "theirs.parquet")):
        torch.testing.assert_close(loaded.tensor, expected, atol=1e-6, rtol=0)
        assert loaded.prompts == PROMPTS[::-1]


def test_a_dictionary_of_splits_asks_which(scenes: torch.Tensor, tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    (tmp_path / "test").mkdir()
    (tmp_path / "dataset_dict.json").write_text('{"splits": ["train", "test"]}')
    with pytest.raises(InvalidInputError, match=r"\['test', 'train'\]"):
        _load(tmp_path)


def test_a_saved_dataset_that_lost_a_file_names_it(tmp_path: Path) -> None:
    (tmp_path / "state.json").write_text('{"_data_files": [{"filename": "data-00000-of-00001.arrow"}]}')
    with pytest.raises(CorruptFileError, match="data-00000-of-00001"):
        _load(tmp_path)


def test_categories_are_matched_by_path_never_by_index(scenes: torch.Tensor, tmp_path: Path) -> None:
    _metadata(tmp_path, model_paths=["b/teacup.sdf", "a/cafe_table.sdf", "dinner_plate"])
    order = [*range(12), 14, 12, 13, 15]
    normalised = NORMALIZER.normalize(scenes)[..., order].numpy()
    _write(_table(normalised, "list", pa.float32()), tmp_path / "a.parquet")
    loaded = _load(tmp_path)
    torch.testing.assert_close(loaded.tensor, scenes, atol=1e-6, rtol=0)
    torch.testing.assert_close(loaded.normalizer.normalize(scenes), NORMALIZER.normalize(scenes))


def test_a_model_path_that_is_no_asset_names_its_file(scenes: torch.Tensor, tmp_path: Path) -> None:
    _metadata(tmp_path, model_paths=["cafe_table", "teacupp", "dinner_plate"])
    _write(_table(NORMALIZER.normalize(scenes).numpy(), "list", pa.float32()), tmp_path / "a.parquet")
    with pytest.raises(UnknownNameError, match=rf"{tmp_path}.*did you mean 'teacup'"):
        _load(tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"model_paths": None},
        {"model_paths": 1},
        {"welded_object_model_paths": True},
        {"normalizer_state": {"params": {"scale": 1, "min": 1, "input_stats": {"min": 1, "max": 1}}}},
        {"normalizer_state": {"params": {"scale": [0], "min": [""], "input_stats": {"min": [1], "max": [1]}}}},
    ],
    ids=str,
)
def test_metadata_of_wrong_type_names_its_file(scenes: torch.Tensor, tmp_path: Path, change: dict[str, object]) -> None:
    _metadata(tmp_path, **change)
    _write(_table(NORMALIZER.normalize(scenes).numpy(), "flat", pa.float32()), tmp_path / "scenes.parquet")
    with pytest.raises(CorruptFileError, match=r"metadata.json'"):
        _load(tmp_path)


def test_a_scene_type_that_nobody_knows_names_the_file(scenes: torch.Tensor, tmp_path: Path) -> None:
    _metadata(tmp_path, scene_type="dimsum]table")
    _write(_table(NORMALIZER.normalize(scenes).numpy(), "list", pa.float32()), tmp_path / "a.parquet")
    with pytest.raises(UnknownNameError, match=rf"{tmp_path}.*did you mean 'dimsum_table'"):
        SceneDataset.load(tmp_path)


def test_a_dataset_with_fewer_assets_loads(scenes: torch.Tensor, tmp_path: Path) -> None:
    """The toy scenes hold no plate; a file that does not know plates has the same scenes."""
    few = [*range(13), 14, 15]
    state = Normalizer(*(v[few] for v in (NORMALIZER.scale, NORMALIZER.min, LOW, HIGH))).state()
    _metadata(tmp_path, model_paths=["cafe_table", "teacup"], model_path_vec_len=3, normalizer_state=state)
    _write(_table(NORMALIZER.normalize(scenes)[..., few].numpy(), "list", pa.float32()), tmp_path / "a.parquet")
    loaded = _load(tmp_path)
    torch.testing.assert_close(loaded.tensor, scenes, atol=1e-6, rtol=0)
    torch.testing.assert_close(loaded.normalizer.normalize(scenes), NORMALIZER.normalize(scenes))


def test_aliases_map_other_names_several_to_one(scenes: torch.Tensor, tmp_path: Path) -> None:
    """Their red and blue cups are both ours."""
    _metadata(tmp_path, model_paths=["cafe_table", "cup_red", "cup_blue"])
    values = scenes.clone()
    values[::2, :, 13], values[::2, :, 14] = scenes[::2, :, 14], 0.0
    _write(_table(NORMALIZER.normalize(values).numpy(), "list", pa.float32()), tmp_path / "a.parquet")
    with pytest.raises(UnknownNameError, match="cup_red"):
        _load(tmp_path)
    loaded = _load(tmp_path, aliases={"cup_red": "teacup", "cup_blue": "teacup"})
    torch.testing.assert_close(loaded.tensor, scenes, atol=1e-6, rtol=0)
    assert loaded.normalizer.scale[12:].tolist() == [2.0] * 4


def test_a_normalizer_of_poses_alone_leaves_one_hots(scenes: torch.Tensor, tmp_path: Path) -> None:
    state = Normalizer(NORMALIZER.scale[:12], NORMALIZER.min[:12], LOW[:12], HIGH[:12]).state()
    _metadata(tmp_path, normalizer_state=state)
    values = torch.cat([NORMALIZER.normalize(scenes)[..., :12], scenes[..., 12:]], dim=-1)
    _write(_table(values.numpy(), "list", pa.float32()), tmp_path / "a.parquet")
    torch.testing.assert_close(_load(tmp_path).tensor, scenes, atol=1e-6, rtol=0)


def test_constant_features_scaled_by_one_come_back(scenes: torch.Tensor, tmp_path: Path) -> None:
    """Other writers give constant features scale 1 and an offset that makes them 0 (or -1)."""
    scale, offset = NORMALIZER.scale.clone(), NORMALIZER.min.clone()
    scale[2], offset[2] = 1.0, -0.0
    scale[11], offset[11] = 1.0, -1.0
    _metadata(tmp_path, normalizer_state=Normalizer(scale, offset, LOW, HIGH).state())
    _write(_table((scenes * scale + offset).numpy(), "list", pa.float32()), tmp_path / "a.parquet")
    torch.testing.assert_close(_load(tmp_path).tensor, scenes, atol=1e-6, rtol=0)


# -- fixed objects ----------------------------------------------------------------------------------


def _write_scenes(folder: Path, scenes: torch.Tensor) -> None:
    _metadata(folder, max_num_objects_per_scene=scenes.shape[1])
    _write(_table(NORMALIZER.normalize(scenes).numpy(), "fixed", pa.float32()), folder / "a.parquet")


def test_fixed_objects_move_to_the_first_slots(scenes: torch.Tensor, tmp_path: Path) -> None:
    """Row r of the file has its table in slot r mod 5; the others keep their order."""
    moved = scenes.clone()
    for row in range(ROWS):
        order = [*range(1, 5)]
        order.insert(row % 5, 0)
        moved[row] = scenes[row, order]
    _write_scenes(tmp_path, moved)
    torch.testing.assert_close(_load(tmp_path).tensor, scenes, atol=1e-6, rtol=0)


def test_fixed_objects_that_are_missing_are_added_to_an_empty_slot(scenes: torch.Tensor, tmp_path: Path) -> None:
    bare = scenes[:, 1:].clone()
    full = (bare[..., -1] == 0).all(dim=1)
    _write_scenes(tmp_path, bare)
    assert bool(full.any())
    row = int(torch.nonzero(full)[0])
    with pytest.raises(InvalidInputError, match=rf"row {row} of .*lacks the fixed 'cafe_table'.*slots=5"):
        _load(tmp_path)
    torch.testing.assert_close(_load(tmp_path, slots=5).tensor, scenes, atol=1e-6, rtol=0)


def test_fixed_objects_elsewhere_are_refused_unless_told(scenes: torch.Tensor, tmp_path: Path) -> None:
    shifted = scenes.clone()
    shifted[4, 0, 2] = 0.25
    _write_scenes(tmp_path, shifted)
    with pytest.raises(InvalidInputError, match=r"row 4 of .*'cafe_table' at \[.*0\.25\] m.*fixed_tolerance"):
        _load(tmp_path)
    torch.testing.assert_close(_load(tmp_path, fixed_tolerance=math.inf).tensor, scenes, atol=1e-6, rtol=0)


def test_a_second_table_stays_an_object(scenes: torch.Tensor, tmp_path: Path) -> None:
    two = scenes.clone()
    two[:, 4] = two[:, 0]
    two[:, 4, 0] = 0.3
    _write_scenes(tmp_path, two[:, [4, 1, 2, 3, 0]])
    expected = two[:, [0, 4, 1, 2, 3]]
    torch.testing.assert_close(_load(tmp_path).tensor, expected, atol=1e-6, rtol=0)


# -- what cannot be read ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda x: x.__setitem__((5, 2, 3), math.nan), "row 5 of .*slot 2, holds a value that is not finite"),
        (lambda x: x.__setitem__((6, 0, 12), 0.1), "row 6 of .*slot 0, is not one-hot"),
        (lambda x: x.__setitem__((4, 0, 3), 0.2), "row 4 of .*slot 0, has no rotation"),
        (lambda x: x.__setitem__((4, 0, 11), -1.0), "row 4 of .*slot 0, has no rotation"),
    ],
)
def test_scenes_that_are_none_are_named_by_row(scenes: torch.Tensor, tmp_path: Path, spoil, words: str) -> None:
    values = NORMALIZER.normalize(scenes).clone()
    spoil(values)
    _metadata(tmp_path)
    _write(_table(values.numpy(), "list", pa.float32()), tmp_path / "a.parquet")
    with pytest.raises(CorruptFileError, match=words):
        _load(tmp_path)


def test_missing_values_are_named_by_row(scenes: torch.Tensor, tmp_path: Path) -> None:
    _metadata(tmp_path)
    values = NORMALIZER.normalize(scenes).tolist()
    values[4][1][0] = None
    pq.write_table(pa.table({"scenes": values, "language_annotation": PROMPTS}), tmp_path / "a.parquet")
    with pytest.raises(CorruptFileError, match="row 4 has a missing value"):
        _load(tmp_path)
    values[4] = None
    pq.write_table(pa.table({"scenes": values, "language_annotation": PROMPTS}), tmp_path / "a.parquet")
    with pytest.raises(CorruptFileError, match="row 4 has a missing scene"):
        _load(tmp_path)


def test_ragged_and_wrong_columns_are_named(tmp_path: Path) -> None:
    _metadata(tmp_path)
    for column, words in (
        ([[[0.0] * 16] * 5, [[0.0] * 16] * 4], r"slots per scene \[4, 5\]"),
        ([[], []], r"slots per scene \[0\]"),
        ([[[0.0] * 20] * 5] * 2, r"features per slot \[20\], expected 16"),
        ([[0.0] * 81] * 2, "expected 16 features"),
        (["a", "b"], "expected lists of floats"),
    ):
        pq.write_table(pa.table({"scenes": column, "language_annotation": ["a", "b"]}), tmp_path / "a.parquet")
        with pytest.raises(CorruptFileError, match=words):
            _load(tmp_path)


@pytest.mark.parametrize("name", ["a.parquet", "stream.arrow", "file.arrow"])
def test_truncated_files_are_named(scenes: torch.Tensor, tmp_path: Path, name: str) -> None:
    _metadata(tmp_path)
    path = tmp_path / name
    _write(_table(NORMALIZER.normalize(scenes).numpy(), "list", pa.float32()), path)
    path.write_bytes(path.read_bytes()[:-700])
    with pytest.raises(CorruptFileError, match=name):
        _load(tmp_path)


def test_no_files_and_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="no parquet or arrow files"):
        _load(tmp_path)
    (tmp_path / "scenes.csv").touch()
    with pytest.raises(InvalidInputError, match=r"neither a \.parquet nor an \.arrow"):
        _load(tmp_path / "scenes.csv")


def test_scenes_read_are_usable(tmp_path: Path) -> None:
    """A scene by hand: the cup that was written is the cup that is read."""
    scene = SceneBatch.empty("toy_cups", 1).tensor.clone()
    scene[0, 3] = torch.from_numpy(cup_row(0.1, -0.2, yaw=0.5))
    _write_scenes(tmp_path, scene)
    batch = _load(tmp_path).batch()
    assert batch.names() == [["cafe_table", "teacup"]]
    assert batch.translations[0, 3].tolist() == pytest.approx([0.1, -0.2, 0.0], abs=1e-6)
    assert math.atan2(batch.rotations[0, 3, 1, 0], batch.rotations[0, 3, 0, 0]) == pytest.approx(0.5, abs=1e-6)


def test_names_may_hold_dots_and_model_paths_suffixes() -> None:
    kind = dataclasses.replace(TYPE, name="dots", assets=("cafe_table", "mug.v2", "teacup"))
    paths = ("scene_envs/assets/mug.v2", "package://things/teacup.sdf", "scene_envs/assets/cafe_table")
    info = DatasetInfo(Path("metadata.json"), paths, Normalizer.fit(torch.zeros(1, 1, 16)))
    assert info.categories_in(kind).tolist() == [1, 2, 0, 3]
