"""Datasets of others: every list layout, float width and file format, welded objects anywhere."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from scene_envs.datasets import DatasetInfo, SceneDataset
from scene_envs.errors import CorruptFileError, InvalidInputError, UnknownNameError
from scene_envs.normalizer import Normalizer
from scene_envs.scene import SceneBatch
from tests.helpers.toy_grammars import TYPE, cup_row, toy_scenes

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
    """``Array2D`` columns; ``save_to_disk`` with two files and rows chosen by an index; ``to_parquet``; in memory."""
    import datasets

    columns = {"scenes": datasets.Array2D((5, 16), "float64"), "language_annotation": datasets.Value("string")}
    rows = {"scenes": list(NORMALIZER.normalize(scenes).double().numpy()), "language_annotation": PROMPTS}
    theirs = datasets.Dataset.from_dict(rows, features=datasets.Features(columns)).select([6, 5, 4, 3, 2, 1, 0])
    theirs.save_to_disk(tmp_path / "train", num_shards=2)
    _metadata(tmp_path)  # in the folder above the split
    assert len(list((tmp_path / "train").glob("*.arrow"))) == 2
    theirs.to_parquet(tmp_path / "theirs.parquet")
    expected = scenes.flip(0)
    for loaded in (
        _load(tmp_path / "train"),
        _load(tmp_path / "theirs.parquet"),
        SceneDataset.from_huggingface(theirs, tmp_path, scene_type="toy_cups"),
    ):
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
